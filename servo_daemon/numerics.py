"""Medians, white noise, least squares and rounded times, as every room takes them."""

from __future__ import annotations

import numpy as np

from servo_daemon.samples import F64

#: Of white Gaussian noise: the median of magnitudes over 1 σ; its inverse as it is rounded in books.
MEDIAN_TO_STD, STD_OF_MEDIAN = 0.6745, 1.4826
#: 1 σ of a number that is anywhere within a range of 1: of a step's rounding, of a time between two samples.
UNIFORM_STD = 1.0 / np.sqrt(12.0)
#: Variance of third differences of white noise over its own (binomials 1, 3, 3, 1).
THIRD_DIFFERENCE_GAIN = 20.0


def median(values: F64) -> float:
    """As NumPy's, without its overhead."""
    middle = len(values) // 2
    if len(values) % 2:
        return upper_median(values)
    low, high = np.partition(values, (middle - 1, middle))[middle - 1 : middle + 1].tolist()
    return float(0.5 * (low + high))


def upper_median(values: F64) -> float:
    """Of an even number the larger of the middle two: what is asked for in every tick."""
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle])


def sample_period(time_s: F64) -> float:
    """Usual distance of two samples, s: what gaps do not move."""
    return float(np.median(np.diff(time_s)))


def milliseconds(time_s: F64) -> F64:
    """Whole ones, halves up: as times are shown, and as single rows of the history are kept."""
    return np.asarray(np.floor(time_s * 1e3 + 0.5))


def white_noise_var(signal: F64) -> float:
    """Variance of the white part of a signal, by the median of its third differences: what is smooth is a polynomial
    over four samples."""
    if len(signal) < 8:
        return 0.0
    third = np.diff(signal, 3)
    sigma = float(np.median(np.abs(third))) / MEDIAN_TO_STD
    return sigma**2 / THIRD_DIFFERENCE_GAIN


def is_definite(symmetric: F64, beyond: float = 0.0) -> bool:
    """Whether all eigenvalues of a symmetric matrix, shape (n, n), are larger than this."""
    shifted = symmetric.copy()
    shifted.flat[:: len(symmetric) + 1] -= beyond
    try:
        np.linalg.cholesky(shifted)
    except np.linalg.LinAlgError:
        return False
    return True


def inverse_of_information(information: F64) -> F64:
    """Covariance of what has this information, in any units, shape (n, n); along what nothing is known of, zero."""
    size = np.sqrt(np.maximum(information.diagonal(), 1e-300))
    scale = np.outer(size, size)
    return np.asarray(np.linalg.pinv(information / scale) / scale)


def score_and_information(innovation: F64, slopes: F64, log_var_slopes: F64) -> tuple[F64, F64]:
    """Gradient and expected Hessian of −2 log p of Gaussian innovations by k coordinates, shapes (k,) and (k, k): a
    step of Fisher's scoring is −H⁻¹ g.

    Args:
        innovation: over its standard deviation, shape (n,).
        slopes: of the same by each coordinate, shape (k, n).
        log_var_slopes: of the logarithm of its variance, shape (k, n).
    """
    gradient = np.sum(log_var_slopes + 2 * slopes * innovation, axis=1)
    raw = slopes + 0.5 * innovation * log_var_slopes  # of the innovation itself, over its standard deviation
    information = np.einsum("an,bn->ab", log_var_slopes, log_var_slopes) + 2 * np.einsum("an,bn->ab", raw, raw)
    return gradient, information


def least_squares(A: F64, y: F64) -> tuple[F64, int]:
    """Columns of any size, shape (n, m): coefficients, shape (m,), the smallest where several do as well, and how many
    of them the columns tell."""
    size = np.maximum(np.linalg.norm(A, axis=0), 1e-300)
    found, _, rank, _ = np.linalg.lstsq(A / size, y, rcond=1e-9)
    return np.asarray(found / size), int(rank)
