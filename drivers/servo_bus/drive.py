"""Drivers "dynamixel" and "feetech": a servo in a chain on one half-duplex line, asked for its registers.

Brushed motors: the voltage is the share of the supply that the bridge is switched to. The servo changes it at its own
rate, which is faster than it can be asked, so that it is an instant's. Several drives with the same `port` share the
line, and are asked for together. Nothing is sent but reads of the registers in `families`.

    [drive.options]
    port = "/dev/ttyUSB0"
    drive_id = 1
"""

from __future__ import annotations

import math
import time
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import BaseModel, Field

from drivers.base import DriveInfo, Driver, disconnected
from drivers.options import STRICT, checked
from drivers.polling.driver import GATHER_S
from drivers.polling.link import Link, SerialLink
from drivers.polling.placing import Placing
from drivers.polling.poller import Answer, Pace
from drivers.serial.counts import CountUnwrapper
from drivers.serial.port import open_port
from drivers.servo_bus.chain import Chain, Place, State
from drivers.servo_bus.families import COUNTS_PER_REV, DynamixelX, Family, FeetechSts, Model, Readings
from drivers.servo_bus.protocol2 import MOST_ID
from servo_daemon.errors import DriverError
from servo_daemon.samples import F64, Quality, SampleBlock, make_block
from servo_daemon.signal_meaning import SignalMeaning

#: An answer that has not come by then will not: the servos' return delay is at most half a millisecond each.
_TIMEOUT_S = 0.05
#: Below this share of the supply the motor's current does not follow from that of the supply.
_LEAST_DUTY = 0.05
#: Of the servos' control. No manual says it; a kilohertz is what such controllers run at.
CONTROL_PERIOD_S = 1e-3
#: The supply's voltage comes in such steps: one factor of every voltage that is a share of it.
SUPPLY_STEP_V = 0.1
#: Position counters: 32 bits of Dynamixel, one turn of an STS (several turns in its multi-turn mode).
_TURNS = {"dynamixel": 1 << 32, "feetech": COUNTS_PER_REV}


class ServoOptions(BaseModel):
    """`[drive.options]` of `driver = "dynamixel"` and "feetech".

    `fast` (Dynamixel): one packet from all servos (Fast Sync Read) instead of one from each. `current_lsb_A` is a step
    of the current for a model that is not in the table. `supply_current` says what becomes of a current that is
    measured on the side of the supply (XL330, XC330): "none", or "divided" by the share of the voltage, which is how
    the motor's would follow from it.
    """

    model_config = STRICT

    port: str = Field(min_length=1)
    baudrate: int = Field(1_000_000, gt=0)
    drive_id: int = Field(1, ge=0, le=MOST_ID)
    rate_hz: float = Field(100.0, gt=0, le=1000)
    fast: bool = True
    current_lsb_A: float | None = Field(None, gt=0, le=1)
    supply_current: Literal["none", "divided"] = "none"


class _ServoDriver(Driver):
    """A servo; which make, a subclass says."""

    def __init__(self, name: str, options: dict[str, Any]) -> None:
        super().__init__(name, options)
        self._settings = checked(ServoOptions, name, options)
        self._family = self._make_family()
        self._place = Place(self._settings.drive_id, self.counters)
        self._placing = Placing(self.counters)
        self._unwrapper = CountUnwrapper(_TURNS[self.kind])
        self._chain: Chain | None = None
        self._supply_std = 0.0  # share of the supply that its step leaves open

    def _make_family(self) -> Family:
        raise NotImplementedError

    @property
    def meaning(self) -> SignalMeaning:
        return SignalMeaning(
            "instant", "instant", "dc", voltage_scale_std=self._supply_std, control_period_s=CONTROL_PERIOD_S
        )

    @property
    def _model(self) -> Model:
        """As the servo has said; until then, and of one that is not in the table, nothing is known of its current."""
        number, given = self._place.model, self._settings.current_lsb_A
        known = None if number is None else self._family.model(number)
        if known is not None:
            return Model(known.name, given or known.current_A, known.supply_side)
        return Model("unknown model" if number is None else f"model {number}", given)

    @property
    def _has_current(self) -> bool:
        model = self._model
        return model.current_A is not None and (not model.supply_side or self._settings.supply_current == "divided")

    @property
    def info(self) -> DriveInfo:
        channels = ("voltage_V", "current_A", "position_rad", "velocity_rad_s", "temperature_C")
        return DriveInfo(
            f"{self.kind}:{self._settings.port}:{self._settings.drive_id}",
            sample_period_s=1.0 / self._settings.rate_hz,
            counts_per_rev=float(COUNTS_PER_REV),
            current_lsb_A=self._model.current_A if self._has_current else None,
            channels=channels if self._has_current else (channels[0], *channels[2:]),
        )

    @property
    def remark(self) -> str | None:
        model = self._model
        if self._place.model is None:
            return None
        if model.current_A is None:
            return f"{model.name}: no step of its current is known; current_lsb_A says it"
        if model.supply_side:
            what = "not used" if self._settings.supply_current == "none" else "divided by the share of the voltage"
            return f"{model.name}: its current is that of the supply, and is {what} (supply_current)"
        return None

    def _open(self) -> None:
        s = self._settings
        place, self._place = self._place, Place(s.drive_id, self.counters)
        self._place.model = place.model
        self._placing.reopen()
        agreed = (self.kind, s.baudrate, s.rate_hz, s.fast)
        try:
            self._chain = Chain.join(
                s.port, agreed, self._place, self._open_link, self._family, Pace(s.rate_hz, timeout_s=_TIMEOUT_S)
            )
        except DriverError as error:
            text = str(error)
            raise type(error)(text if text.startswith("drive ") else f"drive {self.name}: {text}") from error

    def _open_link(self) -> Link:
        return SerialLink(open_port(self.name, self._settings.port, self._settings.baudrate))

    def _read(self, timeout_s: float) -> SampleBlock | None:
        chain = self._chain
        if chain is None:
            return None
        until_s, answers = time.monotonic() + max(timeout_s, 0.0), list[Answer[State]]()
        while self._is_open:
            try:
                answers += chain.wait(self._place, max(0.0, until_s - time.monotonic()), lambda: not self._is_open)
            except ConnectionError as error:
                raise disconnected(self.name, error) from error
            if answers:
                until_s = min(until_s, answers[0].received_s + GATHER_S)
            if time.monotonic() >= until_s:
                return self._samples(answers) if answers else None
        return None

    def _close(self) -> None:
        chain, self._chain = self._chain, None
        if chain is not None:
            chain.leave(self._place)

    def _samples(self, answers: list[Answer[State]]) -> SampleBlock:
        self.counters.frames += len(answers)
        shown = self._family.readings([a.value.data for a in answers])
        time_s, number, quality = self._placing.place(answers)
        current = self._current(shown)
        if current is not None:
            quality[~np.isfinite(current)] |= np.uint8(Quality.CURRENT_INVALID)
        counts = self._unwrapper.unwrap(shown.counts)
        self._supply_std = SUPPLY_STEP_V / math.sqrt(12.0) / max(float(np.median(shown.supply_V)), SUPPLY_STEP_V)
        return make_block(
            time_s, sequence=number, quality=quality, host_time_s=answers[-1].received_s,
            voltage_V=shown.duty * shown.supply_V,
            current_A=current,
            position_rad=counts.astype(np.float64) * (2.0 * math.pi / COUNTS_PER_REV),
            velocity_rad_s=shown.velocity_rad_s,
            temperature_C=shown.temperature_C,
        )  # fmt: skip

    def _current(self, shown: Readings) -> F64 | None:
        """The motor's current, NaN where it does not follow; None: it is not known."""
        model = self._model
        if not self._has_current or model.current_A is None:
            return None
        current = shown.current_steps * model.current_A
        if not model.supply_side:
            return current
        known = np.abs(shown.duty) >= _LEAST_DUTY
        return np.where(known, current / np.where(known, shown.duty, 1.0), np.nan)


class DynamixelDriver(_ServoDriver):
    """A Dynamixel X, protocol 2.0. Options: see `ServoOptions`."""

    kind: ClassVar[str] = "dynamixel"

    def _make_family(self) -> Family:
        return DynamixelX(fast=self._settings.fast)


class FeetechDriver(_ServoDriver):
    """A Feetech STS. Options: see `ServoOptions`."""

    kind: ClassVar[str] = "feetech"

    def _make_family(self) -> Family:
        return FeetechSts()


def may_send(family: Family, servos: tuple[int, ...]) -> frozenset[bytes]:
    """Everything that may leave towards these servos of a chain: reads of one's model and state, and of the state of
    any two or more of them together."""
    one = {family.read(s, *area) for s in servos for area in (family.identity, (family.address, family.length))}
    together = {
        family.sync_read(chosen)
        for mask in range(1 << min(len(servos), 10))
        if len(chosen := tuple(s for k, s in enumerate(servos) if mask >> k & 1)) > 1
    }
    return frozenset(one | together)
