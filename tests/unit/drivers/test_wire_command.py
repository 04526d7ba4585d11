"""Commands on the serial wire: the frame, and what a drive makes of it on its own clock."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import numpy as np
import pytest

from drivers.serial.command import Command, decode_command, encode_command
from drivers.serial.frame import encode_frame
from servo_daemon.errors import WireError
from servo_daemon.sim_drive.commanded import CommandedOutput
from tests.wire_tools import COMMANDS, SERVO

ZERO = Command(7, 1, 1, True, 50, 0.0)


def bytes_of(*commands: Command) -> bytes:
    return b"".join(encode_frame(encode_command(c)) for c in commands)


def output() -> CommandedOutput:
    """At 1 kHz, with 24 V."""
    return CommandedOutput(SERVO, 1000.0, 24.0)


def moving(voltage: float = 5.0) -> CommandedOutput:
    """Armed, one sample ago, and then told this voltage."""
    out = output()
    assert out.hear(bytes_of(ZERO)) == 1
    out.next(1)
    assert out.hear(bytes_of(replace(ZERO, number=2, voltage_V=voltage))) == 1
    return out


def test_the_payload_is_the_documents() -> None:
    (vector,) = COMMANDS.values()
    payload = bytes.fromhex(vector["payload"])
    assert payload == struct.pack("<BBBBHBBf", 4, 7, 1, 1, 1, 0xA5, 50, -1.5)
    assert payload == encode_command(Command(7, 1, 1, True, 50, -1.5))
    fields = {k: v for k, v in vector.items() if k not in ("payload", "frame")}
    assert decode_command(payload) == Command(**fields)
    for wrong in (payload[:-1], b"\1" + payload[1:], payload[:3] + b"\2" + payload[4:], payload[:4] + bytes(8)):
        with pytest.raises(WireError):
            decode_command(wrong)
    for impossible in (replace(ZERO, number=0), replace(ZERO, voltage_V=math.nan), replace(ZERO, valid_ms=256)):
        with pytest.raises(ValueError, match="ommand"):
            encode_command(impossible)


def test_the_drive_stops_by_itself_after_50_ms() -> None:
    out = moving()
    voltage, numbers = out.next(80)
    assert voltage.tolist() == [5.0] * 50 + [0.0] * 30
    assert numbers.tolist() == [2] * 50 + [0] * 30
    # Whoever was away cannot go on where it was; it begins with 0 V.
    assert out.hear(bytes_of(replace(ZERO, number=3, voltage_V=5.0))) == 0
    assert not out.next(5)[0].any()
    assert out.hear(bytes_of(replace(ZERO, number=4), replace(ZERO, number=5, voltage_V=1.0, valid_ms=2))) == 2
    assert out.next(4)[0].tolist() == [1.0, 1.0, 0.0, 0.0]


@pytest.mark.parametrize(
    "ignored",
    [
        replace(ZERO, number=2, voltage_V=5.0),  # again
        replace(ZERO, number=1),  # older
        replace(ZERO, number=3, drive_id=8),
        replace(ZERO, number=3, session=2),
    ],
)
def test_what_is_not_for_it_renews_nothing(ignored: Command) -> None:
    out = moving()
    out.next(40)
    assert out.hear(bytes_of(ignored)) == 0
    assert np.count_nonzero(out.next(40)[0]) == 10


@pytest.mark.parametrize("stop", [replace(ZERO, number=3, enabled=False), replace(ZERO, number=3, voltage_V=24.1)])
def test_what_is_not_enabled_or_too_much_stops_at_once(stop: Command) -> None:
    out = moving()
    out.hear(bytes_of(stop))
    assert not out.next(10)[0].any()


def test_numbers_go_round_and_noise_does_no_harm() -> None:
    out = output()
    out.hear(bytes_of(replace(ZERO, number=65535)))
    spoilt = bytearray(bytes_of(replace(ZERO, number=1, voltage_V=3.0)))
    spoilt[-3] ^= 1
    assert out.hear(b"\xff" * 5000 + b"\0" + bytes(spoilt)) == 0
    wire = bytes_of(replace(ZERO, number=1, voltage_V=3.0))
    assert [out.hear(wire[k : k + 1]) for k in range(len(wire))][-1] == 1
    assert out.next(1)[0].tolist() == [3.0]
