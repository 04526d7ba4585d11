"""A VESC on USB or UART, or one behind it on its CAN bus: averages of vq and iq, polled."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from drivers.base import DriveInfo
from drivers.can.decode import Bits
from drivers.options import checked
from drivers.polling.driver import PollingDriver
from drivers.polling.link import SerialLink
from drivers.polling.poller import Answer, Pace
from drivers.polling.when import SampleTimes
from drivers.serial.port import open_port
from drivers.vesc.coverage import Coverage, polls_a_check
from drivers.vesc.dialogue import Polled, VescDialogue
from drivers.vesc.requests import POLL_MASKS
from drivers.vesc.shaft import Shaft, Source
from drivers.vesc.values import NO_AVERAGE, POLLED, Firmware, values_of
from servo_daemon.samples import F64, I64, U8, Quality, SampleBlock
from servo_daemon.signal_meaning import SignalMeaning

#: What a poll brings: averages since the poll before, of every control cycle.
POLLED_MEANING = SignalMeaning(voltage="mean", current="mean", convention="dq")
#: One step of the averages, A and V.
CURRENT_LSB_A, VOLTAGE_LSB_V = 1e-2, 1e-3
#: From this duty cycle on the firmware limits the voltage (its default l_max_duty is 0.95).
_FULL_DUTY = 0.95
#: Where somebody else has read the averages they are not to be trusted for so long, s.
_DISTRUST_S = 10.0

_MEANS = int(Quality.VOLTAGE_INVALID | Quality.CURRENT_INVALID)


class VescOptions(BaseModel):
    """`[drive.options]` of a VESC on a serial line.

    `rate_hz`: USB carries 1000, 115,200 Bd 240. `can_id`: of a VESC behind this one. `position`: what `pid_pos` is;
    `encoder_inverted`: it counts against the electrical direction; both are found by themselves once the motor turns.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    port: str = Field(min_length=1)
    baudrate: int = Field(115200, gt=0)
    rate_hz: float = Field(200.0, gt=0, le=1000)
    can_id: int | None = Field(None, ge=0, le=254)
    pole_pairs: int | None = Field(None, ge=1, le=100)
    position: Source = "auto"
    encoder_inverted: bool = False


class PolledVesc(PollingDriver[Firmware | Polled]):
    """A VESC that is asked. Options: see `VescOptions`."""

    kind: ClassVar[str] = "vesc"

    def __init__(self, name: str, options: dict[str, Any]) -> None:
        super().__init__(name, options)
        self._settings = checked(VescOptions, name, options)
        settings = self._settings
        self._shaft = Shaft(settings.position, settings.pole_pairs, settings.encoder_inverted)
        self._dialogue: VescDialogue | None = None
        self._asked_before: int | None = None  # number of the last answer with values
        self._reset_s = -math.inf  # when another program was last seen to read the averages
        self._received_s = -math.inf  # the last answer
        self._disturbed = False
        self._check_every = polls_a_check(settings.rate_hz)
        self._coverage = Coverage(self._check_every)
        self._asked_s = math.nan  # the last answer's request
        self._times = SampleTimes()
        self.counters.extra["averages_reset"] = 0

    @property
    def meaning(self) -> SignalMeaning:
        return replace(POLLED_MEANING, pole_pairs=self._settings.pole_pairs or 1)

    @property
    def info(self) -> DriveInfo:
        firmware = self._dialogue.firmware if self._dialogue is not None else None
        behind = "" if self._settings.can_id is None else f"#{self._settings.can_id}"
        unit = f"serial:{self._settings.port}" if firmware is None or not firmware.uuid else firmware.uuid
        return DriveInfo(
            identity=f"vesc:{unit}{behind}",
            sample_period_s=1.0 / self._settings.rate_hz,
            current_lsb_A=CURRENT_LSB_A,
            voltage_lsb_V=VOLTAGE_LSB_V,
            channels=("voltage_V", "current_A", "position_rad"),
        )

    @property
    def remark(self) -> str | None:
        if self._dialogue is not None and self._dialogue.firmware is None:
            if self._settings.can_id is not None:
                where = f"can_id = {self._settings.can_id}"
                return f"no VESC with {where} answers behind this port: is that its id, and is it on the bus?"
            return "it does not tell its firmware's version: is this the VESC's port, and this its baudrate?"
        if self._disturbed:
            return "another program reads this drive's averages too (VESC Tool?): only one can, close the other"
        return self._shaft.remark

    @property
    def firmware(self) -> Firmware | None:
        """What the drive said of itself; None before."""
        return None if self._dialogue is None else self._dialogue.firmware

    @property
    def shaft(self) -> Shaft:
        """What is known of its position."""
        return self._shaft

    @property
    def _pace(self) -> Pace:
        timeout_s = max(0.1, 4.0 / self._settings.rate_hz)
        return Pace(self._settings.rate_hz, together=2, timeout_s=timeout_s, watched=len(POLL_MASKS))

    def _open_link(self) -> SerialLink:
        return SerialLink(open_port(self.name, self._settings.port, self._settings.baudrate))

    def _new_dialogue(self) -> VescDialogue:
        self._dialogue = VescDialogue(self._settings.can_id, self.counters, self._check_every)
        self._shaft.restart()
        self._times.restart()
        self._coverage.restart()
        self._received_s = -math.inf
        self._asked_before, self._reset_s, self._disturbed = None, -math.inf, False
        return self._dialogue

    def _samples(self, answers: list[Answer[Firmware | Polled]]) -> SampleBlock | None:
        polled = [(answer, answer.value) for answer in answers if isinstance(answer.value, tuple)]
        if not polled:
            return None
        shown = values_of([raw[-len(POLLED) :] for _, raw in polled])
        iq, vq, duty, degrees, tachometer, erpm = (shown[name] for name in POLLED)
        number = np.array([a.number for a, _ in polled], np.int64)
        sent_s, received_s = np.array([(a.sent_s, a.received_s) for a, _ in polled]).T
        before, self._asked_before = self._asked_before, int(number[-1])
        angle = self._shaft.angle(degrees, tachometer)
        steps = np.diff(number, prepend=number[0] if before is None else before)
        seldom = [raw[: -len(POLLED)] for _, raw in polled]
        another, unknown = self._doubted(sent_s, steps, iq * np.sign(vq), seldom)
        quality = self._quality(sent_s, received_s, steps, np.isnan(iq) | np.isnan(vq), another)
        quality[unknown] |= _MEANS
        quality[np.abs(duty) >= _FULL_DUTY] |= int(Quality.SATURATED)
        first = 1 if before is None else 0  # its averages began when somebody last looked
        if angle is None or first == len(polled):
            return None
        bad = (quality & _MEANS) != 0
        block = SampleBlock(
            self._times.times(sent_s, received_s, angle, self._speed(erpm)),
            number,
            quality,
            answers[-1].received_s,
            voltage_V=np.where(bad, np.nan, _centred(vq, VOLTAGE_LSB_V)),
            current_A=np.where(bad, np.nan, _centred(iq, CURRENT_LSB_A)),
            position_rad=angle,
        )
        return block.slice(first, len(block))

    def _speed(self, erpm: F64) -> F64 | None:
        """Of the shaft, rad/s, with the sign of the angle."""
        pole_pairs = self._shaft.pole_pairs
        return None if pole_pairs is None else _centred(erpm, 1.0) * (2.0 * math.pi / 60.0 / pole_pairs)

    def _doubted(self, sent_s: F64, steps: I64, motoring_A: F64, seldom: list[Polled]) -> tuple[Bits, Bits]:
        """Where the seldom average, which `seldom` holds where it was asked for, shows another program; and where there
        have not been enough of them to show one."""
        duration_s = np.where(steps == 1, np.diff(sent_s, prepend=self._asked_s), np.nan).tolist()
        self._asked_s = float(sent_s[-1])
        another, unknown = np.zeros(len(steps), bool), np.zeros(len(steps), bool)
        current = _centred(motoring_A, CURRENT_LSB_A).tolist()
        for k, (T, i, raw) in enumerate(zip(duration_s, current, seldom, strict=True)):
            self._coverage.take(T, i, _seldom_A(raw))
            another[k], unknown[k] = self._coverage.another and bool(raw), not self._coverage.known
        return another, unknown

    def _quality(self, sent_s: F64, received_s: F64, steps: I64, nothing: Bits, another: Bits) -> U8:
        """After an answer that is missing the average's interval is not known: its request may have arrived or not.
        An average over nothing is another program's doing, unless the drive may have served two of our requests at
        once: the one before was then not answered yet when this one left."""
        quality = np.zeros(len(sent_s), np.uint8)
        gap = steps > 1
        self.counters.samples_lost += int((steps[gap] - 1).sum())
        quality[gap] |= int(Quality.GAP_BEFORE) | _MEANS
        quality[nothing] |= _MEANS
        answered_s = np.concatenate([[self._received_s], received_s[:-1]])
        self._received_s = float(received_s[-1])
        reset = (nothing & (sent_s > answered_s)) | another
        reset_s = np.maximum.accumulate(np.where(reset, sent_s, self._reset_s))
        quality[sent_s - reset_s < _DISTRUST_S] |= _MEANS
        self._reset_s = float(reset_s[-1])
        self._disturbed = bool(sent_s[-1] - reset_s[-1] < _DISTRUST_S)
        self.counters.extra["averages_reset"] += int(np.count_nonzero(reset))
        return quality


def _seldom_A(raw: Polled) -> float | None:
    """Of a poll that has read it; NaN over no control cycle."""
    if not raw:
        return None
    return math.nan if raw[0] == NO_AVERAGE else float(_centred(raw[0] * CURRENT_LSB_A, CURRENT_LSB_A))


def _centred(value: F64 | float, lsb: float) -> F64:
    """The middle of what the firmware's cast, which drops the fraction, has made the value of. 0 stays 0."""
    return np.asarray(value + 0.5 * lsb * np.sign(value), np.float64)
