"""A process model of second order from voltage to speed, fitted to a capture of any motion.

    ω/v = k / (1 + a₁ s + a₂ s²)        a₁ = τ₁ + τ₂,  a₂ = τ₁ τ₂

Sum and product of the time constants exist for an underdamped motor, too, where τ₁ and τ₂ are a complex pair. The model
is simulated exactly for a held voltage and any sampling instants and compared with the measured increments of the
angle, by Gauss–Newton; a load's or a sensor's constant offset and the states at the beginning are fitted along.
Increments, because what the voltage does not tell (its noise, a load) adds up in the angle; then both sides are
whitened by an autoregression of the residual (generalised least squares; Söderström & Stoica, *System Identification*,
1989, sec. 7.4), so that neither the encoder's steps nor slow disturbances weigh more than they should.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servo_daemon.errors import BadInputError
from servo_daemon.identification.inverse_dynamics.signals import pieces
from servo_daemon.identification.paper.free_run import free_run
from servo_daemon.numerics import sample_period
from servo_daemon.plant.build import build_plant
from servo_daemon.regression.linear_regression import ROBUST, LinearFit, fit_linear
from servo_daemon.samples import F64, SampleBlock

_NAMES = ("gain", "sum", "product")
#: Shorter pieces between gaps are left out.
_FEWEST = 200
#: A sum of the time constants that is known no better than this (relative, 1 σ) is none.
_MOST_SPREAD = 0.3
_ORDER = 20  # of the autoregression
_ROUNDS, _WHITENINGS = 15, 3
_STEP = 1e-4  # for central differences, of each coordinate's scale
#: The product of the time constants is at least this part of the sum times the sampling period: below nothing shows.
_LEAST_PRODUCT = 1e-3
#: Time constants are looked for from so many periods to this part of the duration.
_SHORTEST, _LONGEST = 2.0, 0.1


@dataclass(frozen=True, slots=True)
class ProcessModel:
    """The fitted model.

    Attributes:
        gain: k, rad/s per V. sum_s: a₁, s. product_s2: a₂, s².
        covariance: of (k, a₁, a₂), shape (3, 3).
    """

    gain: float
    sum_s: float
    product_s2: float
    covariance: F64

    @property
    def std(self) -> F64:
        """Shape (3,), of (k, a₁, a₂)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def time_constants_s(self) -> tuple[complex, complex]:
        """τ₁ and τ₂, the faster first; a complex pair for an underdamped motor."""
        half = self.sum_s / 2
        root = complex(half**2 - self.product_s2) ** 0.5
        slow = half + root
        return self.product_s2 / slow, slow


@dataclass(frozen=True, slots=True)
class _Piece:
    time_s: F64
    voltage: F64
    shown: F64  # increments of the angle, or speeds
    is_angle: bool


def fit_process_model(blocks: Sequence[SampleBlock]) -> ProcessModel:
    """Fit to whole captures of one motor.

    Raises:
        BadInputError: voltage or motion is missing, the voltage never changes, or the capture does not show the time
            constants.
    """
    data = [_piece(p) for block in blocks for p in pieces(block) if len(p) >= _FEWEST]
    if not data:
        raise BadInputError(f"no {_FEWEST} samples without a gap: too short for a process model")
    volts = np.concatenate([d.voltage for d in data])
    if np.ptp(volts) <= 1e-6 * max(float(np.max(np.abs(volts))), 1e-12):
        raise BadInputError("the voltage never changes in this capture: time constants do not show without a step")
    x = _start(max(data, key=lambda d: len(d.time_s)))
    filters: list[F64] = [np.ones(1)] * len(data)
    for _ in range(_WHITENINGS):
        x, fit, residuals = _gauss_newton(data, x, filters)
        filters = [_autoregression(r) for r in residuals]
    x, fit, _ = _gauss_newton(data, x, filters)
    return _checked(x, fit)


def _checked(x: F64, fit: LinearFit) -> ProcessModel:
    if not set(_NAMES) <= set(fit.names):
        raise BadInputError("this motion does not show gain and time constants: it needs steps of the voltage")
    at = [fit.names.index(n) for n in _NAMES]
    by = np.array([np.exp(x[0]), np.exp(x[1]), 1.0])
    covariance = fit.covariances[ROBUST][np.ix_(at, at)] * np.outer(by, by)
    gain, sum_s, product_s2 = float(np.exp(x[0])), float(np.exp(x[1])), float(x[2])
    spread = float(np.sqrt(covariance[1, 1])) / sum_s
    if spread > _MOST_SPREAD:
        raise BadInputError(
            f"the time constants do not show in this motion (their sum is {sum_s:.3g} s ± {100 * spread:.0f} %): "
            "it needs steps of the voltage"
        )
    return ProcessModel(gain, sum_s, product_s2, covariance)


def _piece(block: SampleBlock) -> _Piece:
    if block.voltage_V is None:
        raise BadInputError("comparing coefficients needs the voltage: this capture has none")
    if block.position_rad is not None:
        return _Piece(block.time_s, block.voltage_V, np.diff(block.position_rad), True)
    if block.velocity_rad_s is None:
        raise BadInputError("comparing coefficients needs a position or a speed: this capture has neither")
    return _Piece(block.time_s, block.voltage_V, block.velocity_rad_s, False)


def _simulated(d: _Piece, x: F64, voltage: F64, speed: float = 0.0, rate: float = 0.0) -> F64:
    """What the sensor would show at x = (log k, log a₁, a₂): a motor with R = 1, B = 0, K = 1/k, J = a₁/k², L = a₂/a₁
    has this process model."""
    k, a1, a2 = np.exp(x[0]), np.exp(x[1]), x[2]
    values = {"R": 1.0, "L": a2 / a1, "K": 1 / k, "J": a1 / k**2, "B": 0.0}
    start = {"current_A": rate * a1 / k, "velocity_rad_s": speed}
    states = free_run(build_plant(()), values, d.time_s, voltage, start)
    return np.diff(states[:, 2]) if d.is_angle else states[:, 1]


def _columns(d: _Piece, x: F64) -> F64:
    """Derivatives by x and the offset, and what the two states at the start add; (n, 6)."""
    nothing = np.zeros_like(d.voltage)
    out = []
    for k, scale in enumerate((1.0, 1.0, x[2])):
        step = _STEP * scale * np.eye(3)[k]
        out.append((_simulated(d, x + step, d.voltage) - _simulated(d, x - step, d.voltage)) / (2 * _STEP * scale))
    out.append(_simulated(d, x, np.ones_like(d.voltage)))
    out += [_simulated(d, x, nothing, speed=1.0), _simulated(d, x, nothing, rate=1.0)]
    return np.column_stack(out)


def _gauss_newton(data: Sequence[_Piece], x: F64, filters: Sequence[F64]) -> tuple[F64, LinearFit, list[F64]]:
    """To the minimum of the whitened residual. Offset and starts are linear: they are solved for in every round.

    Returns:
        x; the last linear problem; residuals of the pieces, unwhitened.
    """
    period = sample_period(data[0].time_s)
    for _ in range(_ROUNDS):
        fit, residuals = _solve(data, x, filters)
        move = np.array([fit.value[fit.names.index(n)] if n in fit.names else 0.0 for n in _NAMES])
        move[:2] /= max(1.0, float(np.max(np.abs(move[:2]))) / 0.5)  # at most a factor of 1.6 in a round
        before, x = x, x + move
        a1 = float(np.exp(x[1]))
        x[2] = np.clip(x[2], max(_LEAST_PRODUCT * a1 * period, before[2] / 3), 3 * before[2])
        if np.max(np.abs((x - before) / (1.0, 1.0, x[2]))) < 1e-6:
            break
    return x, fit, residuals


def _solve(data: Sequence[_Piece], x: F64, filters: Sequence[F64]) -> tuple[LinearFit, list[F64]]:
    starts = [f"start {j} {what}" for j in range(len(data)) for what in ("speed", "rate")]
    names = [*_NAMES, "offset", *starts]
    X, y, plain = [], [], []
    for j, (d, a) in enumerate(zip(data, filters, strict=True)):
        columns, error = _columns(d, x), d.shown - _simulated(d, x, d.voltage)
        wide = np.zeros((len(error), len(names)))
        wide[:, :4], wide[:, 4 + 2 * j : 6 + 2 * j] = columns[:, :4], columns[:, 4:]
        X.append(_whitened(wide, a))
        y.append(_whitened(error, a))
        plain.append((wide, error))
    fit = fit_linear(names, np.concatenate(X), np.concatenate(y))
    use = [names.index(n) for n in fit.names]
    return fit, [error - wide[:, use] @ fit.value for wide, error in plain]


def _whitened(x: F64, a: F64) -> F64:
    """Σ a_j x_{k−j}, the first samples, which have no past, left out."""
    from scipy.signal import lfilter

    return np.asarray(lfilter(a, [1.0], x, axis=0)[len(a) - 1 :])


def _autoregression(residual: F64) -> F64:
    """Coefficients 1, a₁, … of the residual's autoregression (Yule–Walker), shape (order + 1,)."""
    from scipy.linalg import solve_toeplitz

    n, order = len(residual), min(_ORDER, len(residual) // 10)
    r = np.array([residual[k:] @ residual[: n - k] for k in range(order + 1)]) / n
    if r[0] <= 0.0:
        return np.ones(1)
    r[0] *= 1 + 1e-9
    return np.concatenate([[1.0], -solve_toeplitz(r[:-1], r[1:])])


def _start(d: _Piece) -> F64:
    """(log k, log a₁, a₂) of the best of a grid of time constants, on even sampling."""
    from scipy.signal import cont2discrete, lfilter

    period = sample_period(d.time_s)
    shown = d.shown / period if d.is_angle else d.shown[:-1]
    best, x = np.inf, np.zeros(3)
    longest = _LONGEST * float(d.time_s[-1] - d.time_s[0])
    for a1 in np.geomspace(_SHORTEST * period, longest, 16):
        for ratio in (0.02, 0.12, 0.25, 0.6):
            a2 = ratio * a1**2
            b, a, _ = cont2discrete(([1.0], [a2, a1, 1.0]), period)
            made = lfilter(b.ravel(), a, d.voltage)
            made = (made[1:] + made[:-1]) / 2 if d.is_angle else made[:-1]
            A = np.column_stack([made, np.ones_like(made)])
            solution, *_ = np.linalg.lstsq(A, shown, rcond=None)
            cost = float(np.sum((shown - A @ solution) ** 2))
            if cost < best and solution[0] > 0:
                best, x = cost, np.array([np.log(solution[0]), np.log(a1), a2])
    if not np.isfinite(best):
        if not np.ptp(shown):
            raise BadInputError("the shaft does not turn: there is no answer of the speed to the voltage")
        raise BadInputError("the speed does not follow the voltage (no positive gain): is one of the signs wrong?")
    return x
