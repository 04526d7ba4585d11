"""An ODrive on a CAN bus: the cyclic messages of CANSimple, listened to.

An identifier is node << 5 | command. Position and velocity (turns), Iq and, from firmware 0.6 on, the torque estimate
are used; they are little-endian floats, as in tests/drivers/golden/odrive.json. Messages of one burst follow each
other, and a sample is made when the last of them has come: at the first one the others would still be those of the
burst before. There is no applied voltage on this link, so R and L cannot be known from it.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np

from drivers.can.decode import Field
from drivers.can.learn import Choice, Heard, LearningListener, bits_of, channel, in_every_burst, last_of_burst
from drivers.can.map import MappedChannel, SignalMap
from drivers.can.vendor import VendorDecoder
from servo_daemon.errors import DriverConfigError
from servo_daemon.signal_meaning import SignalMeaning

#: What may be put on the bus: nothing.
MAY_SEND: frozenset[bytes] = frozenset()

#: Commands of CAN Simple; a node's id is the upper six of an identifier's eleven bits.
HEARTBEAT, ENCODER, IQ, TORQUES = 0x01, 0x09, 0x14, 0x1C
NODES = range(64)
FIRMWARES = ("auto", "0.5", "0.6")

#: i_q of the amplitude-invariant frame; K is then the drive's own torque constant, N·m a peak ampere.
MEANING = SignalMeaning(voltage="instant", current="instant", convention="dq", publish="kt")

#: From so many turns on the float32 position has steps of 1/1024 turn, too coarse to be one.
MOST_TURNS = 8192
#: Rates are set in whole milliseconds; what is heard is within so much of it.
_PERIOD_TOLERANCE = 0.03
_STALE_PERIODS = 2.5
_TURN = repr(2.0 * math.pi)


def key_of(node: int, command: int) -> int:
    return node << 5 | command


def fields_of(node: int) -> dict[str, Field]:
    """The fields in use, by name."""

    def of(command: int, name: str, first_bit: int) -> Field:
        return bits_of(key_of(node, command), f"{command:#04x}.{name}", first_bit, 32, big_endian=False, is_float=True)

    return {
        "Pos_Estimate": of(ENCODER, "Pos_Estimate", 0),
        "Vel_Estimate": of(ENCODER, "Vel_Estimate", 32),
        "Iq_Measured": of(IQ, "Iq_Measured", 32),
        "Torque_Estimate": of(TORQUES, "Torque_Estimate", 32),
    }


class ListenedOdrive(LearningListener):
    """An ODrive that is listened to. Options beside the bus's: `node_id` (0 … 63; needed where several are heard) and
    `firmware` (auto, 0.5 or 0.6: whether message 0x1C is the torque)."""

    kind: ClassVar[str] = "odrive"

    def __init__(self, name: str, options: dict[str, Any]) -> None:
        super().__init__(name, options, ("node_id", "firmware"))
        node = self._whole("node_id", NODES[0], NODES[-1])
        self._firmware = options.get("firmware", "auto")
        if self._firmware not in FIRMWARES:
            raise DriverConfigError(f"{self._where}: firmware must be one of {', '.join(FIRMWARES)}")
        commands = (HEARTBEAT, ENCODER, IQ, TORQUES)
        keys = frozenset(key_of(n, c) for n in (NODES if node is None else (node,)) for c in commands)
        self._learn(keys, self._choose)

    @property
    def meaning(self) -> SignalMeaning:
        return MEANING

    def _choose(self, heard: dict[int, Heard]) -> Choice:
        """What to make of the messages of the drive."""
        nodes = sorted({key >> 5 for key in heard})
        if len(nodes) > 1:
            return Choice(remark=f"several ODrives are heard ({', '.join(map(str, nodes))}): option node_id says which")
        if not nodes or key_of(nodes[0], ENCODER) not in heard:
            return Choice(remark="message 0x09 (Get_Encoder_Estimates) is needed: set its rate on the drive")
        node, fields = nodes[0], fields_of(nodes[0])
        effort = self._effort(heard, node)
        burst = in_every_burst(heard, [key_of(node, c) for c in (ENCODER, effort) if c is not None])
        channels = [*_motion(fields), *(_push(fields, effort) if key_of(node, effort or 0) in burst else ())]
        last = last_of_burst(heard, burst)
        trigger = next(o.field for c in channels for o in c.operands if o.field.key == last)
        period_s = _period_s(heard[last].period_s)
        decoder = VendorDecoder(
            SignalMap(tuple(channels), trigger), self.counters, period_s=period_s, stale_s=_STALE_PERIODS * period_s
        )
        rates = "neither Iq nor torque comes with every position: set the rates of 0x14 or 0x1C to that of 0x09"
        told = rates if len(channels) == 2 else None
        return Choice(decoder, told, f"odrive:{self._bus_name}:{node}")

    def _effort(self, heard: dict[int, Heard], node: int) -> int | None:
        """The message with what drives the mechanics: the torque where there is one, else Iq."""
        torque = heard.get(key_of(node, TORQUES))
        if torque is not None:
            # 0.5 has the ADC's voltage there, when asked for it, and zeros behind it
            found = "0.6" if bool(np.any(torque.data[:, 4:8])) else "0.5"
            if (found if self._firmware == "auto" else self._firmware) == "0.6":
                return TORQUES
        return IQ if key_of(node, IQ) in heard else None


def _motion(fields: dict[str, Field]) -> list[MappedChannel]:
    position = f"{_TURN} * (Pos + 0 / max(0, {MOST_TURNS} - abs(Pos)))"  # no number where it is too coarse
    return [
        channel("position_rad", position, Pos=fields["Pos_Estimate"]),
        channel("velocity_rad_s", f"{_TURN} * Vel", Vel=fields["Vel_Estimate"]),
    ]


def _push(fields: dict[str, Field], effort: int | None) -> list[MappedChannel]:
    if effort == TORQUES:
        return [channel("torque_Nm", "T", T=fields["Torque_Estimate"])]
    return [channel("current_A", "Iq", Iq=fields["Iq_Measured"])]


def _period_s(heard_s: float) -> float:
    whole_s = max(1, round(heard_s * 1e3)) * 1e-3
    return whole_s if abs(heard_s / whole_s - 1.0) < _PERIOD_TOLERANCE else heard_s
