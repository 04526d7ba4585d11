"""Steady state of a capture: sections of constant voltage, current and speed, and what to do without them.

    K = (v − R i)/ω        B = K i/ω                  in a steady section
    v − R i = K ω + L Δi/T        i = (B/K) ω + (J/K) Δω/T    over any section of length T, all means

The second pair is exact for any motion (the balances, integrated), so sections that are only slow serve as well; their
derivatives are fitted along and thrown away.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from servo_daemon.errors import BadInputError
from servo_daemon.identification.inverse_dynamics.armature import travel
from servo_daemon.identification.inverse_dynamics.signals import pieces
from servo_daemon.numerics import sample_period
from servo_daemon.regression.linear_regression import ROBUST, LinearFit, fit_linear
from servo_daemon.samples import F64, SampleBlock

#: A section lasts so many times the sum of the time constants, and has at least so many samples.
_LENGTH, _FEWEST_SAMPLES = 4.0, 20
#: Steady: the voltage within it varies, and the speed drifts, by no more than these parts (rms, per section), and no
#: more than this part of the current accelerates.
_VOLTAGE_VARIES, _DRIFTS, _ACCELERATES = 0.05, 0.01, 0.01
#: ... at no less than this part of the greatest speed.
_MOVES = 0.05
#: Fewer sections are too few to see how much they differ.
_FEWEST_SECTIONS = 5


@dataclass(frozen=True, slots=True)
class SteadyState:
    """K and B for a given R.

    Attributes:
        K: N·m/A. B: N·m·s/rad.
        covariance: of (K, B), shape (2, 2).
        source: "steady" sections, or merely "slow" ones, their acceleration taken into account.
        sections: how many.
    """

    K: float
    B: float
    covariance: F64
    source: Literal["steady", "slow"]
    sections: int


@dataclass(frozen=True, slots=True)
class _Sections:
    """Means over each, and changes per second from its first to its last tenth; shapes (s,)."""

    voltage: F64
    current: F64
    speed: F64
    current_rate: F64
    speed_rate: F64
    voltage_spread: F64
    length_s: float

    def steady(self, current_per_acceleration: float) -> NDArray[np.intp]:
        """Indices of those that are; J/K, A per rad/s²."""
        moves = np.abs(self.speed) >= _MOVES * np.max(np.abs(self.speed))
        held = self.voltage_spread <= _VOLTAGE_VARIES * np.abs(self.voltage)
        even = np.abs(self.speed_rate) * self.length_s <= _DRIFTS * np.abs(self.speed)
        idle = np.abs(current_per_acceleration * self.speed_rate) <= _ACCELERATES * np.abs(self.current)
        return np.flatnonzero(moves & held & even & idle)


def steady_state(blocks: Sequence[SampleBlock], R: float, sum_s: float) -> SteadyState:
    """K and B from whole captures.

    Args:
        R: Ω, given.
        sum_s: τ₁ + τ₂ of the motor, s: how long a section must be.

    Raises:
        BadInputError: current or voltage is missing, the motor never turns, or R is too large for this capture.
    """
    parts = [_cut(p, sum_s) for block in blocks for p in pieces(block)]
    columns = np.concatenate([part for part in parts if part is not None] or [np.empty((0, 7))])
    if len(columns) < _FEWEST_SECTIONS:
        raise BadInputError(
            f"the capture has no {_FEWEST_SECTIONS} sections of {_length_s(sum_s, blocks[0]):.3g} s without a gap: too "
            "short for a steady state"
        )
    voltage, current, speed, current_rate, speed_rate, spread, lengths = columns.T
    s = _Sections(voltage, current, speed, current_rate, speed_rate, spread, float(lengths[0]))
    if np.max(np.abs(s.speed)) <= 0.0:
        raise BadInputError("the motor never turns in this capture: no steady state gives K and B")
    everything = np.arange(len(s.speed))
    slow = _ratio(s, everything, s.current, s.speed_rate)
    chosen = s.steady(float(slow.value[-1])) if len(slow.names) == 2 else everything
    if len(chosen) >= _FEWEST_SECTIONS:
        back_emf = s.voltage - R * s.current
        return _made(_ratio(s, chosen, back_emf), _ratio(s, chosen, s.current), R, "steady", len(chosen))
    return _made(_ratio(s, everything, s.voltage - R * s.current, s.current_rate), slow, R, "slow", len(everything))


def _ratio(s: _Sections, at: NDArray[np.intp], y: F64, rate: F64 | None = None) -> LinearFit:
    """y per speed, with a rate fitted along."""
    columns = [s.speed[at]] if rate is None else [s.speed[at], rate[at]]
    return fit_linear(("speed", "rate")[: len(columns)], np.column_stack(columns), y[at])


def _made(
    back_emf: LinearFit, current: LinearFit, R: float, source: Literal["steady", "slow"], sections: int
) -> SteadyState:
    if any("speed" not in fit.names for fit in (back_emf, current)):
        raise BadInputError("speed and acceleration go together: the capture has no steady state, nor a slow one")
    K, ratio = float(back_emf.value[0]), float(current.value[0])
    if K <= 0.0:
        raise BadInputError(
            f"R = {R:g} Ω leaves no back-EMF in this capture (K = {K:.3g}): the assumed R is too large, or a sign wrong"
        )
    by = np.array([[1.0, 0.0], [ratio, K]])  # (K, B = K · ratio)
    variances = np.diag([fit.covariances[ROBUST, 0, 0] for fit in (back_emf, current)])
    return SteadyState(K, K * ratio, by @ variances @ by.T, source, sections)


def _length_s(sum_s: float, block: SampleBlock) -> float:
    return max(_LENGTH * sum_s, _FEWEST_SAMPLES * sample_period(block.time_s))


def _cut(block: SampleBlock, sum_s: float) -> F64 | None:
    """Sections of an uninterrupted piece as rows (voltage, current, speed, di/dt, dω/dt, spread of v, length)."""
    if block.voltage_V is None or block.current_A is None:
        raise BadInputError("K and B from the steady state need voltage and current: this capture lacks one of them")
    if len(block) < 2:
        return None
    length_s = _length_s(sum_s, block)
    n = round(length_s / sample_period(block.time_s))
    count = (len(block) - 1) // n
    if count < 1:
        return None
    h = np.diff(block.time_s)[: count * n].reshape(count, n)
    way = travel(block)[: count * n].reshape(count, n)
    i, v = block.current_A, block.voltage_V[: count * n].reshape(count, n)
    middle = ((i[1:] + i[:-1]) / 2)[: count * n].reshape(count, n)
    T = h.sum(axis=1)
    voltage = (v * h).sum(axis=1) / T
    tenth = max(2, n // 10)
    apart = T * (1 - tenth / n)
    speed = [way[:, part].sum(axis=1) / h[:, part].sum(axis=1) for part in (slice(0, tenth), slice(n - tenth, n))]
    current = [middle[:, part].mean(axis=1) for part in (slice(0, tenth), slice(n - tenth, n))]
    return np.column_stack(
        [
            voltage,
            (middle * h).sum(axis=1) / T,
            way.sum(axis=1) / T,
            (current[1] - current[0]) / apart,
            (speed[1] - speed[0]) / apart,
            np.sqrt(((v - voltage[:, None]) ** 2).mean(axis=1)),
            T,
        ]
    )
