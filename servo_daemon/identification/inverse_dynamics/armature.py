"""The armature's balance as a regression: R, L, K (and the current sensor's offset) from voltage, current and motion.

Over one sample interval, in which v is held and ω changes by Δω, the balance integrates to

    v h = R (∫i − i0 h) + L Δi + K Δθ,     ∫i = h [i_k + a Δi + g K Δω/R],     x = h R/L
    a = 1/(1 − e^{−x}) − 1/x,              g = a [1 − (1 − e^{−x})/x] − ½ + 1/x − (1 − e^{−x})/x²

(exact for a speed that changes evenly), so with (i_k + i_{k+1})/2 for the mean the coefficient of Δi/h is
(R h/2) coth(x/2) instead of L and that of K is Δθ + g h Δω; no signal is interpolated. Without g the R of a motor with
L/R = 0.3 ms and a mechanical time constant of 12 ms comes out 2 % too large at 1 kHz. The current's noise is in the
regressors, so least squares would find too small an L; the instruments are the currents that the voltage makes by the
balance itself, which have none of it (Söderström & Stoica, *Instrumental Variable Methods for System Identification*,
1983).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from servo_daemon.errors import BadInputError
from servo_daemon.identification.inverse_dynamics.filter import Filter
from servo_daemon.parameters import WINDING_NAMES
from servo_daemon.regression.linear_regression import LinearFit, fit_linear, is_determined
from servo_daemon.samples import F64, SampleBlock

#: Rounds in which the instruments are made with the values of the one before (chosen; not tried).
_ROUNDS = 4
#: What is wrong with a voltage does not go with di/dt: for L an error of the model counts so much less (information
#: 12-fold, as in the tracker).
L_WEIGHT = 12.0**0.5
_NAMES = ("R", "L", "K", "one")


@dataclass(frozen=True, slots=True)
class ArmatureFit:
    """`names` of R, L, K, i0 as far as they were found, `value` shape (n,), `covariances` (3, n, n) as in
    `LinearFit`; `fit` is the regression; `measured` voltage and `time_s` of its rows, shapes (w,)."""

    names: tuple[str, ...]
    value: F64
    covariances: F64
    fit: LinearFit
    time_s: F64
    measured: F64

    def get(self, name: str, given: Mapping[str, float]) -> float | None:
        """A parameter as given or found; None where neither, or where the data do not determine it."""
        if name in given:
            return given[name]
        if name not in self.names:
            return None
        k = self.names.index(name)
        value = float(self.value[k])
        return value if is_determined(value, self.covariances[:, k, k], L_WEIGHT if name == "L" else 1.0) else None


def travel(block: SampleBlock) -> F64:
    """Δθ of every interval, shape (n − 1,)."""
    if block.position_rad is not None:
        return np.diff(block.position_rad)
    assert block.velocity_rad_s is not None
    return np.diff(block.time_s) * (block.velocity_rad_s[1:] + block.velocity_rad_s[:-1]) / 2


def made_current(block: SampleBlock, p: Mapping[str, float]) -> F64:
    """The current that the voltage makes at this motion, shape (n,): L di/dt = v − R i − K ω with v − K ω held."""
    from scipy.signal import lfilter

    assert block.voltage_V is not None
    h = np.diff(block.time_s)
    level = (block.voltage_V[:-1] - p["K"] * travel(block) / h) / p["R"]
    decay = float(np.exp(-np.median(h) * p["R"] / p["L"])) if p.get("L", 0.0) > 0.0 else 0.0
    out, _ = lfilter([1.0 - decay], [1.0, -decay], level, zi=[decay * level[0]])
    return np.concatenate([level[:1], out])


@dataclass(frozen=True, slots=True)
class Lag:
    """a and g of the balance over an interval: ½ and 0 for a slow winding, 1 and ½ for one faster than the sampling."""

    a: float
    g: float

    @classmethod
    def of(cls, R: float, L: float, period_s: float) -> Lag:
        """L = 0: faster than the sampling."""
        x = min(max(period_s * R / L, 1e-2), 1e3) if L > 0.0 else 1e3
        gone = float(-np.expm1(-x))
        a = 1.0 / gone - 1.0 / x
        return cls(a, a * (1.0 - gone / x) - 0.5 + 1.0 / x - gone / x**2)

    def mean_current(self, block: SampleBlock, current: F64, K_over_R: float) -> F64:
        """Mean of every interval, shape (n − 1,), A."""
        curved = self.g * K_over_R * np.gradient(travel(block)) / np.diff(block.time_s)
        return np.asarray(current[:-1] + self.a * np.diff(current) + curved)


def fit_armature(
    pieces: Sequence[SampleBlock], f: Filter, given: Mapping[str, float], with_offset: bool
) -> ArmatureFit:
    """Regression over uninterrupted pieces.

    Raises:
        BadInputError: the capture is too short, or no motor has such voltages and currents.
    """
    free = [n for n in WINDING_NAMES if n not in given] + (["one"] if with_offset and "i0" not in given else [])
    period = 1.0 / f.rate_Hz
    raw = [np.column_stack([_held_volts(b, period), b.time_s[:-1]]) for b in pieces]
    volts, times = np.concatenate([f.decimate(r) for r in raw]).T
    known = [given.get("R", 0.0), _lag_given(given, period), given.get("K", 0.0)]
    known += [-given.get("R", 0.0) * given.get("i0", 0.0)]
    at = [_NAMES.index(n) for n in free]

    def table(current: Callable[[SampleBlock], F64], g: float) -> F64:
        return np.concatenate([f.decimate(_columns(b, current(b), g, period)) for b in pieces])

    X = table(_measured, 0.0)
    fit = fit_linear(free, X[:, at], volts - X @ known)
    for _ in range(_ROUNDS):
        p = {"L": 0.0} | dict(zip(fit.names, map(float, fit.value), strict=True)) | dict(given)
        if "K" not in p or not ("R" in given or fit.is_seen("R")):
            break  # instruments made with such numbers would be worse than none
        if "L" not in given:
            p["L"] = inductance(p["L"], p["R"], period)[0]
        g = Lag.of(p["R"], p["L"], period).g
        X, Z = table(_measured, g), table(partial(made_current, p=p), g)
        fit = fit_linear(free, X[:, at], volts - X @ known, Z[:, at])
    names = tuple("i0" if n == "one" else n for n in fit.names)
    return ArmatureFit(names, *_natural(fit, given, period), fit, times, volts)


def _measured(block: SampleBlock) -> F64:
    assert block.current_A is not None
    return block.current_A


def _columns(block: SampleBlock, current: F64, g: float, period_s: float) -> F64:
    """Mean current, Δi, Δθ + g h Δω and 1 per period, shape (n − 1, 4); a row weighs as long as its interval lasts."""
    h, way = np.diff(block.time_s) / period_s, travel(block)
    mean = (current[1:] + current[:-1]) / 2
    return np.column_stack([h * mean, np.diff(current) / period_s, (way + g * np.gradient(way)) / period_s, h])


def _held_volts(block: SampleBlock, period_s: float) -> F64:
    assert block.voltage_V is not None
    return np.asarray(block.voltage_V[:-1] * np.diff(block.time_s) / period_s)


def _lag_given(given: Mapping[str, float], period_s: float) -> float:
    """The coefficient of Δi/h where L is given (without R: that of a slow winding)."""
    if "L" not in given or "R" not in given:
        return given.get("L", 0.0)
    half = given["R"] * period_s / 2
    return float(half / np.tanh(half / given["L"]))


def inductance(coefficient: float, R: float, period_s: float) -> tuple[float, float]:
    """L from the coefficient of Δi/h, and its derivative; (0, 0) where L/R is too far below the period to show."""
    half = R * period_s / 2
    if coefficient <= half * (1 + 1e-9):
        return 0.0, 0.0
    L = half / np.arctanh(half / coefficient)
    return float(L), float(L**2 / (coefficient**2 - half**2))


def _natural(fit: LinearFit, given: Mapping[str, float], period_s: float) -> tuple[F64, F64]:
    """(R, L, K, i0) from the coefficients and their covariances, errors to first order."""
    value, by = fit.value.copy(), np.eye(len(fit.value))
    at = {n: k for k, n in enumerate(fit.names)}
    R = float(value[at["R"]]) if "R" in at else given.get("R", 0.0)
    if R <= 0.0 and "R" in at and not fit.is_unclear("R"):
        raise BadInputError(
            f"voltage and current of this capture give R = {R:.4g} Ω: is the current's sign right, and is the voltage "
            "the one that was applied?"
        )
    if "L" in at and R > 0.0:
        k = at["L"]
        c = float(value[k])
        value[k], by[k, k] = inductance(c, R, period_s)
        if "R" in at:
            d = 1e-6 * R
            by[k, at["R"]] = (inductance(c, R + d, period_s)[0] - inductance(c, R - d, period_s)[0]) / (2 * d)
    if "one" in at and R > 0.0:  # the constant is −R i0
        k = at["one"]
        by[k, k] = -1.0 / R
        if "R" in at:
            by[k, at["R"]] = value[k] / R**2
        value[k] = -value[k] / R
    return value, by @ fit.covariances @ by.T
