"""A simulated motor that runs by the clock, and what its sensors show at an instant."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from servo_daemon.sim_drive.makes.foc import RunningFoc
from servo_daemon.sim_drive.source import MAX_BEHIND_S, SampleSource

#: The q axis's power is 1.5 v i.
DQ_VOLTAGE = 1.5
#: A sample whose time has come counts, whatever the rounding of that time.
_ROUNDING = 1e-6


@dataclass(frozen=True, slots=True)
class Shown:
    """The last sample before an instant: V, A, rad, rad/s, N·m of the motor, and its own time, s."""

    time_s: float
    voltage_V: float
    current_A: float
    position_rad: float
    velocity_rad_s: float


class Motor(Protocol):
    """A simulated motor that can be asked what its sensors show."""

    def now(self) -> Shown:
        """What its sensors show now."""
        ...


class FocMotor:
    """A motor under field-oriented control. Voltage and current are those of the DC motor whose torque constant is per
    ampere of iq (`kt`, servo_daemon/signal_meaning.py): v = 1.5 vq, i = iq."""

    def __init__(self, foc: RunningFoc) -> None:
        self._foc = foc

    def now(self) -> Shown:
        """What its sensors show now."""
        drive = self._foc.now()
        return Shown(drive.time_s, DQ_VOLTAGE * drive.v_q, drive.i_q, drive.theta, drive.omega)


class MovingMotor:
    """A source of samples, taken as time passes.

    Args:
        source: with voltage, current and position; speed is the difference of positions where it has none.
        clock: seconds, monotonic.
    """

    def __init__(self, source: SampleSource, clock: Callable[[], float] = time.monotonic) -> None:
        period_s = source.info.sample_period_s
        assert period_s is not None
        self._source, self._period_s, self._clock = source, period_s, clock
        self._start_s: float | None = None
        self._taken = 0
        self._shown = Shown(0.0, 0.0, 0.0, 0.0, 0.0)

    def now(self) -> Shown:
        """What the motor shows now."""
        now_s = self._clock()
        if self._start_s is None or now_s - self._start_s - self._taken * self._period_s > MAX_BEHIND_S:
            self._start_s = now_s - (self._taken + 1) * self._period_s
        due = int((now_s - self._start_s) / self._period_s + _ROUNDING) - self._taken
        if due > 0:
            self._advance(due)
        return self._shown

    def step(self) -> Shown:
        """The next sample, whatever the clock says."""
        self._advance(1)
        return self._shown

    def _advance(self, n: int) -> None:
        block = self._source.next_block(n)
        self._taken += n
        assert block.voltage_V is not None and block.current_A is not None and block.position_rad is not None
        before, position = self._shown, float(block.position_rad[-1])
        if block.velocity_rad_s is not None:
            speed = float(block.velocity_rad_s[-1])
        else:
            elapsed = float(block.time_s[-1]) - before.time_s
            speed = (position - before.position_rad) / elapsed if elapsed > 0.0 else 0.0
        self._shown = Shown(
            float(block.time_s[-1]), float(block.voltage_V[-1]), float(block.current_A[-1]), position, speed
        )
