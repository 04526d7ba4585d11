"""VESC packets and values against what the firmware's own code made of them, and against anything at all."""

from __future__ import annotations

import contextlib
import json
import math
import random
from pathlib import Path
from typing import Any

import pytest

from drivers.base import DriverCounters
from drivers.vesc.configuration import decode_configuration
from drivers.vesc.dialogue import VescDialogue
from drivers.vesc.packets import PacketReader, encode_packet
from drivers.vesc.requests import GET_VALUES, GET_VALUES_SELECTIVE, MAY_SEND, POLL_MASKS, request
from drivers.vesc.values import VALUES, decode_firmware, layout_of, values_of
from servo_daemon.errors import WireError
from servo_daemon.sim_drive.makes.vesc_configuration import packed

GOLDEN = json.loads((Path(__file__).parents[2] / "drivers/golden/vesc.json").read_text())["frames"]
PACKETS = [f for f in GOLDEN if "packet" in f]


@pytest.mark.parametrize("frame", PACKETS, ids=lambda f: f.get("case", str(f.get("command"))))
def test_packets_are_the_firmwares(frame: dict[str, Any]) -> None:
    payload, packet = bytes.fromhex(frame["payload"]), bytes.fromhex(frame["packet"])
    assert encode_packet(payload) == packet
    assert PacketReader(DriverCounters()).feed(packet) == [payload]


@pytest.mark.parametrize("frame", [f for f in PACKETS if f.get("command") in (4, 50)], ids=lambda f: f["case"])
def test_values_are_the_firmwares(frame: dict[str, Any]) -> None:
    payload = bytes.fromhex(frame["payload"])
    if payload[0] == GET_VALUES:  # all of them, and no mask before them
        payload = bytes([GET_VALUES_SELECTIVE]) + ((1 << len(VALUES)) - 1).to_bytes(4, "big") + payload[1:]
    mask = int.from_bytes(payload[1:5], "big")
    assert mask == frame["mask"] or frame["mask"] is None
    names = [v.name for bit, v in enumerate(VALUES) if mask >> bit & 1 and v.name != "temp_mos"]
    values = values_of([layout_of(mask, names).unpack(payload)], names)
    for name, told in frame["decoded"].items():
        if name == "temp_mos":
            continue
        if told == -21474836.48:  # the firmware's 0/0: no value
            assert math.isnan(values[name][0])
        else:
            assert values[name][0] == pytest.approx(told, abs=1e-5), name


def test_packets_are_found_in_any_portions_and_between_garbage() -> None:
    rng = random.Random(1)
    packets = [bytes.fromhex(f["packet"]) for f in PACKETS]
    stream = b"".join(p + bytes(rng.choices((0, 1, 4, 200), k=rng.randrange(4))) for p in packets * 20)
    counters, found = DriverCounters(), []
    reader = PacketReader(counters)
    while stream:
        n = rng.randrange(1, 30)
        found += reader.feed(stream[:n])
        stream = stream[n:]
    found += reader.feed(bytes(600))
    assert found == [bytes.fromhex(f["payload"]) for f in PACKETS * 20]
    assert counters.crc_errors == 0 and counters.framing_errors > 0


def test_a_spoilt_packet_costs_only_itself() -> None:
    counters = DriverCounters()
    good = bytes.fromhex(PACKETS[0]["packet"])
    bad = bytearray(good)
    bad[20] ^= 0x40
    assert len(PacketReader(counters).feed(good + bytes(bad) + good + bytes(600))) == 2
    assert counters.crc_errors >= 1


def test_requests_are_the_firmwares_and_nothing_else_can_be_made() -> None:
    hosts = {bytes.fromhex(f["payload"]): bytes.fromhex(f["packet"]) for f in PACKETS if "direction" in f}
    assert request(b"\x00") == hosts[b"\x00"]
    forwarded = request(b"\x00", 3)
    assert PacketReader(DriverCounters()).feed(forwarded) == [b"\x22\x03\x00"]
    assert all(len(p) <= 5 and p[0] in (0, 14, 50) for payloads in MAY_SEND.values() for p in payloads)
    for payload in (b"\x0d", b"\x05\x00\x00\x00\x01", b"\x04", b"\x32\x00\x00\x00\x01", b""):
        with pytest.raises(ValueError):
            request(payload)


def test_firmware_first_then_masks_in_turn() -> None:
    dialogue = VescDialogue(None, DriverCounters(), 50)
    assert dialogue.next_request() == dialogue.next_request()
    hello = bytes([0, 6, 2]) + b"60_MK5\0" + bytes(range(12)) + b"\0\0"
    (reply,) = dialogue.feed(encode_packet(hello))
    assert reply.value == decode_firmware(hello)
    assert (dialogue.firmware.hardware, dialogue.firmware.uuid) == ("60_MK5", bytes(range(12)).hex())  # type: ignore[union-attr]
    assert {dialogue.next_request().tag for _ in range(4)} == set(POLL_MASKS)


def fuzz(seed: int, inputs: int) -> None:
    rng = random.Random(seed)
    dialogue = VescDialogue(None, DriverCounters(), 50)
    for _ in range(inputs):
        body = rng.randbytes(rng.randrange(1, 40))
        match rng.randrange(4):
            case 0:
                data = body
            case 1:
                data = encode_packet(bytes([rng.choice((0, 4, 50))]) + body)
            case 2:
                data = encode_packet(b"\x32" + rng.choice(POLL_MASKS).to_bytes(4, "big") + body)
            case _:
                packet = bytearray(encode_packet(body))
                packet[rng.randrange(len(packet))] ^= 1 << rng.randrange(8)
                data = bytes(packet)
        dialogue.feed(data)
        with contextlib.suppress(WireError):
            decode_firmware(body)


def test_any_bytes_are_counted_and_raise_nothing() -> None:
    fuzz(0, 3_000)


@pytest.mark.slow
def test_a_hundred_thousand_inputs_raise_nothing() -> None:
    fuzz(1, 100_000)


TOLD = {"ratio": 4.0, "sensor_mode": 1.0, "L": 15.7e-6, "R": 0.039, "flux": 0.0029, "poles": 14.0}


@pytest.mark.parametrize("signature", [1_065_524_471, 2_509_944_602])
@pytest.mark.parametrize(("sensor_mode", "pole_pairs"), [(1.0, 4), (0.0, 7)])
def test_the_motor_is_read_out_of_a_configuration(signature: int, sensor_mode: float, pole_pairs: int) -> None:
    """Packed value by value as the firmware does; the pole pairs are the encoder's ratio where there is one."""
    motor = decode_configuration(b"\x0e" + packed(signature, TOLD | {"sensor_mode": sensor_mode}))
    assert (motor.R, motor.L, motor.flux) == pytest.approx((0.039, 15.7e-6, 0.0029), rel=1e-6)
    assert motor.pole_pairs == pole_pairs
    assert motor.nominal()["K"] == pytest.approx(math.sqrt(1.5) * pole_pairs * 0.0029, rel=1e-6)


def test_another_configuration_is_not_read() -> None:
    good = b"\x0e" + packed(2_509_944_602, TOLD)
    for bad in (b"", b"\x0e", good[:300], b"\x0d" + good[1:], good[:4] + b"\x00" + good[5:]):
        with pytest.raises(WireError):
            decode_configuration(bad)
    unset = decode_configuration(b"\x0e" + packed(2_509_944_602, TOLD | {"R": 0.0, "flux": math.nan}))
    assert unset.nominal() == {"L": pytest.approx(15.7e-6)}
