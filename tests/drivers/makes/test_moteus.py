"""Driver "moteus": replies decoded by the maker's own library, and a simulated drive behind an fdcanusb adapter and on
a CAN FD bus."""

from __future__ import annotations

import contextlib
import json
import math
import struct
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from drivers.moteus import fdcanusb, query
from drivers.moteus.drive import MoteusDriver, Query, may_send
from drivers.polling.can_link import Frame, pack, unpack
from drivers.polling.poller import Answer
from drivers.registry import make_driver
from servo_daemon.errors import DriverConfigError
from servo_daemon.samples import Quality, SampleBlock, concatenate
from servo_daemon.sim_drive.makes.moteus import Fdcanusb, Moteus
from tests.drivers.conformance import DriverConformance, read_until
from tests.drivers.makes.conformance import OnAPort
from tests.drivers.makes.rig import assert_follows_the_sine, current_of, line, sine_motor

GOLDEN = json.loads((Path(__file__).parents[1] / "golden" / "moteus.json").read_text())["frames"]
FLOATS = [f for f in GOLDEN if "decoded" in f and f["data"].startswith("2100")]
OTHERS = [f for f in GOLDEN if "decoded" in f and not f["data"].startswith("2100")]


def _driver(**options: Any) -> MoteusDriver:
    driver = make_driver("moteus", "axis1", {"port": "nowhere", **options})
    assert isinstance(driver, MoteusDriver)
    return driver


def _block(driver: MoteusDriver, *data: bytes) -> SampleBlock:
    return driver._samples([Answer(k, 10.0 + 1e-3 * k, 10.0005 + 1e-3 * k, d) for k, d in enumerate(data)])


def test_the_request_is_the_one_of_the_makers_library() -> None:
    golden = GOLDEN[0]
    line_, frame = may_send(1)
    assert line_ == f"can send {golden['can_id'][2:]} {golden['data']} b\n".encode()
    assert frame.data.rstrip(bytes([query.NOP])).hex() == golden["data"] and len(frame.data) == 16


@pytest.mark.parametrize("frame", FLOATS, ids=lambda f: f["what"])
@pytest.mark.parametrize("signal", ["torque", "current"])
def test_the_makers_own_values(frame: dict[str, Any], signal: str) -> None:
    expected = frame["decoded"]
    ((frame_id, data),) = fdcanusb.Lines().feed(frame["fdcanusb"].encode() + b"\n")
    assert frame_id == int(frame["can_id"], 16) and query.is_reply(data)
    block = _block(_driver(signal=signal), data)
    for shown, name, unit in (
        (block.position_rad, "POSITION", math.tau),
        (block.velocity_rad_s, "VELOCITY", math.tau),
        (block.torque_Nm, "TORQUE", 1.0) if signal == "torque" else (block.current_A, "Q_CURRENT", 1.0),
        (block.temperature_C, "TEMPERATURE", 1.0),
    ):
        assert shown is not None
        value = expected[name]
        np.testing.assert_array_equal(shown, [math.nan if value is None else value * unit])
    invalid = expected["POSITION"] is None
    assert bool(block.quality[0] & Quality.POSITION_INVALID) == invalid


@pytest.mark.parametrize("frame", OTHERS, ids=lambda f: f["what"])
def test_replies_to_other_queries_are_no_samples(frame: dict[str, Any]) -> None:
    dialogue = Query(int(frame["can_id"], 16) >> 8, text=True)
    assert dialogue.feed(frame["fdcanusb"].encode() + b"\n") == []
    assert dialogue.take_strange() == 1


def test_the_counter_wraps_and_only_going_back_is_a_restart() -> None:
    def reply(counter: int) -> bytes:
        return bytes.fromhex(FLOATS[0]["data"])[:44] + struct.pack("<i", counter)

    driver = _driver()
    block = _block(driver, reply(2**31 - 2), reply(-(2**31)), reply(-1), reply(1), reply(0))
    restarts = np.flatnonzero(block.quality & Quality.TIME_RESTART)
    assert restarts.tolist() == [4] and driver.counters.device_restarts == 1


def test_a_query_that_is_not_answered_is_a_lost_sample() -> None:
    driver, data = _driver(), bytes.fromhex(FLOATS[0]["data"])
    block = driver._samples([Answer(k, 10.0 + 1e-3 * k, 11.0, data) for k in (3, 4, 7)])
    assert (np.diff(block.sequence) == [1, 3]).all() and driver.counters.samples_lost == 2
    assert block.quality.tolist() == [0, 0, Quality.GAP_BEFORE]
    np.testing.assert_allclose(block.time_s, [0.0, 1e-3, 4e-3], atol=1e-12)


def test_two_links_or_none_are_refused() -> None:
    for options in ({}, {"port": "p", "interface": "socketcan"}):
        with pytest.raises(DriverConfigError, match=r"port.*interface"):
            make_driver("moteus", "axis1", options)


@pytest.mark.parametrize("seed", range(20))
def test_any_bytes_come_to_nothing_worse_than_a_counter(seed: int) -> None:
    random = np.random.default_rng(seed)
    text, frames, driver = Query(1, text=True), Query(1, text=False), _driver()
    for _ in range(100):
        spoilt = bytearray(FLOATS[0]["fdcanusb"].encode() + b"\n")
        for _ in range(random.integers(0, 4)):
            spoilt[random.integers(0, len(spoilt))] = random.integers(0, 256)
        noise = random.integers(0, 256, random.integers(0, 64), dtype=np.uint8).tobytes()
        replies = text.feed(noise + bytes(spoilt)) + frames.feed(pack(Frame(0x100, noise)))
        if replies:
            with np.errstate(all="raise"):
                assert len(_block(driver, *(r.value for r in replies))) == len(replies)


def _moteus() -> Moteus:
    return Moteus(sine_motor(1e-3), torque_constant=0.25)


class TestFdcanusbConformance(OnAPort):
    kind = "moteus"
    wrong_types = {"port": 5, "drive_id": 0, "rate_hz": "x", "signal": "power", "pole_pairs": 0}  # noqa: RUF012

    @pytest.fixture
    def options(self, tmp_path: Path) -> Iterator[dict[str, Any]]:
        with line(tmp_path / "moteus", Fdcanusb(_moteus())) as rig:
            yield {"port": str(rig.link), "rate_hz": 400.0}
        allowed, _ = may_send(1)
        assert bytes(rig.heard).replace(allowed, b"") == b""


@contextlib.contextmanager
def _on_a_bus(channel: str) -> Iterator[list[Frame]]:
    """A moteus on python-can's virtual bus; what it heard."""
    heard: list[Frame] = []
    stop, drive = threading.Event(), _moteus()

    def run() -> None:
        with can.Bus(interface="virtual", channel=channel, ignore_config=True, fd=True) as bus:
            ready.set()
            while not stop.is_set():
                message = bus.recv(0.05)
                if message is None:
                    continue
                heard.append(Frame(message.arbitration_id, bytes(message.data)))
                answer = drive.answer(message.arbitration_id, bytes(message.data))
                if answer is not None:
                    reply = can.Message(arbitration_id=answer[0], data=answer[1], is_extended_id=False, is_fd=True)
                    bus.send(reply)

    ready = threading.Event()
    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    assert ready.wait(10)
    try:
        yield heard
    finally:
        stop.set()
        thread.join(10)


class TestCanFdConformance(DriverConformance):
    kind = "moteus"
    wrong_types = {"interface": 1, "channel": 0.5, "bus": []}  # noqa: RUF012

    @pytest.fixture
    def options(self, request: pytest.FixtureRequest) -> Iterator[dict[str, Any]]:
        channel = f"moteus-{request.node.name}"
        with _on_a_bus(channel) as heard:
            yield {"interface": "virtual", "channel": channel, "rate_hz": 300.0}
        _, allowed = may_send(1)
        assert {f.data for f in heard} <= {allowed.data} and {f.key for f in heard} <= {0x8001}

    @pytest.fixture
    def silent_options(self) -> Iterator[dict[str, Any] | None]:
        yield {"interface": "virtual", "channel": "moteus-nobody"}


def test_values_and_rate_of_a_live_drive(tmp_path: Path) -> None:
    options = {"port": str(tmp_path / "moteus")}
    with (
        line(tmp_path / "moteus", Fdcanusb(_moteus())),
        make_driver("moteus", "axis1", options | {"signal": "current"}) as driver,
    ):
        block = concatenate(read_until(driver, 800))
    assert_follows_the_sine(block, 1e-3, voltage=None)
    assert block.position_rad is not None
    with line(tmp_path / "moteus", Fdcanusb(_moteus())), make_driver("moteus", "axis1", options) as driver:
        block = concatenate(read_until(driver, 300))
    assert block.torque_Nm is not None and block.position_rad is not None
    np.testing.assert_allclose(block.torque_Nm, 0.25 * current_of(block.position_rad), atol=1e-3)


def test_frames_pass_the_link_unchanged() -> None:
    frames = [Frame(0x8001 | 0x8000_0000, b""), Frame(5, bytes(range(64))), Frame(0x100, b"\1\2")]
    assert list(unpack(b"".join(map(pack, frames)))) == frames


def test_checksums_of_a_uart_are_checked() -> None:
    """As the maker's library makes them."""
    lines = fdcanusb.Lines()
    assert lines.feed(b"OK *BD\r\nrcv 100 210000 E B F *0A\r\n\r\n") == [(0x100, bytes.fromhex("210000"))]
    assert lines.errors == 0
    assert lines.feed(b"rcv 100 210001 E B F *0A\r\n") == [] and lines.errors == 1
