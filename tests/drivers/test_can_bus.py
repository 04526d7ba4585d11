"""The CAN driver on a bus: sharing it, error frames, bus-off, adapters that are not there or go away, silence."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from drivers.can import port as can_port
from drivers.can import receive as can_receive
from drivers.can.bus import CanDriver
from drivers.can.receive import MAX_BAD_IN_A_ROW
from servo_daemon.errors import DriverConfigError, DriverDisconnectedError, DriverUnavailableError
from servo_daemon.sim_drive.can_frames import CanFrame
from tests.can_tools import (
    RampSource,
    frames_of,
    message_of,
    new_channel,
    read_until,
    samples_in,
    virtual_sender,
    wait_for,
)

BUS_OFF, CONTROLLER_PROBLEM = 0x40, 0x04


@pytest.fixture
def channel() -> str:
    return new_channel()


def driver_on(channel: str, drive_id: int = 1, **options: Any) -> CanDriver:
    return CanDriver(f"axis{drive_id}", {"interface": "virtual", "channel": channel, "drive_id": drive_id, **options})


def still_open(channel: object) -> bool:
    return any(name == str(channel) for _, name in can_port.CanPort._open)


def error_frame(error_class: int) -> can.Message:
    return can.Message(arbitration_id=error_class, is_extended_id=False, is_error_frame=True, data=bytes(8))


class ScriptedBus(can.BusABC):
    """A bus without `fileno` that yields messages and raises errors as told, then is silent."""

    script: list[can.Message | Exception]

    def __init__(self, channel: Any = None, **_: Any) -> None:
        self.channel_info = "scripted"
        super().__init__(channel)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self.script:
            time.sleep(min(timeout or 0.0, 0.01))
            return None, False
        step = self.script.pop(0)
        if isinstance(step, Exception):
            raise step
        return step, False

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise NotImplementedError


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[can.Message | Exception]]:
    """What the next bus that is opened will do."""
    ScriptedBus.script = []
    monkeypatch.setattr(can_receive.can, "Bus", lambda **kwargs: ScriptedBus(kwargs.get("channel")))
    yield ScriptedBus.script


def messages_of(frames: list[CanFrame]) -> list[can.Message | Exception]:
    return [message_of(f.frame_id, f.data) for f in frames]


def os_error() -> can.CanOperationError:
    """As python-can wraps what the operating system says."""
    error = can.CanOperationError("Could not read from serial device")
    error.__cause__ = OSError(5, "Input/output error")
    return error


def test_eight_drives_on_one_bus(channel: str) -> None:
    """One bus object for all; each gets its own frames, all of them, and no other."""
    drivers = [driver_on(channel, n) for n in range(1, 9)]
    sources = [RampSource(counts_per_sample=n) for n in range(1, 9)]
    frames = [f for n, source in enumerate(sources, 1) for f in frames_of(source, 1500, n)]
    frames.sort(key=lambda f: f.sample)
    with virtual_sender(channel) as send:
        for driver in drivers:
            driver.open()
        assert len({id(d._port) for d in drivers}) == 1
        threading.Thread(target=send, args=(frames,), daemon=True).start()
        for n, driver in enumerate(drivers, 1):
            blocks = read_until(driver, lambda got: samples_in(got) >= 1500)
            position = np.concatenate([b.position_rad for b in blocks])
            assert np.allclose(np.diff(position) / (2 * np.pi / 4096), n)
            assert samples_in(blocks) == 1500
            assert driver.counters.samples_lost == 0
            assert driver.counters.unknown_frames == len(frames) - driver.counters.frames
        for driver in drivers:
            driver.close()
    assert not still_open(channel)


def test_one_of_two_drives_leaves_and_the_other_reads_on(channel: str) -> None:
    one, two = driver_on(channel, 1), driver_on(channel, 2)
    with virtual_sender(channel) as send, one:
        with two:
            send(frames_of(RampSource(), 10, 1) + frames_of(RampSource(), 10, 2))
            assert samples_in(read_until(two, lambda got: samples_in(got) >= 10)) == 10
        assert samples_in(read_until(one, lambda got: samples_in(got) >= 10)) == 10
        send(frames_of(RampSource(start_us=10_000), 10, 1))
        assert samples_in(read_until(one, lambda got: samples_in(got) >= 10)) == 10


def test_a_bus_that_is_open_with_other_settings_is_refused(channel: str) -> None:
    other = driver_on(channel, 2, bitrate=500_000)
    with driver_on(channel, 1), pytest.raises(DriverConfigError, match=r"axis2.*other settings"):
        other.open()
    other.open()
    other.close()


def test_error_frames_are_counted_and_the_samples_arrive(channel: str) -> None:
    frames = frames_of(RampSource(), 200)
    with driver_on(channel) as driver, can.Bus(interface="virtual", channel=channel, ignore_config=True) as bus:
        for k, frame in enumerate(frames):
            bus.send(message_of(frame.frame_id, frame.data))
            if k % 10 == 0:
                bus.send(error_frame(CONTROLLER_PROBLEM))
                bus.send(can.Message(arbitration_id=0x121, is_extended_id=False, is_remote_frame=True, dlc=8))
                bus.send(message_of(0x121, bytes(8), extended=True))
        read_until(driver, lambda got: samples_in(got) >= 200)
        n = (len(frames) + 9) // 10
        wait_for(lambda: driver.counters.extra.get("error_frames") == n, "all error frames")
        assert driver.counters.framing_errors == n
        assert driver.counters.unknown_frames == n
        assert driver.counters.samples_lost == 0


def test_bus_off_ends_the_connection_after_the_samples_before_it(channel: str) -> None:
    frames = frames_of(RampSource(), 50)
    driver = driver_on(channel)
    with can.Bus(interface="virtual", channel=channel, ignore_config=True) as bus:
        driver.open()
        for frame in frames:
            bus.send(message_of(frame.frame_id, frame.data))
        bus.send(error_frame(BUS_OFF))
        assert samples_in(read_until(driver, lambda got: samples_in(got) >= 50)) == 50
        with pytest.raises(DriverDisconnectedError, match=r"axis1.*bus-off"):
            driver.read(5.0)
        driver.close()
        driver.open()  # as the service does after its back-off
        bus.send(message_of(frames[0].frame_id, frames[0].data))
        for frame in frames:
            bus.send(message_of(frame.frame_id, frame.data))
        assert samples_in(read_until(driver, lambda got: samples_in(got) >= 50)) == 50
        driver.close()


@pytest.mark.parametrize(
    "error", [os_error(), can.CanOperationError("gone", error_code=19), RuntimeError("odd library")]
)
def test_an_adapter_that_goes_away_delivers_what_it_had(
    script: list[can.Message | Exception], channel: str, error: Exception
) -> None:
    script += [*messages_of(frames_of(RampSource(), 30)), error]
    driver = driver_on(channel)
    driver.open()
    assert samples_in(read_until(driver, lambda got: samples_in(got) >= 30)) == 30
    with pytest.raises(DriverDisconnectedError, match="axis1"):
        driver.read(5.0)
    with pytest.raises(DriverDisconnectedError, match="axis1"):
        driver.read(0.0)
    driver.close()
    assert not still_open(channel)


def test_all_drives_of_an_adapter_hear_that_it_went(script: list[can.Message | Exception], channel: str) -> None:
    one, two = driver_on(channel, 1), driver_on(channel, 2)
    one.open()
    two.open()
    script.append(os_error())
    for driver in (one, two):
        with pytest.raises(DriverDisconnectedError):
            driver.read(5.0)
    one.close()
    one.open()  # a new bus, while the other still holds the dead one
    two.close()
    assert one.read(0.0) is None
    one.close()
    assert not still_open(channel)


def test_a_message_the_library_cannot_read_is_counted(script: list[can.Message | Exception], channel: str) -> None:
    frames = messages_of(frames_of(RampSource(), 60))
    odd = [ValueError("invalid literal"), IndexError("string index"), can.CanOperationError("checksum")]
    short = can.Message(arbitration_id=0x121, is_extended_id=False, dlc=8, data=b"\x01\x02")
    script += [x for k, frame in enumerate(frames) for x in (frame, *([odd[k % 3], short] if k % 20 == 0 else []))]
    with driver_on(channel) as driver:
        assert samples_in(read_until(driver, lambda got: samples_in(got) >= 60)) == 60
        assert (
            driver.counters.framing_errors == driver.counters.extra["bad_adapter_lines"] == 2 * (-(-len(frames) // 20))
        )
        assert driver.counters.samples_lost == 0


def test_a_library_that_does_not_stop_complaining_is_gone(script: list[can.Message | Exception], channel: str) -> None:
    script += [can.CanOperationError("checksum") for _ in range(MAX_BAD_IN_A_ROW + 1)]
    with driver_on(channel) as driver, pytest.raises(DriverDisconnectedError, match="checksum"):
        driver.read(5.0)


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"interface": "socketcan", "channel": "nocan9"}, DriverUnavailableError),
        ({"interface": "slcan", "channel": "/nonexistent/port"}, DriverUnavailableError),
        ({"interface": "slcan"}, DriverConfigError),
        ({"interface": "no_such_interface", "channel": "x"}, DriverConfigError),
    ],
)
def test_what_cannot_be_opened(options: dict[str, Any], error: type[Exception]) -> None:
    driver = CanDriver("axis1", options)
    for _ in range(2):
        with pytest.raises(error, match="axis1"):
            driver.open()
        assert not driver.is_open
    assert not still_open(options.get("channel"))


def test_an_interface_whose_library_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(**_: Any) -> can.BusABC:
        raise can.CanInterfaceNotImplementedError("Cannot import module gs_usb")

    monkeypatch.setattr(can_receive.can, "Bus", missing)
    with pytest.raises(DriverConfigError, match="gs_usb"):
        CanDriver("axis1", {"interface": "gs_usb", "channel": 0}).open()


def test_a_silent_bus_gives_none_in_time(channel: str) -> None:
    with driver_on(channel) as driver, virtual_sender(channel) as send:
        start = time.monotonic()
        assert driver.read(0.05) is None
        assert driver.read(0.0) is None
        send([CanFrame(0x7FF, b"other", 0)])
        wait_for(lambda: driver.counters.unknown_frames == 1, "the other's frame")
        assert driver.read(0.05) is None
        assert time.monotonic() - start >= 0.1


def test_a_drive_nobody_reads_keeps_the_newest(monkeypatch: pytest.MonkeyPatch, channel: str) -> None:
    monkeypatch.setattr(can_port, "INBOX_FRAMES", 500)
    frames = frames_of(RampSource(), 1000)
    with driver_on(channel) as driver, virtual_sender(channel) as send:
        send(frames)
        wait_for(lambda: driver.counters.extra.get("inbox_dropped", 0) == len(frames) - 500, "frames to be dropped")
        send(frames_of(RampSource(start_us=1_000_000), 1)[:4])  # scales again
        blocks = read_until(driver, bool)
        assert samples_in(blocks) > 400
        assert blocks[-1].time_s[-1] == pytest.approx(0.999)


def test_bus_arguments_reach_python_can(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    seen: dict[str, Any] = {}

    def record(**kwargs: Any) -> can.BusABC:
        seen.update(kwargs)
        raise OSError("enough")

    monkeypatch.setattr(can_receive.can, "Bus", record)
    driver = CanDriver(
        "axis1",
        {"interface": "slcan", "channel": "/dev/x", "bitrate": 250_000, "bus": {"listen_only": True, "timeout": 1}},
    )
    with pytest.raises(DriverUnavailableError):
        driver.open()
    expected = {"interface": "slcan", "channel": "/dev/x", "bitrate": 250_000, "listen_only": True, "timeout": 1}
    assert expected.items() <= seen.items()
    assert seen["ignore_config"] is True
