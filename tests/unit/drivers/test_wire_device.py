"""Parts of the simulated serial device that need no terminal: refused links, faults, the encoder's limits."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest

from drivers.base import DriveInfo
from drivers.serial.decoder import BinaryDecoder
from drivers.serial.encoder import BinaryEncoder, describe
from drivers.serial.frame import encode_frame
from drivers.serial.wire import Channel, Description, Quantity, encode_description, encode_samples
from servo_daemon.errors import BadInputError, WireError
from servo_daemon.samples import Quality, SampleBlock, make_block
from servo_daemon.sim_drive.line_faults import Fault, LineFaults
from servo_daemon.sim_drive.serial_device import run_serial_device
from tests.wire_tools import SERVO, frame

INFO = DriveInfo("X-1", 1e-3, 4096.0, 1e-3, 1e-3, ("voltage_V", "current_A", "position_rad"))


class _Silent:
    info = INFO

    def next_block(self, n: int) -> SampleBlock:
        raise AssertionError("nobody asked")


def test_a_file_is_never_replaced_by_a_link(tmp_path: Path) -> None:
    link = tmp_path / "data.csv"
    link.write_text("precious")
    with pytest.raises(BadInputError, match=r"data\.csv.*not replaced"):
        run_serial_device(link, _Silent(), stop=threading.Event())
    assert link.read_text() == "precious"


def test_a_link_in_a_folder_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="cannot be made"):
        run_serial_device(tmp_path / "no" / "drive", _Silent(), stop=threading.Event())


def test_faults_change_what_they_say() -> None:
    faults, wire = LineFaults({2: Fault.DROP}), frame(0)
    assert faults.next_fault(0) is None
    assert faults.next_fault(2) is Fault.DROP
    faults.inject(Fault.CUT)
    assert [faults.next_fault(3), faults.next_fault(4)] == [Fault.CUT, None]
    assert faults.spoil(None, wire) == faults.spoil(Fault.RESTART, wire) == wire
    assert faults.spoil(Fault.DROP, wire) == b""
    assert faults.spoil(Fault.REPEAT, wire) == 2 * wire
    assert faults.spoil(Fault.CUT, wire) == wire[: len(wire) // 2]
    assert faults.spoil(Fault.GARBAGE, wire).endswith(b"\0" + wire)
    for _ in range(50):
        corrupt = faults.spoil(Fault.CORRUPT, wire)
        assert len(corrupt) == len(wire) and corrupt.count(0) == 1
        assert sum(a != b for a, b in zip(corrupt, wire, strict=True)) == 1


def test_description_follows_the_drive() -> None:
    described = describe(INFO, drive_id=3, session=9)
    assert [c.quantity for c in described.channels] == [1, 2, 3, 16]
    assert (described.drive_id, described.session, described.identity) == (3, 9, "X-1")
    assert described.sample_period_ns == 1_000_000
    position = described.channel(Quantity.POSITION)
    assert position is not None and position.scale == 4096.0
    unknown = describe(DriveInfo("a much too long identity ü", channels=("current_A", "velocity_rad_s")))
    assert len(unknown.identity.encode()) <= 16 and unknown.sample_period_ns == 0
    with pytest.raises(WireError, match="nothing known"):
        describe(DriveInfo("no channels"))


def test_values_beyond_the_format_saturate_and_what_is_no_number_is_flagged() -> None:
    described = Description(1, 0, SERVO.channels)
    encoder, decoder = BinaryEncoder(described), BinaryDecoder()
    source = make_block(
        np.arange(4) * 1e-3,
        voltage_V=np.array([50.0, -50.0, np.nan, 1.0]),
        current_A=np.array([0.0, 0.0, np.inf, 0.0]),
        position_rad=np.array([0.0, 0.0, 0.0, np.nan]),
    )
    block = decoder.feed(encoder.describe() + b"".join(encoder.encode(source)))
    assert block is not None and block.voltage_V is not None
    assert block.voltage_V.tolist() == [32.767, -32.768, 0.0, 1.0]
    assert [Quality(int(q)) for q in block.quality] == [
        Quality.SATURATED,
        Quality.SATURATED,
        Quality.VOLTAGE_INVALID | Quality.CURRENT_INVALID,
        Quality.POSITION_INVALID,
    ]


def test_encoder_needs_the_described_channels() -> None:
    with pytest.raises(ValueError, match="current_A"):
        BinaryEncoder(SERVO).encode(make_block(np.arange(2.0), voltage_V=np.zeros(2)))


def test_what_does_not_fit_the_wire_is_refused() -> None:
    with pytest.raises(ValueError, match="longer than 16 bytes"):
        encode_description(Description(1, 0, SERVO.channels, identity="ü" * 9))
    with pytest.raises(ValueError, match="does not fit"):
        encode_description(Description(256, 0, SERVO.channels))
    with pytest.raises(ValueError, match="1025 bytes"):
        encode_frame(bytes(1025))
    with pytest.raises(ValueError, match="0 bytes"):
        encode_frame(b"")
    zeros = [np.zeros(2, dtype=np.int64)] * 4
    with pytest.raises(ValueError, match=r"1 \.\. 65535"):
        encode_samples(SERVO, 0, np.array([0, 65_536]), zeros)
    with pytest.raises(ValueError, match="0 samples"):
        encode_samples(SERVO, 0, np.array([], dtype=np.int64), zeros)
    with pytest.raises(WireError, match="one twice"):
        Description(1, 0, (Channel(1, 2), Channel(1, 4)))
