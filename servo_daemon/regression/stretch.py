"""Consecutive samples as the regressions take them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from servo_daemon.regression.modulating import Windows
from servo_daemon.samples import F64


@dataclass(frozen=True, slots=True)
class Stretch:
    """Time since some start (s), which samples may be used, and the signals there are (0 where they are no
    measurement); shapes (n,). `complete`: all of them are measurements. `gap`: before which samples others are missing;
    None: none are."""

    time_s: F64
    usable: NDArray[np.bool_]
    voltage: F64 | None
    current: F64 | None
    torque: F64 | None
    position: F64 | None
    velocity: F64 | None
    complete: bool = True
    gap: NDArray[np.bool_] | None = None

    @property
    def sliding(self) -> F64:
        """Direction of motion per sample, 0 where the speed is within the noise of its own difference."""
        if self.velocity is not None:
            return np.asarray(np.sign(self.velocity))
        assert self.position is not None
        return np.asarray(np.sign(_across(self.position)))

    @property
    def speed(self) -> F64:
        """rad/s per sample, from a difference across ten samples where only the angle is measured: for terms that
        follow the speed in no way that integration by parts could take from the angle."""
        if self.velocity is not None:
            return self.velocity
        assert self.position is not None
        return _across(self.position) / np.maximum(_across(self.time_s), 1e-12)

    @property
    def angle(self) -> F64:
        """rad per sample; zeros where it is not measured."""
        return np.zeros_like(self.time_s) if self.position is None else self.position

    @property
    def effort(self) -> F64:
        """The torque, N·m, where that is measured, else the current, A, or zeros."""
        effort = self.current if self.torque is None else self.torque
        return np.zeros_like(self.time_s) if effort is None else effort


def joined(parts: Sequence[Stretch]) -> Stretch:
    """Stretches with the same signals, one after the other, as one."""
    if len(parts) == 1:
        return parts[0]

    def both(name: str) -> F64 | None:
        arrays = [x for p in parts if (x := getattr(p, name)) is not None]
        return np.concatenate(arrays) if arrays else None

    return Stretch(
        np.concatenate([p.time_s for p in parts]),
        np.concatenate([p.usable for p in parts]),
        both("voltage"),
        both("current"),
        both("torque"),
        both("position"),
        both("velocity"),
        all(p.complete for p in parts),
        _joined_gaps(parts),
    )


def _joined_gaps(parts: Sequence[Stretch]) -> NDArray[np.bool_] | None:
    if all(p.gap is None for p in parts):
        return None
    return np.concatenate([np.zeros(len(p.time_s), dtype=bool) if p.gap is None else p.gap for p in parts])


def last(s: Stretch, n: int) -> Stretch:
    """The last n samples."""

    def cut(x: F64 | None) -> F64 | None:
        return None if x is None else x[-n:]

    signals = (cut(s.voltage), cut(s.current), cut(s.torque), cut(s.position), cut(s.velocity))
    return Stretch(s.time_s[-n:], s.usable[-n:], *signals, s.complete, None if s.gap is None else s.gap[-n:])


def motion(w: Windows, s: Stretch) -> tuple[F64, F64]:
    """∫φ ω and ∫φ dω/dt, from the position if there is one."""
    if s.position is not None:
        speed, acceleration = w.integrals(s.position - s.position[0], 1, 2)
        return -speed, acceleration
    assert s.velocity is not None
    speed, acceleration = w.integrals(s.velocity, 0, 1)
    return speed, -acceleration


def _across(values: F64) -> F64:
    """From five samples before to five after each."""
    reach = min(5, len(values) // 2)
    ahead = np.concatenate([values[reach:], np.full(reach, values[-1])])
    behind = np.concatenate([np.full(reach, values[0]), values[:-reach]])
    return np.asarray(ahead - behind)


def between_samples(s: Stretch, rest: float) -> Stretch:
    """With the current as its mean around each sample would be seen by the trapezoidal rule.

    Args:
        rest: share of the step to the next sample that comes on top of the rule's half.
    """
    if s.current is None or rest == 0.0:
        return s
    current = s.current.copy()
    current[:-1] += rest * (s.current[1:] - s.current[:-1])
    return replace(s, current=current)
