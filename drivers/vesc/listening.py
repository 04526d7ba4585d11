"""A VESC on a CAN bus: its status messages (29-bit identifiers: message << 8 | id), listened to.

Message 1 carries the current with the sign of power, not of torque: + drives, − brakes. So iq = current · sign(duty),
and where the duty cycle is 0 the sign is not known. |v| = duty · supply / √3 is the phase amplitude. Each value is cast
toward zero, and half a step is put back. Layout as in tests/drivers/golden/vesc.json.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from drivers.can.decode import EXTENDED, Field
from drivers.can.learn import Choice, Heard, LearningListener, bits_of, channel, in_every_burst, last_of_burst
from drivers.can.map import MappedChannel, Operand, SignalMap
from drivers.can.vendor import VendorDecoder
from drivers.vesc.shaft import Shaft
from servo_daemon.errors import DriverConfigError
from servo_daemon.samples import F64
from servo_daemon.signal_meaning import SignalMeaning

#: What may be put on the bus: nothing.
MAY_SEND: frozenset[bytes] = frozenset()

#: What status messages bring: the duty cycle of an instant, and a current that a low pass of a tenth a control cycle
#: (`iq_filter`) puts 9 cycles behind: 0.36 ms at 25 kHz, the default, 0.45 ms at 20.
LISTENED = SignalMeaning(voltage="instant", current="instant", convention="dq", current_late_s=4e-4)

#: The supply's voltage comes in such steps: one factor of every voltage that is a share of it.
SUPPLY_STEP_V = 0.1

#: Message numbers: CAN_PACKET_STATUS, _2 … _6 of the firmware's datatypes.h.
STATUS_1, STATUS_4, STATUS_5 = 9, 16, 27
MESSAGES = (STATUS_1, 14, 15, STATUS_4, STATUS_5, 58)

#: The rate is a whole number of hertz; what is heard is within so much of it.
_RATE_TOLERANCE = 0.03
#: A slower message's value is good for so many of its periods.
_STALE_PERIODS = 3.0


def key_of(message: int, vesc_id: int) -> int:
    return EXTENDED | message << 8 | vesc_id


def _field(message: int, vesc_id: int, name: str, first_bit: int, length: int, scale: float) -> Field:
    return bits_of(key_of(message, vesc_id), f"Status{message}.{name}", first_bit, length, big_endian=True, scale=scale)


def fields_of(vesc_id: int) -> dict[str, Field]:
    """The fields in use, by name."""
    return {
        "erpm": _field(STATUS_1, vesc_id, "erpm", 0, 32, 1.0),
        "current": _field(STATUS_1, vesc_id, "current", 32, 16, 0.1),
        "duty": _field(STATUS_1, vesc_id, "duty", 48, 16, 0.001),
        "pid_pos": _field(STATUS_4, vesc_id, "pid_pos", 48, 16, 0.02),
        "tachometer": _field(STATUS_5, vesc_id, "tachometer", 0, 32, 1.0),
        "v_in": _field(STATUS_5, vesc_id, "v_in", 32, 16, SUPPLY_STEP_V),
    }


class ListenedVesc(LearningListener):
    """A VESC that is listened to. Options beside the bus's: `can_id` (needed where several are heard), `pole_pairs`
    (without an encoder), `position` and `encoder_inverted` (found by themselves once the motor turns)."""

    kind: ClassVar[str] = "vesc"

    def __init__(self, name: str, options: dict[str, Any]) -> None:
        super().__init__(name, options, ("can_id", "pole_pairs", "position", "encoder_inverted"))
        self._supply_std = 0.0  # share of the supply that its step leaves open
        self._can_id = self._whole("can_id", 0, 255)
        self._pole_pairs = self._whole("pole_pairs", 1, 100)
        self._position = options.get("position", "auto")
        if self._position not in ("auto", "encoder", "electrical"):
            raise DriverConfigError(f"{self._where}: position must be auto, encoder or electrical")
        self._inverted = options.get("encoder_inverted", False)
        if not isinstance(self._inverted, bool):
            raise DriverConfigError(f"{self._where}: encoder_inverted must be true or false")
        ids = range(256) if self._can_id is None else (self._can_id,)
        self._learn(frozenset(key_of(m, i) for m in MESSAGES for i in ids), self._choose)

    @property
    def meaning(self) -> SignalMeaning:
        return replace(LISTENED, pole_pairs=self._pole_pairs or 1, voltage_scale_std=self._supply_std)

    def _choose(self, heard: dict[int, Heard]) -> Choice:
        """What to make of the messages of the drive."""
        ids = sorted({key & 0xFF for key in heard})
        if len(ids) > 1:
            return Choice(remark=f"several VESCs are heard ({', '.join(map(str, ids))}): option can_id says which")
        if not ids or key_of(STATUS_1, ids[0]) not in heard:
            return Choice(remark="status message 1 is needed: switch it on in VESC Tool, App Settings, CAN status")
        fields = fields_of(ids[0])
        burst = in_every_burst(heard, [key_of(m, ids[0]) for m in (STATUS_1, STATUS_4, STATUS_5)])
        position = self._position_channel(heard, burst, fields)
        if isinstance(position, str):
            return Choice(remark=position)
        channels = (*_electrical(heard, fields), position)
        if fields["v_in"].key in heard:
            supply_V = float(np.median(fields["v_in"].physical(heard[fields["v_in"].key].data)))
            self._supply_std = SUPPLY_STEP_V / math.sqrt(12.0) / max(supply_V, SUPPLY_STEP_V)
        used = {o.field.key for c in channels for o in c.operands}
        last = last_of_burst(heard, [key for key in burst if key in used])
        trigger = next(o.field for c in channels for o in c.operands if o.field.key == last)
        period_s = _period_s(heard[last].period_s)
        decoder = VendorDecoder(
            SignalMap(channels, trigger), self.counters, period_s=period_s, stale_s=_STALE_PERIODS * period_s
        )
        remark = None if len(channels) > 2 else "no supply voltage: status message 5 brings it, and with it R"
        return Choice(decoder, remark, f"vesc:{self._bus_name}:{ids[0]}")

    def _position_channel(
        self, heard: dict[int, Heard], burst: list[int], fields: dict[str, Field]
    ) -> MappedChannel | str:
        """The shaft's angle, or without an encoder its speed; a text where it is not known which."""
        source, inverted = self._position, self._inverted
        angle, steps = fields["pid_pos"], fields["tachometer"]
        if angle.key in burst and steps.key in heard:
            shaft = Shaft(source, self._pole_pairs, inverted)
            shaft.angle(*_together(heard, angle, steps))
            source, inverted = shaft.source, shaft.inverted
            if source == "auto" or shaft.contradiction is not None:
                return str(shaft.remark)
        if source == "encoder" and angle.key in burst:
            factor = math.radians(-1.0 if inverted else 1.0)
            return channel("position_rad", f"Angle * {factor!r}", 2.0 * math.pi, Angle=angle)
        if self._pole_pairs is None:
            return "no encoder's angle (status messages 4 and 5), and for the speed option pole_pairs is needed"
        factor = 2.0 * math.pi / 60.0 / self._pole_pairs
        return channel("velocity_rad_s", f"(Erpm + 0.5 * sign(Erpm)) * {factor!r}", Erpm=fields["erpm"])


def _electrical(heard: dict[int, Heard], fields: dict[str, Field]) -> list[MappedChannel]:
    """Current, and voltage where the supply is heard; half a step is put back to what was cast toward zero."""
    current = channel(
        "current_A",
        # 0 where no current flows; no number where one flows and the duty cycle has no sign
        "(C + 0.05 * sign(C)) * sign(D) / (1 + sign(abs(D)) - sign(abs(C)))",
        C=fields["current"],
        D=fields["duty"],
    )
    supply = fields["v_in"]
    if supply.key not in heard:
        return [current]
    slow = Operand("Vin", supply, 1.0, 0.5 * SUPPLY_STEP_V, _STALE_PERIODS * heard[supply.key].period_s)
    formula = f"(Duty + 0.0005 * sign(Duty)) * Vin * {1.0 / math.sqrt(3.0)!r}"
    return [channel("voltage_V", formula, Duty=fields["duty"], Vin=slow), current]


def _together(heard: dict[int, Heard], angle: Field, steps: Field) -> tuple[F64, F64]:
    """Angle and tachometer of the same bursts."""
    one, other = heard[angle.key], heard[steps.key]
    at = np.searchsorted(one.stamp_s, other.stamp_s, side="right") - 1
    known = at >= 0
    return angle.physical(one.data[at[known]]), steps.physical(other.data[known])


def _period_s(heard_s: float) -> float:
    whole = max(1, round(1.0 / heard_s))
    return 1.0 / whole if abs(whole * heard_s - 1.0) < _RATE_TOLERANCE else heard_s
