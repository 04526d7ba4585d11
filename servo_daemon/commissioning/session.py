"""The loop between samples and commands: what plays a voltage, checks every sample, and stops."""

from __future__ import annotations

import contextlib
import gc
import math
import time
from collections.abc import Callable

import numpy as np

from drivers.commanding import LONGEST_COMMAND_S, Commanding
from servo_daemon.commissioning import ends, standing
from servo_daemon.commissioning.envelope import Envelope
from servo_daemon.commissioning.limits import MotionLimits
from servo_daemon.commissioning.prediction import Prediction
from servo_daemon.commissioning.stop import Stop, StoppedError
from servo_daemon.commissioning.supervisor import LEAST_NOISE, Reading, Supervisor
from servo_daemon.errors import DriverDisconnectedError, DriverError
from servo_daemon.samples import F64, Quality, SampleBlock, concatenate

#: A command is valid for this many samples or as long as the way to the drive needs, and at most as long as a drive
#: holds one. So long without a sample ends a run.
_VALID_SAMPLES = 5
#: How long a read waits, s.
_READ_S = 0.005
#: Longest time until a drive follows the first command, s: many times what any command may take.
_ARM_S = 0.5
#: Longest time until the first sample, s: a drive on a wire describes itself once a second. So long may it also be
#: silent while nothing is commanded.
_FIRST_S = 3.0
#: Starts of a motion that come to nothing because this machine was late, and nothing has moved yet.
_STARTS = 5
#: Recorded after a stop, s: the motor runs down.
_AFTER_S = 0.2
_SLOW = " (the line, or this machine: it must have the time to answer)"
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
        if drive.info.sample_period_s is None:
            self._first()  # on a wire it has to describe itself before it can be told anything
        drive.command(0.0, LONGEST_COMMAND_S)  # whatever it does now, it ends
        first = self._first()
        period = drive.info.sample_period_s
        if period is None:
            raise DriverError("commissioning needs a drive that tells its sample period")
        self.period_s = period
        self._silence_s = max(drive.hold_s, _VALID_SAMPLES * period)
        self.count_rad = 2 * math.pi / (drive.info.counts_per_rev or 1e6)
        self.supervisor = Supervisor(limits, period, self.count_rad, self._silence_s)
        self._unseen = standing.UnseenMotion(limits, self.count_rad)
        self._valid_s = min(LONGEST_COMMAND_S, self._silence_s)
        self._blocks = [first]
        assert first.position_rad is not None
        self._origin = float(first.position_rad[0])
        self._follows = False  # whether it has shown that a command acts, and none has run out since
        self._moving = False  # whether what is commanded is to move it
        self.envelope: Envelope | None = None
        self.prediction: Prediction | None = None
        self.centring_V_rad = 0.0
        self.motion_s = 0.0

    @property
    def time_left_s(self) -> float:
        """Time that is left for motion, s."""
        return self._limits.seconds - self.motion_s

    @property
    def now_s(self) -> float:
        """Device time of the last sample."""
        return float(self._blocks[-1].time_s[-1])

    def ends(self) -> list[float]:
        """Where the shaft stands against a stop, rad from where it began."""
        s, block = self.supervisor, self.block()
        if s.moving_A is None:
            return []
        assert block.position_rad is not None and block.current_A is not None
        current = block.current_A - s.offset_A
        return ends.stops(block.time_s, block.position_rad - self._origin, current, s.moving_A, self.count_rad)

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
        collects = gc.isenabled()
        gc.disable()  # over all that is loaded it takes 0.1 s and more: longer than a command is valid
        try:
            self._play(wave, enough)
        except StoppedError:
            self._halt()
            self._run_down()
            raise
        finally:
            self._halt()
            if collects:
                gc.enable()

    def named(self, stop: Stop) -> Stop:
        """A stop because the encoder stands, by its cause."""
        if stop.reason not in ("no_motion", "motion_ended"):
            return stop
        if self.prediction is not None and stop.reason == "motion_ended":
            return self.prediction.named_stuck(stop)
        return standing.named(stop, *self._since_it_stands())

    def _since_it_stands(self) -> tuple[SampleBlock, float, float]:
        """Samples since the encoder stands; offset and noise of the current, A."""
        s, block = self.supervisor, self.block()
        since = int(np.searchsorted(block.time_s, s.stands_since_s))
        noise = max(s.current_noise_A, LEAST_NOISE * self._limits.current_A)
        return block.slice(since, len(block)), s.offset_A, noise

    def catch_up(self) -> None:
        """After a time in which samples went by unseen and nothing was commanded: goes on from the newest."""
        if self._drive.can_wait:
            return
        self.supervisor.driven = self._moving = False
        while self._received(0.0) is not None:
            pass  # what waited in the line is old, and where that was full the newest are lost
        newest = self._awaited()
        self._acting(newest)
        self._keep(newest.slice(len(newest) - 1, len(newest)))
        self.supervisor.skip(self._readings(newest)[-1][0])

    def _armed(self) -> float:
        """0 V until the drive follows; device time then, s."""
        self.supervisor.driven = self._moving = False
        until = self.now_s + _ARM_S
        while not self._follows:
            self._send(0.0)
            self._read()
            if self.now_s > until:
                raise StoppedError(Stop("command_lost", "the drive does not follow commands", self.now_s))
        return self.now_s

    def _play(self, wave: F64, enough: Callable[[], bool]) -> None:
        began = last = self._armed()
        n, moving, starts = len(wave), bool(np.any(wave)), 1
        values, self._moving = wave.tolist(), moving
        while (k := round((last - began) / self.period_s) + 1) < n and not enough():
            if moving and self.time_left_s <= 0.0:
                return
            self._command(values[k])
            now = self._read()
            if moving and not self._follows:  # late, and no voltage of the wave has acted yet: it begins anew
                if starts == _STARTS:
                    raise StoppedError(Stop("command_lost", f"{starts} starts came to nothing: {self._lost}", now))
                began = last = now = self._armed()
                starts, self._moving = starts + 1, True
            elif moving:
                self.motion_s += now - last
            last = now

    @property
    def _lost(self) -> str:
        return f"the drive went to 0 V by itself: no command came in time for {1e3 * self._valid_s:.0f} ms{_SLOW}"

    def _command(self, wanted_V: float) -> None:
        s = self.supervisor
        if self.centring_V_rad and s.last is not None:
            wanted_V -= self.centring_V_rad * s.last.position_rad
        limit = self._limits.voltage_V
        wanted_V = min(max(wanted_V, -limit), limit)
        if self.envelope is not None:
            wanted_V = self.envelope.clamp(wanted_V, s.speed_rad_s)
        self._send(wanted_V)

    def _send(self, voltage_V: float) -> None:
        try:
            self._drive.command(voltage_V, self._valid_s)
        except DriverDisconnectedError as error:
            raise StoppedError(Stop("port_lost", str(error), self.now_s)) from error

    def _received(self, timeout_s: float) -> SampleBlock | None:
        try:
            return self._drive.read(timeout_s)
        except DriverDisconnectedError as error:
            raise StoppedError(Stop("port_lost", str(error), self.now_s)) from error

    def _acting(self, block: SampleBlock) -> list[float]:
        """Voltages that should act, V; 0 where none is commanded."""
        volts, s = self._drive.acting_V(block), self.supervisor
        s.latency_s = max(self._drive.latency_s, self.period_s)
        silent, volts = np.isnan(volts), np.nan_to_num(volts)
        self._follows = not silent[-1]
        if not s.driven:
            acts = np.flatnonzero(volts) if self._moving else np.zeros(0, dtype=np.intp)
            s.driven, silent = len(acts) > 0, silent[acts[0] :] if len(acts) else silent
        if s.driven and silent.any():
            raise StoppedError(Stop("command_lost", self._lost, float(block.time_s[-1])))
        out: list[float] = volts.tolist()
        return out

    def _read(self) -> float:
        """Checks what has come; device time of the last sample, s."""
        block = self._awaited()
        self._keep(block)
        for (r, good), volts in zip(self._readings(block), self._acting(block), strict=True):
            try:
                self.supervisor.check(r if good else _bad(r), volts)
            except StoppedError as error:
                raise StoppedError(self.named(error.stop)) from None
            if self.prediction is not None:
                self.prediction.check(r)
        if self.supervisor.driven and self.prediction is None:
            self._unseen.check(self.now_s, self._since_it_stands)
        return float(block.time_s[-1])

    def _awaited(self) -> SampleBlock:
        """The next samples; while nothing is commanded there is time."""
        began, longest_s = time.monotonic(), self._silence_s if self.supervisor.driven else _FIRST_S
        while True:
            block = self._received(_READ_S)
            if self._interrupted():
                raise StoppedError(Stop("interrupted", "stopped by the user", self.now_s))
            if block is not None:
                return block
            if time.monotonic() - began > longest_s:
                text = f"no sample for {1e3 * longest_s:g} ms{_SLOW}"
                raise StoppedError(Stop("data_missing", text, self.now_s))

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

    def _first(self) -> SampleBlock:
        until = time.monotonic() + _FIRST_S
        while time.monotonic() < until:
            if (block := self._drive.read(_READ_S)) is not None:
                self._readings_possible(block)
                return block
        raise DriverError("the drive sends no samples")

    @staticmethod
    def _readings_possible(block: SampleBlock) -> None:
        if block.voltage_V is None or block.current_A is None or block.position_rad is None:
            raise DriverError("commissioning needs a drive that measures voltage, current and position")

    def _halt(self) -> None:
        """0 V; a port that is lost commands nothing any more, and the drive stops by itself."""
        with contextlib.suppress(DriverDisconnectedError):
            self._drive.command(0.0, LONGEST_COMMAND_S)

    def _run_down(self) -> None:
        """Records how the motor comes to rest; nothing is commanded any more."""
        until = time.monotonic() + _AFTER_S
        end = self.now_s + _AFTER_S
        while self.now_s < end and time.monotonic() < until:
            with contextlib.suppress(DriverDisconnectedError):
                if (block := self._drive.read(_READ_S)) is not None:
                    self._keep(block)


def _bad(r: Reading) -> Reading:
    return Reading(r.time_s, r.voltage_V, math.nan, r.position_rad, r.temperature_C)
