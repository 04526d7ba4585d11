"""Driver `simulated`: a motor that lives in this process, in real time or as fast as it is read.

Options (`[drive.options]`, all optional):

    seed, rate_hz, supply_V       numbers
    motor = { R = 0.5, … }        R, L, K, J, B; the paper's motor where absent
    J_m                           inertia without load: J_d is then part of the truth
    effects                       ["coulomb_friction:Tc=0.3"] or { coulomb_friction = { Tc = 0.3 } }
    ageing                        { R = "+40%/300s", J_d = ["+0.001@60s"] } or ["R=+40%/300s"]
    motion                        "mixed", "steps", "speed" or "rest"; peak_speed_rad_s, dither_rms_V
    sensors = { … }               any of servo_daemon.simulate.Sensors: noise, quantisation, jitter, channels
    realtime                      true: paced by the clock; false: as fast as it is read
    speed                         simulated seconds per second, where realtime
    block_s                       seconds between deliveries, where realtime
    duration_s                    the stream ends after this much simulated time
    fail_after_s                  the device goes away once at this simulated time (to try out reconnecting)

It takes commands (`drivers.commanding`): from the first one on its own servo rests, and the motor gets 0 V where none
is valid. Then a read gives one sample, or those that are due.

The motor stands still while the driver is closed and while the process is stopped (SIGSTOP, a sleeping host): it is
simulated by this very process, so nothing is lost and there is nothing to catch up with.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from drivers.base import DriveInfo, Driver, disconnected
from drivers.commanding import LONGEST_COMMAND_S
from servo_daemon.errors import BadInputError, DriverConfigError, DriverError, EndOfStreamError
from servo_daemon.samples import F64, SampleBlock
from servo_daemon.simulate import SimulatedDrive, drive_info, make_settings

log = logging.getLogger(__name__)

_SIMULATION = {
    "seed", "rate_hz", "supply_V", "motor", "J_m", "effects", "ageing", "motion", "peak_speed_rad_s", "dither_rms_V",
    "sensors",
}  # fmt: skip
_NUMBERS = {"rate_hz", "supply_V", "J_m", "peak_speed_rad_s", "dither_rms_V"}
_PACING = {"realtime", "speed", "block_s", "duration_s", "fail_after_s"}
_FAST_BLOCK = 1000  # samples a read where nothing is paced
_LONGEST_LAG_S = 1.0  # behind the clock by more: the process stood still, and so did the motor
#: The same while it is commanded: half of what a command is valid for, so that none runs out because a reader is late.
_LONGEST_LAG_COMMANDED_S = 0.01
_LONGEST_BURST_S = 0.25  # most that one read catches up


@dataclass(frozen=True, slots=True)
class _Pacing:
    realtime: bool
    speed: float
    block_s: float
    duration_s: float | None
    fail_after_s: float | None


class SimulatedDriver(Driver):
    """Samples of a simulated motor; the module's text lists the options.

    Raises:
        DriverConfigError: an option is unknown (named), of the wrong type or impossible.
    """

    kind: ClassVar[str] = "simulated"
    #: Five samples at 250 Hz, and what a host's scheduler may take.
    hold_s = 0.02

    def __init__(self, name: str, options: dict[str, Any]) -> None:
        super().__init__(name, options)
        unknown = sorted(set(options) - _SIMULATION - _PACING)
        if unknown:
            known = ", ".join(sorted(_SIMULATION | _PACING))
            raise DriverConfigError(f"drive {name}: unknown option '{unknown[0]}': known are {known}")
        try:
            self._pacing = _pacing(options)
            self._settings = make_settings(seconds=self._pacing.duration_s, **_simulation(options))
        except BadInputError as error:
            raise DriverConfigError(f"drive {name}: {error}") from error
        self._drive: SimulatedDrive | None = None
        self._info = drive_info(self._settings)
        self._closing = threading.Event()
        self._delivered = 0  # samples since the motor was made
        self._anchor_s = 0.0  # clock time at which sample `_anchor_sample` was due
        self._anchor_sample = 0
        self._has_failed = False
        self._command: tuple[float, int] | None = None  # V, and the first sample for which it is no longer valid
        self._acting = np.zeros(0)  # of the last block: the voltage commanded; not a number: none is valid

    @property
    def can_wait(self) -> bool:
        """Where it is not paced by the clock."""
        return not self._pacing.realtime

    @property
    def info(self) -> DriveInfo:
        return self._info

    def truth(self) -> dict[str, float] | None:
        drive = self._drive
        return None if drive is None else drive.truth()

    def command(self, voltage_V: float, valid_for_s: float) -> None:
        if not self._is_open:
            raise DriverError(f"drive {self.name}: command before open")
        if not (math.isfinite(voltage_V) and math.isfinite(valid_for_s)):
            raise DriverError(f"drive {self.name}: {voltage_V} V for {valid_for_s} s is no command")
        valid = min(max(valid_for_s, 0.0), LONGEST_COMMAND_S) * self._settings.rate_hz
        self._command = voltage_V, self._delivered + math.floor(valid)

    @property
    def latency_s(self) -> float:
        return 1.0 / self._settings.rate_hz

    def acting_V(self, block: SampleBlock) -> F64:
        return self._acting[: len(block)]

    def _open(self) -> None:
        self._command = None
        if self._drive is None:
            self._drive = SimulatedDrive(self._settings)
        self._closing.clear()
        self._set_clock(time.monotonic())

    def _close(self) -> None:
        self._closing.set()

    def _read(self, timeout_s: float) -> SampleBlock | None:
        drive, pacing = self._drive, self._pacing
        assert drive is not None
        left = self._samples_left()
        if not pacing.realtime:
            most = _FAST_BLOCK if self._command is None else 1
            return None if self._closing.is_set() else self._deliver(drive, min(most, left))
        per_second = self._settings.rate_hz * pacing.speed
        wanted = 1 if self._command else min(left, max(1, round(per_second * pacing.block_s)))
        due_s = self._anchor_s + (self._delivered + wanted - self._anchor_sample) / per_second
        wait_s = due_s - time.monotonic()
        if wait_s > 0 and (self._closing.wait(min(wait_s, max(timeout_s, 0.0))) or wait_s > timeout_s):
            return None
        now = time.monotonic()
        if now - due_s > (_LONGEST_LAG_COMMANDED_S if self._command else _LONGEST_LAG_S):
            if now - due_s > _LONGEST_LAG_S:
                log.info("drive %s: stood still for %.1f s, and the simulated motor with it", self.name, now - due_s)
            block = self._deliver(drive, wanted)
            self._set_clock(now)
            return block
        # A millionth of a sample is rounding of the clock, not lateness.
        due = math.floor((now - self._anchor_s) * per_second + 1e-6) + self._anchor_sample - self._delivered
        most = max(wanted, int(per_second * _LONGEST_BURST_S))
        return self._deliver(drive, max(wanted, min(due, most, left)))

    def _samples_left(self) -> int:
        """Samples until the stream ends or fails, at least 1.

        Raises:
            EndOfStreamError, DriverDisconnectedError: that moment has come.
        """
        rate, pacing = self._settings.rate_hz, self._pacing
        left = 2**62
        if pacing.fail_after_s is not None and not self._has_failed:
            left = round(pacing.fail_after_s * rate) - self._delivered
            if left <= 0:
                self._has_failed = True
                raise disconnected(self.name, f"fail_after_s = {pacing.fail_after_s:g}")
        if pacing.duration_s is not None:
            left = min(left, max(1, round(pacing.duration_s * rate)) - self._delivered)
            if left <= 0:
                raise EndOfStreamError(f"drive {self.name}: {pacing.duration_s:g} s simulated")
        return left

    def _deliver(self, drive: SimulatedDrive, n: int) -> SampleBlock:
        if self._command is None:
            block = drive.next_block(n)
        else:
            voltage, until = self._command
            self._acting = np.where(np.arange(self._delivered, self._delivered + n) < until, voltage, np.nan)
            block = drive.commanded_block(np.nan_to_num(self._acting))
        self._delivered += n
        self.counters.frames += 1
        return replace(block, host_time_s=time.monotonic())

    def _set_clock(self, now_s: float) -> None:
        self._anchor_s, self._anchor_sample = now_s, self._delivered


def _number(options: Mapping[str, Any], key: str, default: float | None) -> float | None:
    """A finite number greater than zero.

    Raises:
        BadInputError: it is something else.
    """
    value = options.get(key, default)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or value <= 0:
        raise BadInputError(f"{key} must be a number greater than zero, not {value!r}")
    return float(value)


def _pacing(options: Mapping[str, Any]) -> _Pacing:
    realtime = options.get("realtime", True)
    if not isinstance(realtime, bool):
        raise BadInputError(f"realtime must be true or false, not {realtime!r}")
    return _Pacing(
        realtime=realtime,
        speed=_number(options, "speed", 1.0) or 1.0,
        block_s=_number(options, "block_s", 0.01) or 0.01,
        duration_s=_number(options, "duration_s", None),
        fail_after_s=_number(options, "fail_after_s", None),
    )


def _simulation(options: Mapping[str, Any]) -> dict[str, Any]:
    """The options for `make_settings`, their types checked."""
    chosen = {key: value for key, value in options.items() if key in _SIMULATION}
    for key, value in chosen.items():
        if key in _NUMBERS and (isinstance(value, bool) or not isinstance(value, int | float)):
            raise BadInputError(f"{key} must be a number, not {value!r}")
        if key == "seed" and (isinstance(value, bool) or not isinstance(value, int)):
            raise BadInputError(f"seed must be a whole number, not {value!r}")
        if key in {"motor", "sensors"} and not isinstance(value, Mapping):
            raise BadInputError(f"{key} must be a table, not {value!r}")
        if key in {"effects", "ageing"} and not isinstance(value, str | list | tuple | Mapping):
            raise BadInputError(f"{key} must be a list of texts or a table, not {value!r}")
    return chosen
