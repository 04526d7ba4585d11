"""python-can's slcan interface against the simulated adapter on a pseudo-terminal: faults and pace."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import can
import numpy as np
import pytest
import serial

from drivers.can.bus import CanDriver
from drivers.can.slcan import ReadAhead, is_taken
from servo_daemon.errors import BadInputError, DriverConfigError, DriverDisconnectedError, DriverUnavailableError
from servo_daemon.samples import Quality, SampleBlock
from servo_daemon.sim_drive.pty_link import PtyLink
from servo_daemon.sim_drive.slcan_adapter import SlcanAdapter
from servo_daemon.sim_drive.slcan_device import SlcanFaults, run_slcan_device
from tests.can_tools import RampSource, read_until, samples_in, slcan_drive

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX")

N = 2000


@pytest.fixture
def link(tmp_path: Path) -> Path:
    return tmp_path / "can0"


def driver_on(link: Path, drive_id: int = 1) -> CanDriver:
    return CanDriver("axis1", {"interface": "slcan", "channel": str(link), "bitrate": 1_000_000, "drive_id": drive_id})


def read(link: Path, faults: SlcanFaults, last: int = N) -> tuple[CanDriver, list[SampleBlock]]:
    """Everything a drive with these faults sends, up to the sample with index `last`."""
    with slcan_drive(link, faults=faults), driver_on(link) as driver:
        blocks = read_until(driver, lambda got: bool(got) and int(got[-1].sequence[-1]) >= last)
    return driver, blocks


def joined(blocks: list[SampleBlock], name: str) -> np.ndarray:
    return np.concatenate([getattr(b, name) for b in blocks])


def assert_values_fit_their_number(blocks: list[SampleBlock]) -> None:
    k = joined(blocks, "sequence")
    assert np.allclose(joined(blocks, "time_s"), k * 1e-3, rtol=0, atol=1e-9)
    assert np.allclose(joined(blocks, "voltage_V"), ((k * 37) % 20_001 - 10_000) * 1e-3)
    assert np.allclose(joined(blocks, "position_rad"), k * 7 * 2 * np.pi / 4096)


def test_every_sample_arrives(link: Path) -> None:
    driver, blocks = read(link, SlcanFaults())
    assert_values_fit_their_number(blocks)
    assert np.array_equal(joined(blocks, "sequence"), np.arange(samples_in(blocks)))
    assert not joined(blocks, "quality").any()
    assert driver.counters.framing_errors == 0
    assert not link.is_symlink()


def test_losses_repetitions_and_half_frames(link: Path) -> None:
    """A line that ends in the middle takes the one after it with it; everything else arrives."""
    faults = SlcanFaults(
        lose=frozenset({300, 301, 700}), repeat=frozenset({400, 405, 1000}), cut=frozenset({500, 1200})
    )
    driver, blocks = read(link, faults)
    assert_values_fit_their_number(blocks)
    missing = {300, 301, 700, 500, 501, 1200, 1201}
    k = joined(blocks, "sequence")
    assert np.array_equal(k, [i for i in range(int(k[-1]) + 1) if i not in missing])
    gaps = set(k[(joined(blocks, "quality") & int(Quality.GAP_BEFORE)) != 0].tolist())
    assert gaps == {302, 701, 502, 1202}
    assert driver.counters.samples_lost == len(missing)
    assert driver.counters.samples_repeated == 3
    assert driver.counters.framing_errors == driver.counters.extra["bad_adapter_lines"] > 0


GARBAGE = [
    b"\xff\xfe\x80garbage\r",  # python-can alone would never read another frame after this
    b"t1Z18\r",
    b"t\r",
    b"x\rT123\rt12\r",
    b"t1218AABB\r",
    b"\a\r\a\rz\rZ\r",
    bytes(range(256)) + b"\r",
]


@pytest.mark.parametrize("noise", GARBAGE)
def test_garbage_costs_nothing_but_itself(link: Path, noise: bytes) -> None:
    driver, blocks = read(link, SlcanFaults(garbage={100: noise, 900: noise, 1500: noise}))
    assert_values_fit_their_number(blocks)
    assert np.array_equal(joined(blocks, "sequence"), np.arange(samples_in(blocks)))
    assert driver.counters.samples_lost == 0


def test_a_silence_is_a_gap(link: Path) -> None:
    """Half a second, in which the 16-bit time wraps seven times."""
    with slcan_drive(link, realtime=True, faults=SlcanFaults(silence=range(400, 900))), driver_on(link) as driver:
        silent = False
        blocks = []
        while not blocks or blocks[-1].sequence[-1] < 1000:
            block = driver.read(0.2)
            silent |= block is None
            blocks += [block] if block is not None else []
    assert silent
    assert_values_fit_their_number(blocks)
    k = joined(blocks, "sequence")
    assert np.array_equal(k, [i for i in range(int(k[0]), int(k[-1]) + 1) if not 400 <= i < 900])
    assert driver.counters.samples_lost == 500
    assert driver.counters.device_restarts == 0


def test_a_bitrate_no_adapter_has_is_refused(link: Path) -> None:
    driver = CanDriver("axis1", {"interface": "slcan", "channel": str(link), "bitrate": 12_345})
    with slcan_drive(link), pytest.raises(DriverConfigError, match=r"axis1.*bitrate"):
        driver.open()


def test_an_adapter_has_one_reader(link: Path) -> None:
    """Two programs would take each other's frames away."""
    with slcan_drive(link):
        with serial.Serial(str(link), timeout=0, exclusive=True), pytest.raises(DriverUnavailableError, match="in use"):
            driver_on(link).open()
        with driver_on(link):
            assert is_taken(str(link))
        assert not is_taken(str(link))


def test_a_restart_of_the_device(link: Path) -> None:
    driver, blocks = read(link, SlcanFaults(restart=frozenset({1001})))
    restarted = [b for b in blocks if b.quality[0] & Quality.TIME_RESTART]
    assert len(restarted) == driver.counters.device_restarts == 1
    assert restarted[0].time_s[0] == pytest.approx(0.0)
    assert restarted[0].sequence[0] == 1001
    assert all((np.diff(b.time_s) > 0).all() for b in blocks)
    assert driver.counters.samples_lost == 0


def test_in_real_time_and_back_after_the_adapter_was_away(link: Path) -> None:
    driver = driver_on(link)
    with slcan_drive(link, realtime=True) as unplug:
        driver.open()
        read_until(driver, lambda got: samples_in(got) >= 100)
        unplug.set()
        with pytest.raises(DriverDisconnectedError, match="axis1"):
            while True:
                driver.read(1.0)
        driver.close()
    with pytest.raises(DriverUnavailableError, match="axis1"):
        driver.open()
    with slcan_drive(link, realtime=True):
        driver.open()
        read_until(driver, lambda got: samples_in(got) >= 100)
        driver.close()
    assert driver.counters.samples >= 200


def test_python_can_alone_reads_it_too(link: Path) -> None:
    """Nothing in the simulated adapter leans on our driver."""
    with (
        slcan_drive(link, drive_id=5),
        can.Bus(interface="slcan", channel=str(link), bitrate=500_000, sleep_after_open=0, ignore_config=True) as bus,
    ):
        ids = {m.arbitration_id for m in (bus.recv(5.0) for _ in range(60)) if m is not None}
        assert ids == {0x105, 0x125, 0x685}


def test_a_host_that_does_not_fetch_loses_frames_and_the_adapter_lives(link: Path) -> None:
    """The pseudo-terminal fills up; nothing blocks, and what is dropped is counted."""
    stop = threading.Event()
    result: list[int] = []
    source = RampSource(period_s=5e-5)
    thread = threading.Thread(
        target=lambda: result.append(run_slcan_device(link, source, stop=stop, realtime=True)), daemon=True
    )
    thread.start()
    while not link.exists():
        pass
    port = os.open(link, os.O_RDWR | os.O_NOCTTY)
    os.write(port, b"S8\rO\r")
    start = source.index
    while source.index < start + 20_000:
        stop.wait(0.01)
    stop.set()
    thread.join(10)
    os.close(port)
    assert not thread.is_alive()
    assert result[0] > 1000


# ---- the adapter's commands


@pytest.mark.parametrize(
    ("commands", "answers"),
    [
        (b"V\rN\r", b"V1013\rNSD01\r"),
        (b"S8\rO\rO\rC\rC\r", b"\r\r\a\r\a"),
        (b"S9\rS\rS88\rsFFFF\rs12\rsGGGG\r", b"\a\a\a\r\a\a"),
        (b"O\rS8\rZ1\rs0000\r", b"\r\a\a\a"),
        (b"F\rO\rF\r", b"\a\rF00\r"),
        (b"Z1\rZ0\rZ2\rZ\r", b"\r\r\a\a"),
        (b"M00000000\rmFFFFFFFF\rM0\r", b"\r\r\a"),
        (b"t1230\r", b"\a"),
        (b"O\rt1230\rt12321122\rt1232112\rt123\rt1239\rT000001231FF\rr1238\rR000001238\r", b"\rz\rz\r\a\a\aZ\rz\rZ\r"),
        (b"L\rt1230\rC\r", b"\r\a\r"),
        (b"\rX\r" + b"t" * 100 + b"\rV\r", b"\r\a\aV1013\r"),
        (b"\xff\x00\r", b"\a"),
    ],
)
def test_answers(commands: bytes, answers: bytes) -> None:
    assert SlcanAdapter().feed(commands) == answers
    adapter = SlcanAdapter()
    assert b"".join(adapter.feed(bytes([b])) for b in commands) == answers


def test_frame_lines() -> None:
    adapter = SlcanAdapter()
    assert adapter.frame_line(0x12, b"\x01\xab", 70_000) == b"t012201AB\r"
    adapter.feed(b"Z1\r")
    assert adapter.frame_line(0x12, b"\x01\xab", 70_000) == b"t012201AB2710\r"


# ---- the pseudo-terminal's name


def test_a_stale_link_is_replaced_and_a_file_never(tmp_path: Path) -> None:
    link = tmp_path / "port"
    link.symlink_to("/dev/pts/nothing")
    with PtyLink(link):
        assert link.readlink() != Path("/dev/pts/nothing")
    assert not link.is_symlink()
    link.write_text("precious")
    with pytest.raises(BadInputError, match="port"):
        PtyLink(link).__enter__()
    assert link.read_text() == "precious"
    with pytest.raises(BadInputError, match="nowhere"):
        PtyLink(tmp_path / "nowhere" / "port").__enter__()


def test_the_link_of_a_successor_is_left_alone(tmp_path: Path) -> None:
    link = tmp_path / "port"
    first, second = PtyLink(link), PtyLink(link)
    with second:
        with first:
            second.__enter__()
        assert link.is_symlink()
    assert not link.is_symlink()


# ---- the read-ahead


class Port:
    """A serial port that has received these portions."""

    timeout = 0

    def __init__(self, *portions: bytes) -> None:
        self.portions = list(portions)

    @property
    def in_waiting(self) -> int:
        return len(self.portions[0]) if self.portions else 0

    def read(self, size: int) -> bytes:
        return self.portions.pop(0)[:size] if self.portions else b""

    def reset_input_buffer(self) -> None:
        self.portions.clear()


def test_read_ahead_hands_out_what_arrived() -> None:
    port = ReadAhead(Port(b"t12\xff3", b"0\r"))
    assert port.in_waiting == 5
    assert not port.buffered
    assert port.read(1) == b"t"
    assert port.buffered
    assert port.in_waiting == 4
    assert port.read(9) == b"12?3"
    assert port.read(2) == b"0\r"
    assert port.read(1) == b""
    assert port.timeout == 0


def test_read_ahead_ends_a_line_that_does_not_end() -> None:
    """What python-can gathers of it stays small; the frame after its end arrives whole."""
    port = ReadAhead(Port(*[b"t" * 60] * 1000, b"\rt1230\r"))
    got = b"".join(iter(lambda: port.read(7), b""))
    lines = got.split(b"\r")
    assert max(map(len, lines)) < 400
    assert lines[-2:] == [b"t1230", b""]


def test_read_ahead_forgets_on_reset() -> None:
    port = ReadAhead(Port(b"abc", b"def"))
    port.read(1)
    port.reset_input_buffer()
    assert not port.buffered
    assert port.read(1) == b""
