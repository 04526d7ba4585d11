"""Driver "moteus" with its q voltage from the diagnostic channel: what it tells, what is sent, what comes too late."""

from __future__ import annotations

import itertools
import math
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.can.decode import EXTENDED
from drivers.moteus import fdcanusb, query, telemetry
from drivers.moteus.drive import MoteusDriver
from drivers.moteus.voltage import VoltageQuery, may_send, voltages
from drivers.polling.can_link import Frame, pack, padded, unpack
from drivers.polling.poller import Reply
from drivers.registry import make_driver
from servo_daemon.errors import WireError
from servo_daemon.sim_drive.makes.foc import FocDrive, Pmsm, RunningFoc
from servo_daemon.sim_drive.makes.moteus import Fdcanusb, Moteus
from servo_daemon.sim_drive.makes.moving import DQ_VOLTAGE, FocMotor, Shown
from tests.drivers.makes.conformance import OnAPort
from tests.drivers.makes.rig import line, sine_motor
from tests.recovery.foc.lockstep import Clock, assert_told_by_its_voltage, by_lines, exchanged


class TestMoteusVoltage(OnAPort):
    kind = "moteus"
    wrong_types = {"rate_hz": "x", "signal": "power"}  # noqa: RUF012

    @pytest.fixture
    def options(self, tmp_path: Path) -> Iterator[dict[str, Any]]:
        with line(tmp_path / "moteus", Fdcanusb(Moteus(sine_motor(1e-3), torque_constant=0.25))) as rig:
            yield {"port": str(rig.link), "signal": "voltage"}
        allowed = {fdcanusb.sent(f.key & ~EXTENDED, f.data).strip() for f in may_send(1)}
        assert set(bytes(rig.heard).split(b"\n")) <= {*allowed, b""}


@pytest.mark.parametrize("late_s", [0.0, 3e-3], ids=["in time", "a busy host: every other answer is read late"])
def test_the_voltage_tells_r_and_k(late_s: float) -> None:
    motor, clock = Pmsm(), Clock()
    driver = make_driver("moteus", "axis1", {"port": "lockstep", "signal": "voltage", "pole_pairs": 7})
    assert isinstance(driver, MoteusDriver)
    device = Fdcanusb(Moteus(FocMotor(RunningFoc(FocDrive(motor), clock)), torque_constant=motor.Kt))
    dialogue = driver._new_dialogue()
    by_line, late = by_lines(dialogue, device, clock), itertools.cycle((late_s, 0.0))

    def exchange(data: bytes) -> Sequence[Reply[Any]]:
        replies = by_line(data)
        clock.now_s += next(late)
        return replies

    assert_told_by_its_voltage(motor, driver, exchanged(driver, dialogue, exchange, clock, 200.0, 2400))


def test_on_a_bus_only_its_reads_are_sent() -> None:
    device, dialogue = Moteus(Looks(), torque_constant=1.0), VoltageQuery(1, text=False)
    allowed = {Frame(f.key, padded(f.data, query.NOP)) for f in may_send(1)}
    rounds = 0
    for _ in range(20):
        request = dialogue.next_request()
        assert request is not None
        for frame in unpack(request.data):
            assert frame in allowed
            answer = device.answer(frame.key & ~EXTENDED, frame.data)
            if answer is not None:
                rounds += sum(bool(r.value) for r in dialogue.feed(pack(Frame(answer[0] | EXTENDED, answer[1]))))
    assert rounds > 10


class Late(Fdcanusb):
    """Says what it has to say a poll later than it should, now and then."""

    def __init__(self, drive: Moteus) -> None:
        super().__init__(drive)
        self._polls = 0

    def _answer(self, words: list[bytes]) -> bytes:
        if words[3][:2] == b"42":
            self._polls += 1
            if self._polls % 7 in (0, 1):
                return b"OK\r\nrcv 100 410100 E B F\r\n"
        return super()._answer(words)


class Looks:
    """A motor whose angle and voltage are how often it has been looked at."""

    def __init__(self) -> None:
        self._looks = 0

    def now(self) -> Shown:
        self._looks += 1
        return Shown(0.0, DQ_VOLTAGE * self._looks, 0.0, float(self._looks), 0.0)


def test_a_voltage_that_comes_late_belongs_to_no_other_round() -> None:
    """The registers are those of the look that follows the voltage's."""
    device, dialogue = Late(Moteus(Looks(), torque_constant=1.0)), VoltageQuery(1, text=True)
    rounds = []
    for _ in range(300):
        request = dialogue.next_request()
        assert request is not None
        rounds += [reply.value for reply in dialogue.feed(device.receive(request.data)) if reply.value]
    assert 100 < len(rounds) < 280  # some are lost
    angle = query.replies(rounds)["position"] * math.tau
    np.testing.assert_allclose(angle - voltages(rounds), 1.0, atol=1e-3)


def test_schemas_of_every_fixed_kind_are_walked_through() -> None:
    def field(name: str, kind: bytes, default: bytes = b"\x00") -> bytes:
        return bytes([0, len(name)]) + name.encode() + b"\x01\x02as" + kind + default

    end = b"\x00\x00\x00\x00\x00"
    inner = b"\x10\x00" + field("x", b"\x03\x02") + end
    before = (
        field("mode", b"\x11\x04\x01" + b"\x01\x05\x03one") + field("wide", b"\x08", b"\x01" + bytes(8))
        + field("three", b"\x13\x03\x07") + field("in", inner) + field("when", b"\x16") + field("on", b"\x02")
    )  # fmt: skip
    schema = b"\x10\x00" + before + field("q_V", b"\x07") + end
    assert telemetry.place_of(schema, "q_V") == 1 + 8 + 12 + 2 + 8 + 1
    for bad in (b"\x10\x00" + before + end, schema[:40], b"\x07", b"\x10\x00" + field("s", b"\x0a") + end, b""):
        with pytest.raises(WireError):
            telemetry.place_of(bad, "q_V")


@pytest.mark.parametrize("seed", range(5))
def test_any_bytes_come_to_nothing_worse_than_a_counter(seed: int) -> None:
    random = np.random.default_rng(seed)
    dialogue = VoltageQuery(1, text=True)
    for _ in range(200):
        dialogue.next_request()
        told = random.integers(0, 256, random.integers(0, 61), dtype=np.uint8).tobytes()
        if random.random() < 0.3:
            told = b"schema servo_control\r\n" + struct.pack("<I", 20) + told
        frame = bytes([0x41, 1, min(len(told), 61)]) + told[:61]
        for reply in dialogue.feed(b"rcv 100 %s E B F\r\n" % frame.hex().encode() * 2):
            assert len(reply.value) in (0, 52)
    assert dialogue.unread is None or "schema" in dialogue.unread
    assert math.isfinite(dialogue.take_strange())
