"""The angle of a motor's shaft out of a VESC's `pid_pos` and tachometer.

With an encoder `pid_pos` is the mechanical angle, 0 … 360°. Without one the firmware sends the electrical angle there,
which is the shaft's angle times the pole pairs. The tachometer counts six steps an electrical turn whatever there is,
so how far the two go together tells which it is: the same distance, or a fraction of it.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from drivers.can.unwrap import WrappedPosition
from servo_daemon.samples import F64

Source = Literal["auto", "encoder", "electrical"]

#: Tachometer steps an electrical turn.
STEPS = 6.0
#: The motor must have been at so many steps before it is decided: one electrical turn.
_ENOUGH_STEPS = 6
#: How well `pid_pos` keeps its distance from the tachometer's angle (1: it does). An electrical angle spreads over the
#: one step by which the tachometer is coarse: 0.95. An encoder's over half a turn or more: at most 0.64.
_KEEPS_ITS_DISTANCE = 0.8
#: Degrees of `pid_pos` a step: of one pole pair (also of an electrical angle), of two, …; then the same backward.
_SLOPES = np.outer((1.0, -1.0), 360.0 / STEPS / np.arange(1, 101)).ravel()
#: The better direction must keep its distance so much better than the other: half a turn of motion gives that.
_APART = 0.3
#: Pole pairs are known once a step is less than this share of one; configured ones are contradicted at a quarter of it.
_KNOWN, _SURE = 0.4, 0.1
#: The tachometer is an int32.
_TACHOMETER_WRAP = 2.0**32


class Shaft:
    """One drive's angle, continuous.

    Args:
        source: what `pid_pos` is, if it is known.
        pole_pairs: needed where it is the electrical angle.
        inverted: the encoder counts against the electrical direction (only with `source = "encoder"`: otherwise found).

    Attributes:
        source: `encoder` or `electrical` once it is known, else `auto`.
        inverted: as found.
        degrees: an encoder's.
    """

    def __init__(self, source: Source, pole_pairs: int | None, inverted: bool = False) -> None:
        self._told, self._pole_pairs, self._told_inverted = source, pole_pairs, inverted
        told = source != "auto" or pole_pairs is not None
        self._shown = Shaft("auto", None) if told else None  # what the motion shows of what was told
        self.restart()

    def restart(self) -> None:
        """The next values may be another motor's."""
        self.source, self.inverted = self._told, self._told_inverted
        self._steps = WrappedPosition(_TACHOMETER_WRAP)
        self.degrees = _Guided(0.0 if self._pole_pairs is None else 360.0 / STEPS / self._pole_pairs)
        self._offset: float | None = None
        if self._shown is not None:
            self._shown.restart()
        self._seen: dict[float, float] = {}  # step: degrees

    @property
    def remark(self) -> str | None:
        """In words, why there is no angle."""
        if self.contradiction is not None:
            return self.contradiction
        if self.source == "auto":
            return "the motor has to turn a little before it is known whether it has an encoder (option position)"
        if self.source == "electrical" and self._pole_pairs is None:
            return "it has no encoder: option pole_pairs is needed"
        return None

    @property
    def contradiction(self) -> str | None:
        """What was told and cannot be."""
        shown = self._shown
        if shown is None or shown.source == "auto":
            return None
        if self._told not in ("auto", shown.source) and self._pole_pairs != 1:  # of one pole pair both are the same
            return (
                f'the motion shows that its position is "{shown.source}", not "{self._told}": correct the option '
                "position (a motor of one pole pair needs pole_pairs = 1)"
            )
        pairs = shown.degrees.pole_pairs_to(_SURE) if shown.source == "encoder" else None
        if self._pole_pairs is not None and pairs not in (None, self._pole_pairs):
            return (
                f"the motion shows {pairs} pole pairs, not {self._pole_pairs}: correct pole_pairs (behind a gear leave "
                "it out)"
            )
        return None

    @property
    def pole_pairs(self) -> int | None:
        """As told, else as an encoder's angle and the tachometer have shown; None: not known (yet)."""
        return self._pole_pairs or (self.degrees.pole_pairs_to(_KNOWN) if self.source == "encoder" else None)

    def angle(self, pid_pos_deg: F64, tachometer: F64) -> F64 | None:
        """The shaft's angle in rad for the next values, shapes (n,); None while it is not known what they are."""
        if self._shown is not None:
            self._shown.angle(pid_pos_deg, tachometer)
            if self.contradiction is not None:
                return None
        steps = self._steps.unwrap(tachometer)
        if self.source == "auto":
            self._decide(steps, pid_pos_deg)
            return None
        if self.source == "electrical":
            if self._pole_pairs is None:
                return None
            return self._electrical(pid_pos_deg, steps) / self._pole_pairs
        return np.radians(self.degrees.unwrap(pid_pos_deg, steps)) * (-1.0 if self.inverted else 1.0)

    def _electrical(self, degrees: F64, steps: F64) -> F64:
        """Electrical angle, rad: the turns are the tachometer's, which does not miss any between two polls."""
        turns = degrees / 360.0
        if self._offset is None:
            self._offset = float(steps[0] / STEPS - turns[0])
        return 2.0 * math.pi * (turns + np.rint(steps / STEPS - turns - self._offset))

    def _decide(self, steps: F64, degrees: F64) -> None:
        """Which share of an electrical turn, with which sign, `pid_pos` goes on by for a step of the tachometer: that
        with which it keeps its distance from them. Turns are of no account, so that none in a pause is missed."""
        self._seen |= dict(zip(steps.tolist(), degrees.tolist(), strict=True))
        if len(self._seen) <= _ENOUGH_STEPS:
            return
        step, degree = np.array(tuple(self._seen.items())).T
        apart = np.radians(degree[:, None] - (step - step[0])[:, None] * _SLOPES)
        kept = np.abs(np.exp(1j * apart).mean(axis=0))
        best = int(np.argmax(kept))
        if _SLOPES[best] != _SLOPES[0] and kept[best] - kept[np.sign(_SLOPES) != np.sign(_SLOPES[best])].max() < _APART:
            return  # the motion is too short to tell forward from backward
        electrical = kept[0] > _KEEPS_ITS_DISTANCE
        self.source = "electrical" if electrical else "encoder"
        self.inverted = not electrical and bool(_SLOPES[best] < 0.0)
        self.degrees.begin(float(_SLOPES[best]))
        self._seen.clear()


class _Guided:
    """An encoder's angle in degrees, continued over its wraps by how far the tachometer went: after a pause of the host
    the shaft may have gone on by several turns.

    Args:
        degrees_a_step: of the tachometer, without its sign, if it is known; 0: it is found from the motion.
    """

    def __init__(self, degrees_a_step: float) -> None:
        self._told = degrees_a_step
        self._slope = 0.0  # with its sign, as found so far
        self._from: tuple[float, float] | None = None  # steps and degrees at the start
        self._longest = _ENOUGH_STEPS - 1.0
        self._last = (0.0, 0.0)
        self._turns = 0.0

    def begin(self, slope: float) -> None:
        """What comes is continued with so many degrees a step, until a longer way tells it better."""
        self._slope = math.copysign(self._told, slope) if self._told else slope

    def pole_pairs_to(self, share: float) -> int | None:
        """By the longest way so far, once one step of it is less than this share of a pole pair; None before."""
        pairs = 360.0 / STEPS / abs(self._slope) if self._slope else math.inf
        return round(pairs) if pairs / self._longest < share else None

    def unwrap(self, degrees: F64, steps: F64) -> F64:
        """The next values, shapes (n,)."""
        if self._from is None:
            self._from = self._last = float(steps[0]), float(degrees[0])
        went = np.diff(degrees, prepend=self._last[1])
        expected = self._slope * np.diff(steps, prepend=self._last[0])
        turns = self._turns - np.cumsum(np.rint((went - expected) / 360.0))
        self._last, self._turns = (float(steps[-1]), float(degrees[-1])), float(turns[-1])
        continued: F64 = degrees + 360.0 * turns
        self._learn(continued, steps)
        return continued

    def _learn(self, continued: F64, steps: F64) -> None:
        """The longest way so far tells best how far a step is."""
        assert self._from is not None
        span = steps - self._from[0]
        at = int(np.argmax(np.abs(span)))
        if abs(span[at]) > self._longest:
            self._longest = abs(float(span[at]))
            self._slope = float(continued[at] - self._from[1]) / float(span[at])
            if self._told:
                self._slope = math.copysign(self._told, self._slope)
