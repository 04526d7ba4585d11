"""Medians, white noise, least squares and rounded times, as every room takes them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

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


def runs_of(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Where flags, shape (n,), are set in a row: first and one beyond the last of each run."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8))).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def in_long_runs(flags: NDArray[np.bool_], least: int) -> NDArray[np.bool_]:
    """Those of the flags, shape (n,), that are set in a row of at least so many."""
    out = np.zeros(len(flags), dtype=np.bool_)
    for begin, end in runs_of(flags):
        out[begin:end] = end - begin >= least
    return out


def squares_left(A: F64, y: F64) -> float:
    """Sum of squares that least squares by the columns A, shape (n, m), leave of y, shape (n,)."""
    left = y - A @ least_squares(A, y)[0]
    return float(left @ left)


def triangular_means(values: F64, m: int) -> F64:
    """Means of n values over 2 m each with triangular weights, shape (n − 2 m + 1,): what the second differences of an
    angle over m sampling intervals either way are of the accelerations, and follow of the torques, between."""
    weights = m - np.abs(np.arange(-m, m) + 0.5)
    return np.convolve(values, weights / np.sum(weights), mode="valid")


def turning_over(travel: F64, m: int) -> tuple[F64, list[F64]]:
    """Second differences of an angle over m intervals either way, and the means of what friction goes with over the
    same: speed, its sign (smooth within a tenth of the usual speed) and a constant, shape (n − 2 m + 1,) each.

    Args:
        travel: of n sampling intervals, shape (n,).
    """
    turned = np.concatenate([[0.0], np.cumsum(travel)])
    second = turned[2 * m :] - 2.0 * turned[m:-m] + turned[: -2 * m]
    usual = float(np.sqrt(np.mean(travel**2))) or 1.0
    return second, [
        triangular_means(travel, m),
        triangular_means(np.tanh(travel / (0.1 * usual)), m),
        np.ones(len(second)),
    ]
