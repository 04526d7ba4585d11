"""The loop between samples and commands: what plays a voltage, checks every sample, and stops."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np

from drivers.commanding import LONGEST_COMMAND_S, Commanding
from servo_daemon.commissioning.envelope import Envelope
from servo_daemon.commissioning.limits import MotionLimits
from servo_daemon.commissioning.prediction import Prediction
from servo_daemon.commissioning.stop import Stop, StoppedError
from servo_daemon.commissioning.supervisor import Reading, Supervisor
from servo_daemon.errors import DriverError
from servo_daemon.samples import F64, Quality, SampleBlock, concatenate

#: A command is valid for this many samples, and at most as long as a drive holds one.
_VALID_SAMPLES = 5
#: Time without a sample that ends a run: as long as a command is valid, and not below what a host's scheduler may take.
_WATCHDOG_S = 0.02
#: How long a read waits, s.
_READ_S = 0.005
#: Recorded after a stop, s: the motor runs down.
_AFTER_S = 0.2
_INVALID = int(Quality.VOLTAGE_INVALID | Quality.CURRENT_INVALID | Quality.POSITION_INVALID | Quality.TIME_RESTART)


class Session:
    """One drive that is moved.

    Args:
        interrupted: asked with every read; true stops the run.

    Raises:
        DriverError: the drive sends nothing, or not voltage, current and position.
    """

    def __init__(self, drive: Commanding, limits: MotionLimits, interrupted: Callable[[], bool]) -> None:
        self._drive, self._limits, self._interrupted = drive, limits, interrupted
        drive.command(0.0, LONGEST_COMMAND_S)  # whatever it does now, it ends
        first = self._first()
        period = drive.info.sample_period_s
        if period is None:
            raise DriverError("commissioning needs a drive that tells its sample period")
        self.period_s = period
        self.count_rad = 2 * math.pi / (drive.info.counts_per_rev or 1e6)
        self.supervisor = Supervisor(limits, period, self.count_rad, max(_WATCHDOG_S, 5 * period))
        self._valid_s = min(LONGEST_COMMAND_S, max(_VALID_SAMPLES * period, _WATCHDOG_S))
        self._blocks = [first]
        assert first.position_rad is not None
        self._origin = float(first.position_rad[0])
        self._commanded = 0.0
        self.envelope: Envelope | None = None
        self.prediction: Prediction | None = None
        self.centring_V_rad = 0.0
        self.motion_s = 0.0

    @property
    def time_left_s(self) -> float:
        """Of motion."""
        return self._limits.seconds - self.motion_s

    def block(self) -> SampleBlock:
        """All samples so far."""
        if len(self._blocks) > 1:
            self._blocks = [concatenate(self._blocks)]
        return self._blocks[0]

    def rest(self, seconds: float) -> None:
        """Nothing is commanded, and nothing should happen.

        Raises:
            StoppedError: something does.
        """
        self.play(np.zeros(round(seconds / self.period_s)))

    def play(self, wave: F64, enough: Callable[[], bool] = lambda: False) -> None:
        """Commands these voltages, shape (n,), one a sample, by the device's time; ends at 0 V in any case.

        Args:
            enough: asked after every block of samples; true ends it.

        Raises:
            StoppedError: the supervisor or the user stops the run.
        """
        try:
            self._play(wave, enough)
        except StoppedError:
            self._halt()
            self._run_down()
            raise
        finally:
            self._halt()

    def _play(self, wave: F64, enough: Callable[[], bool]) -> None:
        began = last = self._now()
        n, moving = len(wave), bool(np.any(wave))
        values, self.supervisor.driven = wave.tolist(), moving
        while (k := round((last - began) / self.period_s) + 1) < n and not enough():
            if moving and self.time_left_s <= 0.0:
                return
            self._command(values[k])
            now = self._read()
            if moving:
                self.motion_s += now - last
            last = now

    def _command(self, wanted_V: float) -> None:
        s = self.supervisor
        if self.centring_V_rad and s.last is not None:
            wanted_V -= self.centring_V_rad * s.last.position_rad
        limit = self._limits.voltage_V
        wanted_V = min(max(wanted_V, -limit), limit)
        if self.envelope is not None:
            wanted_V = self.envelope.clamp(wanted_V, s.speed_rad_s)
        self._commanded = wanted_V
        self._drive.command(wanted_V, self._valid_s)

    def _read(self) -> float:
        """Checks what has come; device time of the last sample, s."""
        began = time.monotonic()
        while (block := self._drive.read(_READ_S)) is None:
            if self._interrupted():
                raise StoppedError(Stop("interrupted", "stopped by the user", self._now()))
            if time.monotonic() - began > _WATCHDOG_S:
                raise StoppedError(Stop("data_missing", f"no sample for {1e3 * _WATCHDOG_S:g} ms", self._now()))
        if self._interrupted():
            raise StoppedError(Stop("interrupted", "stopped by the user", self._now()))
        self._keep(block)
        for r, good in self._readings(block):
            try:
                self.supervisor.check(r if good else _bad(r), self._commanded)
            except StoppedError as error:
                if self.prediction is None or error.stop.reason != "motion_ended":
                    raise
                raise StoppedError(self.prediction.named_stuck(error.stop)) from None
            if self.prediction is not None:
                self.prediction.check(r)
        return float(block.time_s[-1])

    def _readings(self, block: SampleBlock) -> list[tuple[Reading, bool]]:
        v, i, x, temperature = block.voltage_V, block.current_A, block.position_rad, block.temperature_C
        if v is None or i is None or x is None:
            raise DriverError("commissioning needs a drive that measures voltage, current and position")
        out = []
        for k in range(len(block)):
            degrees = None if temperature is None else float(temperature[k])
            r = Reading(float(block.time_s[k]), float(v[k]), float(i[k]), float(x[k]) - self._origin, degrees)
            out.append((r, not int(block.quality[k]) & _INVALID))
        return out

    def _keep(self, block: SampleBlock) -> None:
        if block.channels != self._blocks[-1].channels:
            raise DriverError("the drive reports other channels than before")
        self._blocks.append(block)

    def _now(self) -> float:
        return float(self._blocks[-1].time_s[-1])

    def _first(self) -> SampleBlock:
        for _ in range(400):  # two seconds
            if (block := self._drive.read(_READ_S)) is not None:
                self._readings_possible(block)
                return block
        raise DriverError("the drive sends no samples")

    @staticmethod
    def _readings_possible(block: SampleBlock) -> None:
        if block.voltage_V is None or block.current_A is None or block.position_rad is None:
            raise DriverError("commissioning needs a drive that measures voltage, current and position")

    def _halt(self) -> None:
        self._commanded = 0.0
        self._drive.command(0.0, LONGEST_COMMAND_S)

    def _run_down(self) -> None:
        """Records how the motor comes to rest; nothing is commanded any more."""
        until = time.monotonic() + _AFTER_S
        end = self._now() + _AFTER_S
        while self._now() < end and time.monotonic() < until:
            block = self._drive.read(_READ_S)
            if block is not None:
                self._keep(block)


def _bad(r: Reading) -> Reading:
    return Reading(r.time_s, r.voltage_V, math.nan, r.position_rad, r.temperature_C)
