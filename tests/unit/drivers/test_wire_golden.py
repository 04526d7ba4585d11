"""The vectors of docs/protocol.md against our codec, the `cobs` package, an independent CRC and plain `struct`."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from cobs import cobs
from crccheck.crc import Crc16Ibm3740

from drivers.serial.decoder import BinaryDecoder
from drivers.serial.frame import decode_frame, encode_frame
from drivers.serial.wire import (
    decode_description,
    encode_description,
    encode_samples,
)
from servo_daemon.errors import WireError
from servo_daemon.samples import Quality
from tests.wire_tools import DESCRIPTIONS, SAMPLES, VECTORS, description_of, rows_of

FORMAT_LETTERS = {1: "B", 2: "h", 3: "H", 4: "i"}


def test_the_document_has_the_vectors_it_promises() -> None:
    assert set(DESCRIPTIONS) == {"description_servo", "description_unusual"}
    assert set(SAMPLES) == {"samples_servo", "samples_long"}


@pytest.mark.parametrize("name", VECTORS)
def test_frame_is_payload_and_crc_stuffed(name: str) -> None:
    payload, frame = bytes.fromhex(VECTORS[name]["payload"]), bytes.fromhex(VECTORS[name]["frame"])
    crc = Crc16Ibm3740.calc(payload).to_bytes(2, "big")
    assert cobs.encode(payload + crc) + b"\0" == frame
    assert encode_frame(payload) == frame
    assert decode_frame(frame[:-1]) == payload


def test_crc_has_the_published_check_value() -> None:
    assert cobs.decode(encode_frame(b"123456789")[:-1])[-2:] == bytes.fromhex("29b1")


@pytest.mark.parametrize("name", DESCRIPTIONS)
def test_description_payload(name: str) -> None:
    vector = DESCRIPTIONS[name]
    payload = bytes.fromhex(vector["payload"])
    by_hand = struct.pack(
        "<BBBBII16sB",
        2,
        vector["drive_id"],
        vector["session"],
        1,
        vector["sample_period_ns"],
        vector["position_modulus"],
        vector["identity"].encode(),
        len(vector["channels"]),
    ) + b"".join(struct.pack("<BBff", *c) for c in vector["channels"])
    assert payload == by_hand
    assert encode_description(description_of(vector)) == payload
    assert decode_description(payload) == description_of(vector)


@pytest.mark.parametrize("name", SAMPLES)
def test_samples_payload(name: str) -> None:
    vector = SAMPLES[name]
    description = description_of(VECTORS[vector["description"]])
    times, rows = rows_of(vector)
    payload = bytes.fromhex(vector["payload"])
    head = (1, description.drive_id, description.session, len(rows), vector["sequence"], times[0])
    record = "<H" + "".join(FORMAT_LETTERS[c.format] for c in description.channels)
    steps = [0, *np.diff(times).tolist()]
    by_hand = struct.pack("<BBBBII", *head)
    by_hand += b"".join(struct.pack(record, step, *row) for step, row in zip(steps, rows, strict=True))
    assert payload == by_hand
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    assert encode_samples(description, vector["sequence"], np.array(times), columns) == payload


def test_decoder_reads_the_servo_vectors() -> None:
    decoder = BinaryDecoder()
    for name in ("description_servo", "samples_servo"):
        block = decoder.feed(bytes.fromhex(VECTORS[name]["frame"]))
    assert block is not None
    assert block.time_s.tolist() == [4294.9668, 4294.9678, 4294.968801]
    assert block.sequence.tolist() == [2**32 - 2, 2**32 - 1, 2**32]
    assert block.voltage_V is not None and block.current_A is not None and block.position_rad is not None
    assert block.voltage_V.tolist() == [12.0, -12.0, 0.0]
    assert block.current_A.tolist() == [-0.0005, 0.25, -16.384]
    counts = block.position_rad * 4096 / (2 * np.pi)
    np.testing.assert_allclose(counts, [2147483647, 2147483648, 2147483656], rtol=1e-15)
    assert block.quality.tolist() == [0, 0, Quality.VOLTAGE_INVALID | Quality.SATURATED]


def test_decoder_reads_the_unusual_vectors() -> None:
    decoder = BinaryDecoder(drive_id=255)
    for name in ("description_unusual", "samples_long"):
        block = decoder.feed(bytes.fromhex(VECTORS[name]["frame"]))
    assert block is not None and len(block) == 30
    assert block.channels == ("current_A", "position_rad", "temperature_C")
    assert block.current_A is not None and block.position_rad is not None and block.temperature_C is not None
    np.testing.assert_allclose(block.current_A, 0.25 + 1684.3010, rtol=1e-12)
    np.testing.assert_allclose(block.position_rad, 1.5 - 2 * np.pi * 2748 / 4096, rtol=1e-12)
    np.testing.assert_allclose(block.temperature_C, 25.71, rtol=1e-12)
    assert decoder.description == description_of(VECTORS["description_unusual"])


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({3: 2}, "version 2"),
        ({28: 5}, "does not hold 5 channels"),
        ({28: 0}, "does not hold 0 channels"),
        ({30: 9}, "unknown format 9"),
        ({31: 0, 32: 0, 33: 0, 34: 0}, "impossible scale"),
        ({33: 0x80, 34: 0x7F}, "impossible scale"),
        ({39: 1}, "one twice"),
    ],
)
def test_impossible_descriptions_are_refused(change: dict[int, int], why: str) -> None:
    payload = bytearray.fromhex(VECTORS["description_servo"]["payload"])
    for place, value in change.items():
        payload[place] = value
    with pytest.raises(WireError, match=why):
        decode_description(bytes(payload))
    decoder = BinaryDecoder()
    assert decoder.feed(encode_frame(bytes(payload))) is None
    assert decoder.description is None
    assert decoder.counters.extra["descriptions_refused"] == 1
