"""Lays sample blocks out for the filter and the regressions."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servo_daemon.conditioning.filled import filled
from servo_daemon.conditioning.gaps import GAP, RESTART, gaps, short_gaps
from servo_daemon.conditioning.layout_step import NEVER, NO_VALUE, LayoutStep, build_layout_step
from servo_daemon.plant.compiled import SampleLoop
from servo_daemon.plant.core import Drive
from servo_daemon.regression.stretch import Stretch
from servo_daemon.samples import F64, Quality, SampleBlock

Mask = NDArray[np.bool_]

INVALID_BIT = {
    "voltage_V": int(Quality.VOLTAGE_INVALID),
    "current_A": int(Quality.CURRENT_INVALID),
    "position_rad": int(Quality.POSITION_INVALID),
    "velocity_rad_s": int(Quality.POSITION_INVALID),
    "torque_Nm": int(Quality.CURRENT_INVALID),
}
#: So many samples of a current alike, or of a speed, are no accident of its noise (chosen; not tried).
_FEWEST_ALIKE = 8
#: Beyond this a value is no measurement of a servo drive, whatever the drive says; and no square of it overflows.
_IMPOSSIBLE = {
    "voltage_V": 1e5,
    "current_A": 1e5,
    "position_rad": 1e12,  # years at any speed: it is counted on from turn to turn
    "velocity_rad_s": 1e7,
    "torque_Nm": 1e7,
}
INPUT: dict[Drive, str] = {"voltage": "voltage_V", "current": "current_A", "torque": "torque_Nm"}


def channel(block: SampleBlock, name: str) -> tuple[F64, NDArray[np.bool_] | None]:
    """Values (0 where they are no measurement) and validity of a channel; None where all are valid."""
    values: F64 = getattr(block, name)
    limit = _IMPOSSIBLE[name]
    # The usual case; a NaN compares to nothing.
    if block.all_good and np.maximum.reduce(values) <= limit and np.minimum.reduce(values) >= -limit:
        return values, None
    valid = np.abs(values) <= limit
    valid &= (block.quality & INVALID_BIT[name]) == 0
    return np.where(valid, values, 0.0), valid


@dataclass(slots=True)
class Repetition:
    """How often a channel has shown one value: a current that no longer flickers is not measured any more.

    Attributes:
        least: from how many samples alike on it is so.
    """

    least: int
    _last: float = math.nan
    _same: int = 0

    @property
    def alike(self) -> int:
        """How many values alike there have been last; 0 below `least`."""
        return self._same if self._same >= self.least else 0

    def lengths(self, values: F64) -> F64 | None:
        """How many samples alike there have been up to each one, shape (n,); None where it is below `least`
        throughout."""
        n = len(values)
        moved = np.empty(n, dtype=bool)
        moved[0] = float(values[0]) != self._last
        np.not_equal(values[1:], values[:-1], out=moved[1:])
        self._last = float(values[-1])
        alike = n - int(np.count_nonzero(moved))
        before = self._same
        if alike == 0 or alike + max(before, 1) < self.least:
            self._same = 1 + (before + n - 1 if alike == n else int(moved[::-1].argmax()))
            return None
        index = np.arange(1.0, n + 1.0)
        # Up to each sample's last move, or to where the run that goes on began in an earlier block.
        same: F64 = index - np.maximum.accumulate(np.where(moved, index - 1.0, -float(before)))
        self._same = int(same[-1])
        return same


@dataclass(frozen=True, slots=True)
class Marked:
    """What a `Layout` remembers between rows, to go back to."""

    state: F64
    last_s: float | None


class Layout:
    """Lays blocks out as the filter's sample rows; remembers what the next row needs of the last.

    Args:
        drive: what the input is.
        measured: the filter's channels.

    Attributes:
        last_s: time of the last sample; None before the first.
        origin_s: the filter's time is counted from here.
        position_lsb: the encoder's step; 0: it has none, or is not known yet.
    """

    def __init__(self, drive: Drive, measured: tuple[str, ...]) -> None:
        self._names = (INPUT[drive], *measured)
        self._lay = LayoutStep(len(measured), drive == "voltage")
        self._loop = SampleLoop(build_layout_step(len(measured), drive == "voltage"))
        self._state, self._constants = np.zeros(self._lay.n_state), np.zeros(self._lay.n_constants)
        self._constants[3::4] = [_IMPOSSIBLE[name] for name in self._names]
        self._constants[6::4] = math.inf
        # Where the limit of a measured current's spikes is.
        self._current = 6 + 4 * self._names.index("current_A") if "current_A" in measured else None
        self.last_s: float | None = None
        self.origin_s = 0.0
        self.position_lsb = 0.0
        self._doubt((NEVER,) * len(self._names), 0.0, 0.0)

    @property
    def last_input(self) -> float:
        """The last input that was known."""
        return float(self._state[1])

    def expect_steps(self, position_lsb: float, input_lsb: float) -> None:
        """From now on repeated values are doubted.

        Args:
            position_lsb: the encoder's step; 0: it has none, and may well stand still.
            input_lsb: step of the recorded input; 0: it has none.
        """
        self.position_lsb = position_lsb
        standing = 2 if position_lsb > 0 else NEVER
        least = tuple(standing if name == "position_rad" else _FEWEST_ALIKE for name in self._names[1:])
        self._doubt((NEVER, *least), position_lsb, input_lsb**2 / 12.0)

    def resume(self, time_s: float) -> None:
        """The next sample is the first one after a gap: nothing before it says whether it is a spike."""
        self.last_s = time_s
        self._state[4 : self._lay.curve : 3] = NO_VALUE

    def mark(self) -> Marked:
        """Where it is now, to come `back_to`."""
        return Marked(self._state.copy(), self.last_s)

    def back_to(self, marked: Marked) -> None:
        """The next samples are those that came after it was there."""
        self._state[:], self.last_s = marked.state, marked.last_s

    def _doubt(self, least: tuple[float, ...], position_lsb: float, input_step_var: float) -> None:
        """From how many values alike on each channel is doubted; no value has been seen yet."""
        self._constants[1] = input_step_var
        self._constants[4::4] = [0.5 * position_lsb if name == "position_rad" else 0.0 for name in self._names]
        self._constants[5::4] = least
        last, alike, before = (slice(k, self._lay.curve, 3) for k in (2, 3, 4))
        self._state[last], self._state[alike], self._state[before] = NO_VALUE, 0.0, NO_VALUE

    def rows(
        self,
        block: SampleBlock,
        unknown_input_var: float,
        new: Mask | None = None,
        new_var: float = 0.0,
        spike_limit: float = math.inf,
        current_spike_limit: float = math.inf,
    ) -> F64:
        """shape (n, n_sample), as `kalman.layout.EkfLayout` has a sample

        Args:
            unknown_input_var: added variance where the input is not known and the last one is held.
            new: samples that were put in (`filled`), of which nothing was measured; shape (n,); None: none were.
            new_var: added variance of their input.
            spike_limit: the largest change by which the input goes and comes back in a sample; beyond, it was misread.
            current_spike_limit: the same of a measured current.
        """
        samples = self._loop.room(len(block))  # every value valid
        samples[:, 0] = block.time_s
        for k, name in enumerate(self._names):
            samples[:, 1 + 2 * k] = getattr(block, name)
        if not block.all_good:
            for k, name in enumerate(self._names):
                samples[:, 2 + 2 * k] = (block.quality & INVALID_BIT[name]) == 0
        if new is not None:
            samples[new, 4::2] = 0.0
        self._state[0] = block.time_s[0] if self.last_s is None else self.last_s
        self._constants[0], self._constants[2] = self.origin_s, unknown_input_var
        self._constants[6] = spike_limit
        if self._current is not None:
            self._constants[self._current] = current_spike_limit
        out = self._loop.run(self._state, self._constants, samples)
        if not block.all_good or new is not None:
            samples[:, 2::2] = 1.0
        if new is not None:
            out[new, 3] += new_var
        self.last_s = float(block.time_s[-1])
        return out


def with_mean_motion(block: SampleBlock, before: SampleBlock | None) -> SampleBlock:
    """Samples whose current is a mean over the interval before each, as integrals by the trapezoidal rule take them.

    That rule has the mean of two neighbouring currents between two samples. With the mean of two neighbouring angles
    and times beside it both sides of the shaft's balance have gone through the same average, and it holds as before.

    Args:
        before: the samples before them; None: there are none.
    """
    broken = (block.quality & (GAP | RESTART)) != 0

    def averaged(name: str) -> F64 | None:
        values: F64 | None = getattr(block, name)
        if values is None:
            return None
        earlier = None if before is None else getattr(before, name)
        previous = np.concatenate([values[:1] if earlier is None else earlier[-1:], values[:-1]])
        return np.where(broken, values, 0.5 * (values + previous))

    motion: dict[str, Any] = {name: averaged(name) for name in ("time_s", "position_rad", "velocity_rad_s")}
    return replace(block, current_mean=False, **motion)


class Stretches:
    """Blocks as the regressions take them; remembers how long a current has shown one value."""

    def __init__(self) -> None:
        self._frozen = {name: Repetition(_FEWEST_ALIKE) for name in ("current_A", "velocity_rad_s")}
        self._last: SampleBlock | None = None  # the block before
        self._turned = False  # a speed that has been zero since the first sample is a standstill's

    def alike(self, name: str) -> int:
        """For how many samples the channel has shown one value; 0 while it flickers."""
        return self._frozen[name].alike

    def _without_short_gaps(self, block: SampleBlock, last_s: float | None, period_s: float | None) -> SampleBlock:
        last, self._last = self._last, block
        short = [] if period_s is None else short_gaps(block, last_s, period_s)
        if not short or period_s is None:
            return block
        return filled(block, None if last is None else last.end, short, period_s)[0]

    def of(self, block: SampleBlock, origin_s: float, last_s: float | None, period_s: float | None) -> Stretch:
        """The block for the regressions, its short gaps filled. Samples after a long gap, with an invalid channel or a
        frozen one are not usable.

        Args:
            origin_s: time is counted from here.
            last_s, period_s: as for `gaps`.
        """
        before = self._last
        block = self._without_short_gaps(block, last_s, period_s)
        if block.current_mean:
            block = with_mean_motion(block, before)
        usable = np.ones(len(block), dtype=bool) if block.all_good else (block.quality & RESTART) == 0
        holes = gaps(block, last_s, period_s)
        gap = None
        if holes:
            usable[[k for k, short in holes.items() if not short]] = False
            gap = np.zeros(len(block), dtype=bool)
            gap[list(holes)] = True
        signals: dict[str, F64 | None] = {}
        complete = True
        for name in ("voltage_V", "current_A", "torque_Nm", "position_rad", "velocity_rad_s"):
            if getattr(block, name) is None:
                signals[name] = None
                continue
            values, valid = channel(block, name)
            signals[name] = values
            if valid is not None:
                usable &= valid
                complete = False
            frozen = self._frozen.get(name)
            if frozen is not None and (same := frozen.lengths(values)) is not None:
                stands = name == "velocity_rad_s" and not self._turned
                usable &= (same < _FEWEST_ALIKE) | (stands & (values == 0.0))
            self._turned |= name == "velocity_rad_s" and bool(values.any())
        return Stretch(
            block.time_s - origin_s,
            usable,
            signals["voltage_V"],
            signals["current_A"],
            signals["torque_Nm"],
            signals["position_rad"],
            signals["velocity_rad_s"],
            complete,
            gap,
        )
