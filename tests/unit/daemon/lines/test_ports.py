"""Lines that one thread reads in turn."""

from __future__ import annotations

import os
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.feeder import frames
from drivers.serial.line import SerialDriver
from servo_daemon.config import DriveConfig
from servo_daemon.daemon.drive import DriveRuntime
from servo_daemon.daemon.lines.ports import ASKED_FOR_S, UNASKED_EVERY_S, Ports
from servo_daemon.daemon.lines.reader import Reader
from servo_daemon.samples import SampleBlock
from tests.daemon_rig import Fed


class Line:
    def __init__(self, goes_on: bool = True) -> None:
        self.goes_on, self.polls = goes_on, 0

    def poll(self) -> bool:
        self.polls += 1
        return self.goes_on


def test_while_nobody_waits_they_are_read_once_a_tick() -> None:
    now = [100.0]
    ports = Ports(lambda: now[0])
    ports.add(Line())
    waits = []
    for now[0], asked in (
        (100.0, ""),
        (200.0, "axis1"),
        (200.05, "axis2"),  # ten pages with a drive each ask in turn
        (200.25, "axis2"),
        (200.3, "axis2"),
        (200.3 + ASKED_FOR_S - 0.1, ""),
        (200.3 + ASKED_FOR_S + 0.1, ""),
    ):
        if asked:
            ports.ask(asked)
        ports.read()
        waits.append(round(ports.wait_s(1.0), 9))
    assert waits == [UNASKED_EVERY_S, UNASKED_EVERY_S, 0.05, UNASKED_EVERY_S, 0.05, 0.04, UNASKED_EVERY_S]


def test_all_are_read_once_in_40_ms_and_seldomer_where_they_are_many() -> None:
    now = [100.0]
    ports = Ports(lambda: now[0])
    ports.ask("axis1")
    ports.ask("axis1")
    assert ports.wait_s(0.1) == 0.1
    lines = [Line() for _ in range(10)]
    for line in lines:
        ports.add(line)
    assert ports.wait_s(0.1) == 0.0
    ports.read()
    now[0] += 0.02
    ports.read()
    assert [line.polls for line in lines] == [1] * 10 and abs(ports.wait_s(0.1) - 0.02) < 1e-9
    for _ in range(90):
        ports.add(Line())
    now[0] += 0.03
    ports.read()
    assert abs(ports.wait_s(1.0) - 0.09) < 1e-9


@pytest.mark.parametrize(("used_s", "next_in_s"), [(0.0, 0.0), (0.4, 0.2)])
def test_the_pause_is_three_times_what_reading_used_of_the_processor(used_s: float, next_in_s: float) -> None:
    """A second passes while the lines are read. What others had of it makes nobody read them more seldom."""
    now, cpu = [100.0], [7.0]

    class Slow(Line):
        def poll(self) -> bool:
            now[0] += 1.0
            cpu[0] += used_s
            return True

    ports = Ports(lambda: now[0], lambda: cpu[0])
    ports.add(Slow())
    ports.read()
    assert ports.wait_s(5.0) == pytest.approx(next_in_s)


def test_a_line_that_has_ended_is_not_asked_again() -> None:
    now = [0.0]
    ports, ended = Ports(lambda: now[0]), Line(goes_on=False)
    ports.add(ended)
    for now[0] in (1.0, 2.0):
        ports.read()
    assert ended.polls == 1 and len(ports) == 0


@pytest.fixture
def terminal(tmp_path: Path) -> Iterator[tuple[int, Path]]:
    master, slave = os.openpty()
    tty.setraw(slave)
    yield master, Path(os.ttyname(slave))
    os.close(slave)
    os.close(master)


def test_a_serial_port_is_read_by_whoever_reads_the_ports_and_its_own_thread_sees_it_go(
    terminal: tuple[int, Path],
) -> None:
    master, path = terminal
    ports, said, readers = Ports(), [], []
    reader = Reader(SerialDriver("axis1", {"port": str(path)}), lambda: None, lambda *told: said.append(told), ports)
    read = reader.driver._read

    def noted(timeout_s: float) -> SampleBlock | None:
        readers.append(threading.current_thread())
        return read(timeout_s)

    reader.driver._read = noted  # type: ignore[method-assign]
    reader.start()
    try:
        until(lambda: len(ports) == 1)
        description, samples = frames(0.1)
        os.write(master, description + b"".join(samples))
        until(lambda: (ports.read(), reader.queue.samples == 100)[1])
        assert {thread.name for thread in readers} == {threading.current_thread().name}
        reader.driver.close()  # as a device that went away: the port's own thread takes over
        until(lambda: (ports.read(), len(ports) == 0 or reader.link.connection != "connected")[1])
        until(lambda: (ports.read(), reader.reconnects == 1 and len(ports) == 1)[1])
    finally:
        reader.stop()
    assert not reader.alive and len(ports) == 0


def until(done: object, patience_s: float = 10.0) -> None:
    assert callable(done)
    deadline = time.monotonic() + patience_s
    while not done():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.005)


def test_pages_and_brokers_that_look_at_a_drive_do_not_wait_for_it() -> None:
    now = [100.0]
    ports = Ports(lambda: now[0])
    drive = DriveRuntime(DriveConfig(), Fed("axis1", {}), None, lambda: None, ports=ports)
    ports.add(Line())
    waits = []
    for ask in (drive.snapshot, drive.newest):
        for _ in range(3):
            now[0] += UNASKED_EVERY_S / 2
            ask()
        ports.read()
        waits.append(round(ports.wait_s(1.0), 9))
    assert waits == [UNASKED_EVERY_S, 0.04]
