"""Margins of many sampled loops at once, in plain NumPy: the worst-case search and the daemon's watch need thousands.

The loop is cut at the voltage. L is its return ratio, S = 1 / (1 + L). Margins count only where the closed loop is
stable, which its eigenvalues decide, not the curve.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from servo_daemon.samples import F64
from servo_daemon.tuning.sampled import C128, Controller, SampledMotor, closed_loop

#: Of the frequency grid: decades below Nyquist's frequency, points a decade, and further points in the last decade,
#: where phase runs linearly with frequency.
_DECADES, _PER_DECADE, _LAST = 6, 50, 80


@dataclass(frozen=True, slots=True)
class Margins:
    """One loop's. None: there is no limit in that direction, or, in an unstable loop, nothing to state.

    Attributes:
        stable: the closed loop is.
        gain_margin_dB: by so much the loop's gain may rise. gain_reduction_margin_dB: or fall.
        phase_margin_deg: smallest over all crossovers.
        delay_margin_s: so much more delay is allowed.
        sensitivity_peak: M_s, largest |S|; 1/M_s is the distance of L from −1.
        crossover_hz: highest frequency with |L| = 1.
    """

    stable: bool
    gain_margin_dB: float | None
    gain_reduction_margin_dB: float | None
    phase_margin_deg: float | None
    delay_margin_s: float | None
    sensitivity_peak: float | None
    crossover_hz: float | None


@dataclass(frozen=True, slots=True, eq=False)
class MarginArrays:
    """Of n loops, each shape (n,): gain factors (`up` ≥ 1, `down` ≤ 1), rad, s, 1/M_s, rad/s; and the closed loops'
    spectral radius. Infinity (0 for `down`) where there is no limit."""

    up: F64
    down: F64
    phase_rad: F64
    delay_s: F64
    distance: F64
    crossover_rad_s: F64
    radius: F64

    @property
    def stable(self) -> NDArray[np.bool_]:
        return self.radius < 1.0

    def of(self, k: int) -> Margins:
        """One of them as a record."""
        if not self.stable[k]:
            return Margins(False, None, None, None, None, None, _finite(self.crossover_rad_s[k] / (2 * np.pi)))
        with np.errstate(divide="ignore"):
            return Margins(
                stable=True,
                gain_margin_dB=_finite(20 * np.log10(self.up[k])),
                gain_reduction_margin_dB=_finite(-20 * np.log10(self.down[k])),
                phase_margin_deg=_finite(np.degrees(self.phase_rad[k])),
                delay_margin_s=_finite(self.delay_s[k]),
                sensitivity_peak=_finite(1.0 / self.distance[k]),
                crossover_hz=_finite(self.crossover_rad_s[k] / (2 * np.pi)),
            )


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


@lru_cache(maxsize=8)
def grid(period_s: float) -> F64:
    """Frequencies up to Nyquist's, rad/s, ascending, shape (m,); read-only."""
    nyquist = math.pi / period_s
    low = np.logspace(-_DECADES, 0, _DECADES * _PER_DECADE + 1)
    omega = nyquist * np.unique(np.concatenate((low, np.linspace(0.1, 1.0, _LAST))))
    omega.flags.writeable = False
    return omega


def return_ratio(motor: SampledMotor, controller: Controller, omega: F64) -> C128:
    """L(e^{jωT}), shape (n, len(omega))."""
    z = np.exp(1j * omega * motor.period_s)
    w, i = motor.response(z)
    per_w, per_i, _ = controller.response(z)
    return np.asarray(-(per_w * w + per_i * i))


def margins(motor: SampledMotor, controller: Controller) -> MarginArrays:
    """Margins of the n loops of these motors with one controller."""
    omega = grid(motor.period_s)
    L = return_ratio(motor, controller, omega)
    up, down = _gain_margins(L)
    phase, delay, crossover = _phase_margins(L, omega)
    A, _ = closed_loop(motor, controller)
    radius = np.abs(np.linalg.eigvals(A)).max(axis=1)
    return MarginArrays(up, down, phase, delay, _distance(L), crossover, radius)


def _distance(L: C128) -> F64:
    """Least |1 + L|: at a grid point, or on the chord to one of its neighbours."""
    a, b = 1 + L[:, :-1], 1 + L[:, 1:]
    d = b - a
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.clip(np.nan_to_num(-(a * d.conj()).real / np.square(np.abs(d))), 0.0, 1.0)
    return np.asarray(np.abs(a + t * d).min(axis=1))


def _gain_margins(L: C128) -> tuple[F64, F64]:
    """Factors at which L meets −1, from where it crosses the negative real axis; the end at Nyquist's frequency, where
    L is real, is a crossing too."""
    a, b = L[:, :-1], L[:, 1:]
    crosses = (a.imag > 0) != (b.imag > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = a.imag / (a.imag - b.imag)
        real = np.where(crosses, a.real + t * (b.real - a.real), np.inf)
    real = np.column_stack((real, L[:, -1].real))
    with np.errstate(divide="ignore"):
        factor = np.where(real < 0, -1.0 / real, np.nan)
    up = np.where(factor >= 1, factor, np.inf).min(axis=1)
    down = np.where(factor < 1, factor, 0.0).max(axis=1)
    return up, down


def _phase_margins(L: C128, omega: F64) -> tuple[F64, F64, F64]:
    """(phase, rad; delay, s; highest crossover, rad/s) from where |L| passes 1."""
    level, angle = np.log(np.abs(L)), np.angle(L)
    a, b = level[:, :-1], level[:, 1:]
    crosses = (a > 0) != (b > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(crosses, a / (a - b), 0.0)
    turn = np.angle(L[:, 1:] / L[:, :-1])
    above = np.mod(angle[:, :-1] + t * turn + np.pi, 2 * np.pi)  # angle over the negative real axis, 0 .. 2π
    at = np.exp(np.log(omega[:-1]) + t * np.diff(np.log(omega)))
    phase = np.where(crosses, np.minimum(above, 2 * np.pi - above), np.inf).min(axis=1)
    delay = np.where(crosses, above / at, np.inf).min(axis=1)
    crossover = np.where(crosses, at, 0.0).max(axis=1)
    return phase, delay, np.where(crossover > 0, crossover, np.nan)
