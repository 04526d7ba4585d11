"""What goes wrong on a serial line, over real pseudo-terminals: nothing but the typed errors, and every good sample."""

from __future__ import annotations

import errno
import os
import random
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import serial
from serial.tools import list_ports

from drivers.base import DriveInfo
from drivers.serial.frame import encode_frame
from drivers.serial.line import SerialDriver
from drivers.serial.port import existing_ports
from drivers.serial.wire import encode_samples
from servo_daemon.errors import DriverConfigError, DriverDisconnectedError, DriverUnavailableError
from servo_daemon.samples import Quality, SampleBlock, concatenate
from servo_daemon.sim_drive.line_faults import Fault, LineFaults
from tests.drivers.conformance import read_until
from tests.drivers.serial_rig import RAMP_INFO, Ramp, assert_is_ramp, serial_rig, wait_for
from tests.wire_tools import SERVO, describe, frame


@pytest.fixture
def link(tmp_path: Path) -> Path:
    return tmp_path / "drive"


@pytest.fixture
def driver(link: Path) -> Iterator[SerialDriver]:
    driver = SerialDriver("axis1", {"port": str(link)})
    yield driver
    driver.close()


@pytest.fixture
def line() -> Iterator[tuple[int, str]]:
    """A bare line: the end to write to, and the port's name."""
    master, slave = os.openpty()
    yield master, os.ttyname(slave)
    os.close(slave)
    os.close(master)


def read_to_the_last(driver: SerialDriver, last: int) -> SampleBlock:
    """Everything up to the sample of that number."""
    blocks: list[SampleBlock] = []

    def arrived() -> bool:
        block = driver.read(0.05)
        if block is not None:
            blocks.append(block)
        return bool(blocks) and int(blocks[-1].sequence[-1]) >= last

    wait_for(arrived, f"sample {last}")
    return concatenate(blocks)


def run_with(faults: dict[int, Fault], link: Path, driver: SerialDriver, samples: int = 3000) -> SampleBlock:
    """All samples a finite drive delivers when these frames (of 10) go wrong."""
    with serial_rig(link, Ramp(samples), realtime=False, faults=LineFaults(faults)), driver:
        block = read_to_the_last(driver, samples - 1)
        assert driver.counters.samples == len(block)
        return block


def missing(block: SampleBlock, samples: int = 3000) -> list[int]:
    """Frames of which nothing came."""
    return sorted({k // 10 for k in set(range(samples)) - set(block.sequence.tolist())})


def test_a_clean_line_loses_nothing(link: Path, driver: SerialDriver) -> None:
    block = run_with({}, link, driver)
    assert block.sequence.tolist() == list(range(3000))
    assert_is_ramp(block)
    assert not block.quality.any()
    info = driver.info
    assert info == DriveInfo("RAMP-1#1", 1e-3, 4096.0, 1e-4, 1e-3, RAMP_INFO.channels)


def test_dropped_frames_are_gaps(link: Path, driver: SerialDriver) -> None:
    block = run_with({5: Fault.DROP, 100: Fault.DROP, 101: Fault.DROP}, link, driver)
    assert missing(block) == [5, 100, 101]
    assert_is_ramp(block)
    assert block.sequence[block.quality == Quality.GAP_BEFORE].tolist() == [60, 1020]
    assert driver.counters.samples_lost == 30


def test_repeated_frames_come_once(link: Path, driver: SerialDriver) -> None:
    block = run_with({5: Fault.REPEAT, 299: Fault.REPEAT}, link, driver)
    assert block.sequence.tolist() == list(range(3000))
    assert_is_ramp(block)
    wait_for(lambda: driver.counters.samples_repeated >= 1, "the repetition is counted")


def test_damaged_and_cut_frames_and_garbage_cost_only_themselves(link: Path, driver: SerialDriver) -> None:
    block = run_with({7: Fault.CORRUPT, 50: Fault.CUT, 90: Fault.GARBAGE, 140: Fault.CORRUPT}, link, driver)
    assert missing(block) == [7, 50, 51, 140]  # what follows a cut without delimiter is lost with it
    assert_is_ramp(block)
    assert driver.counters.crc_errors + driver.counters.framing_errors >= 4
    assert driver.counters.device_restarts == 0


def test_a_restarted_device_goes_on_flagged(link: Path, driver: SerialDriver) -> None:
    block = run_with({100: Fault.RESTART}, link, driver)
    assert block.sequence.tolist() == list(range(3000))
    np.testing.assert_allclose(np.diff(block.time_s), 1e-3, atol=1e-9)
    assert np.flatnonzero(block.quality).tolist() == [1000]
    assert block.quality[1000] == Quality.TIME_RESTART
    assert block.position_rad is not None
    counts = np.rint(block.position_rad * 4096 / (2 * np.pi))
    assert counts[[999, 1000, 1001]].tolist() == [999, 0, 1]
    assert driver.counters.device_restarts == 1


def test_pulled_out_and_plugged_in_again(link: Path, driver: SerialDriver) -> None:
    with serial_rig(link) as rig, driver:
        before = read_until(driver, 20)
        rig.halt()
        with pytest.raises(DriverDisconnectedError, match=rf"axis1.*{link}"):
            wait_for(lambda: driver.read(0.05) is None and False, "the port is gone")
    for _ in range(2):
        with pytest.raises(DriverUnavailableError, match=rf"axis1.*{link} does not exist"):
            driver.open()
    with serial_rig(link), driver:  # a device of the same name that starts at 0 again
        after = read_until(driver, 20)
    everything = concatenate([*before, *after])
    assert (np.diff(everything.time_s) > 0).all() and (np.diff(everything.sequence) > 0).all()
    assert after[0].quality[0] == Quality.TIME_RESTART
    assert driver.counters.device_restarts == 1


def test_a_cable_out_for_a_while_is_a_gap(link: Path, driver: SerialDriver) -> None:
    with serial_rig(link) as rig:
        with driver:
            before = read_until(driver, 20)
        sent = rig.counters.unheard
        wait_for(lambda: rig.counters.unheard > sent + 20, "frames nobody hears")
        with driver:
            after = read_until(driver, 20)
    everything = concatenate([*before, *after])
    assert_is_ramp(everything)
    assert (np.diff(everything.sequence) > 0).all()
    assert after[0].quality[0] == Quality.GAP_BEFORE
    first, last = int(before[0].sequence[0]), int(after[-1].sequence[-1])
    assert driver.counters.samples_lost == last - first + 1 - len(everything)
    assert driver.counters.device_restarts == 0


def test_noise_of_a_wrong_baud_rate_is_counted_and_nothing_more(line: tuple[int, str]) -> None:
    master, port = line
    noise = random.Random(3).randbytes(3000)
    driver = SerialDriver("axis1", {"port": port, "baudrate": 57600})
    with driver:
        os.write(master, noise)
        wait_for(lambda: driver.read(0.02) is None, "the noise is read")
        counters = driver.counters
        assert counters.crc_errors + counters.framing_errors > 5
        assert counters.samples == 0
        assert driver.info == DriveInfo(identity="")
        os.write(master, b"\0" + describe() + frame(0))
        assert sum(map(len, read_until(driver, 10))) == 10


def test_frames_in_pieces(line: tuple[int, str]) -> None:
    master, port = line
    with SerialDriver("axis1", {"port": port}) as driver:
        wire = describe() + frame(0)
        for byte in wire[:-1]:
            os.write(master, bytes([byte]))
        assert driver.read(0.05) is None
        os.write(master, wire[-1:])
        assert sum(map(len, read_until(driver, 1))) == 10


def test_one_read_takes_everything_there_is(line: tuple[int, str], monkeypatch: pytest.MonkeyPatch) -> None:
    master, port = line
    sizes: list[int] = []
    real_read = serial.Serial.read

    def read(self: serial.Serial, size: int = 1) -> bytes:
        data = bytes(real_read(self, size))
        sizes.append(len(data))
        return data

    monkeypatch.setattr(serial.Serial, "read", read)
    with SerialDriver("axis1", {"port": port}) as driver:
        wire = describe() + b"".join(frame(k) for k in range(0, 200, 10))
        os.write(master, wire)
        assert sum(map(len, read_until(driver, 200))) == 200
    assert sum(sizes) == len(wire)
    assert len(sizes) <= 4  # a terminal hands out up to 4 kB at once; certainly no byte by byte


def test_a_change_of_channels_is_a_new_block(line: tuple[int, str]) -> None:
    master, port = line
    fewer = replace(SERVO, session=2, channels=SERVO.channels[:2])
    wire = encode_frame(encode_samples(fewer, 10, np.array([10_000]), [np.array([1]), np.array([2])]))
    with SerialDriver("axis1", {"port": port}) as driver:
        os.write(master, describe() + frame(0) + describe(fewer) + wire)
        first, second = read_until(driver, 11)
    assert (len(first), len(second)) == (10, 1)
    assert second.channels == ("voltage_V", "current_A")


def test_port_in_use(link: Path, driver: SerialDriver) -> None:
    second = SerialDriver("axis2", {"port": str(link)})
    with serial_rig(link), driver:
        with pytest.raises(DriverUnavailableError, match=r"axis2.*in use by another program"):
            second.open()
        assert read_until(driver, 1)


def test_port_that_is_no_port(link: Path, driver: SerialDriver) -> None:
    link.write_text("a file")
    with pytest.raises(DriverUnavailableError, match=r"axis1.*cannot be opened"):
        driver.open()
    assert not driver.is_open


@pytest.mark.parametrize(
    ("raised", "text"),
    [
        (serial.SerialException(errno.EACCES, "no"), "may not be opened by this user"),
        (serial.SerialException(errno.EBUSY, "no"), "in use by another program"),
        (OSError(errno.EIO, "strange"), "cannot be opened.*strange"),
    ],
)
def test_reasons_are_told(raised: Exception, text: str, driver: SerialDriver, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*args: object, **kwargs: object) -> None:
        raise raised

    monkeypatch.setattr(serial, "Serial", fail)
    with pytest.raises(DriverUnavailableError, match=text):
        driver.open()


def test_an_impossible_baud_rate_is_a_matter_of_configuration(line: tuple[int, str]) -> None:
    driver = SerialDriver("axis1", {"port": line[1], "baudrate": 10**12})
    with pytest.raises(DriverConfigError, match="axis1"):
        driver.open()


def test_a_missing_port_tells_which_there_are(driver: SerialDriver, monkeypatch: pytest.MonkeyPatch) -> None:
    class Port:
        device = "/dev/ttyTEST7"

    monkeypatch.setattr("pathlib.Path.is_dir", lambda self: False)
    monkeypatch.setattr(list_ports, "comports", lambda: [Port])
    with pytest.raises(DriverUnavailableError, match="/dev/ttyTEST7"):
        driver.open()
    monkeypatch.setattr(list_ports, "comports", list)
    assert existing_ports() == "there are no serial ports here"


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({}, "port"),
        ({"port": ""}, "port"),
        ({"port": "x", "wire": "text"}, "counts_per_rev"),
        ({"port": "x", "wire": "text", "counts_per_rev": 0.0}, "counts_per_rev"),
        ({"port": "x", "wire": "text", "counts_per_rev": 1.0, "drive_id": 3}, "drive_id"),
        ({"port": "x", "counts_per_rev": 4096.0}, "counts_per_rev"),
        ({"port": "x", "sample_period_s": 0.001}, "sample_period_s"),
    ],
)
def test_options_that_do_not_fit(options: dict[str, Any], text: str) -> None:
    with pytest.raises(DriverConfigError, match=text):
        SerialDriver("axis1", options)


def test_text_wire_knows_what_it_was_told() -> None:
    options = {"port": "/dev/ttyX", "wire": "text", "counts_per_rev": -2400, "current_lsb_A": 0.01}
    assert SerialDriver("axis1", options).info == DriveInfo(
        "serial:/dev/ttyX", None, 2400.0, 0.01, 1e-3, ("voltage_V", "current_A", "position_rad")
    )


def test_text_wire_reads_the_same_samples(link: Path) -> None:
    options = {"port": str(link), "wire": "text", "counts_per_rev": 4096.0, "sample_period_s": 1e-3}
    driver = SerialDriver("axis1", options)
    faults = LineFaults({20: Fault.DROP, 40: Fault.REPEAT, 60: Fault.RESTART})
    with serial_rig(link, Ramp(1000), wire="text", realtime=False, faults=faults), driver:
        blocks: list[SampleBlock] = []

        def arrived() -> bool:
            block = driver.read(0.05)
            if block is not None:
                blocks.append(block)
            return driver.counters.samples >= 980

        wait_for(arrived, "the last line")
    block = concatenate(blocks)
    steps = np.diff(block.time_s)
    assert (steps > 0).all()
    assert driver.counters.samples_lost >= 10  # the group that was dropped, and what preceded the first line
    assert driver.counters.device_restarts >= 1
    assert int((block.quality == Quality.TIME_RESTART).sum()) == driver.counters.device_restarts


class TestDevice:
    """The simulated device itself behaves as a UART."""

    def test_slow_reader_loses_samples_and_blocks_nobody(self, link: Path, driver: SerialDriver) -> None:
        with serial_rig(link, samples_per_frame=200) as rig, driver:
            wait_for(lambda: rig.counters.overruns > 2, "the terminal is full")
            blocks = read_until(driver, 1)
            while driver.counters.samples_lost == 0:
                blocks += read_until(driver, 1)
        block = concatenate(blocks)
        assert_is_ramp(block)
        assert (block.quality & Quality.GAP_BEFORE).any()
        assert (np.diff(block.sequence) > 0).all()

    def test_what_nobody_hears_is_gone(self, link: Path, driver: SerialDriver) -> None:
        with serial_rig(link) as rig:
            wait_for(lambda: rig.counters.unheard > 10, "frames nobody hears")
            unheard = rig.counters.samples
            with driver:
                (block, *_) = read_until(driver, 1)
        assert block.sequence[0] >= unheard - 20

    def test_what_the_host_sends_is_swallowed(self, link: Path, driver: SerialDriver) -> None:
        with serial_rig(link), driver:
            with serial.Serial(str(link)) as other:
                other.write(b"hello" * 100)
            assert_is_ramp(concatenate(read_until(driver, 50)))

    def test_stale_link_is_replaced_and_own_link_removed(self, link: Path) -> None:
        link.symlink_to("/dev/pts/does-not-exist")
        with serial_rig(link):
            assert link.resolve().exists()
        assert not link.is_symlink()

    def test_link_of_a_successor_stays(self, link: Path) -> None:
        with serial_rig(link):
            link.unlink()
            link.symlink_to("/dev/null")
        assert link.readlink() == Path("/dev/null")

    def test_faults_on_demand(self, link: Path, driver: SerialDriver) -> None:
        faults = LineFaults()
        with serial_rig(link, faults=faults), driver:
            read_until(driver, 1)
            faults.inject(Fault.DROP)
            lost = driver.counters.samples_lost
            wait_for(lambda: _reads(driver, lambda: driver.counters.samples_lost > lost), "the drop is noticed")


def _reads(driver: SerialDriver, condition: Callable[[], bool]) -> bool:
    driver.read(0.05)
    return condition()
