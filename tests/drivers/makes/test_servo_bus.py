"""Drivers "dynamixel" and "feetech": packets by the maker's own library, and simulated chains of servos."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.polling.poller import Answer
from drivers.registry import make_driver
from drivers.servo_bus import protocol1, protocol2
from drivers.servo_bus.chain import State
from drivers.servo_bus.drive import DynamixelDriver, FeetechDriver, may_send
from drivers.servo_bus.families import DYNAMIXEL, DynamixelX, FeetechSts
from servo_daemon.errors import DriverConfigError
from servo_daemon.samples import Quality, SampleBlock, concatenate
from servo_daemon.sim_drive.makes.servos import DynamixelChain, FeetechChain
from tests.drivers.conformance import read_until
from tests.drivers.makes.conformance import OnAPort
from tests.drivers.makes.rig import assert_follows_the_sine, line, sine_motor

GOLDEN = json.loads((Path(__file__).parents[1] / "golden" / "dynamixel.json").read_text())["frames"]
STATUSES = [f for f in GOLDEN if "status" in f]
X = DynamixelX(fast=True)


def _driver(kind: str = "dynamixel", model: int | None = 1020, **options: Any) -> Any:
    driver = make_driver(kind, "axis1", {"port": "nowhere", **options})
    assert isinstance(driver, DynamixelDriver | FeetechDriver)
    driver._place.model = model
    return driver


def _block(driver: Any, *data: bytes) -> SampleBlock:
    block = driver._samples([Answer(k, 10.0 + 0.01 * k, 10.0 + 0.01 * k, State(d, 0)) for k, d in enumerate(data)])
    assert isinstance(block, SampleBlock)
    return block


@pytest.mark.parametrize("frame", STATUSES, ids=lambda f: f["what"])
def test_packets_and_values_of_the_makers_library(frame: dict[str, Any]) -> None:
    request, status = bytes.fromhex(frame["request"]), bytes.fromhex(frame["status"])
    servo = request[4]
    assert X.read(servo, X.address, X.length) == request
    (answer,) = X.decoder().feed(status)
    assert (answer.servo, answer.error) == (servo, frame["error"])
    block, expected = _block(_driver(), answer.data), frame["decoded"]
    assert block.voltage_V is not None and block.position_rad is not None and block.velocity_rad_s is not None
    assert block.voltage_V[0] == pytest.approx(expected["applied_V"], abs=1e-6)
    assert block.position_rad[0] == pytest.approx(expected["position_rad"], rel=1e-9, abs=1e-9)
    assert block.velocity_rad_s[0] == pytest.approx(expected["velocity_rad_s"], abs=1e-9)
    assert block.temperature_C is not None and block.temperature_C[0] == frame["raw"]["present_temperature"]
    assert block.current_A is not None
    assert block.current_A[0] == pytest.approx(2.69e-3 * frame["raw"]["present_current"], abs=1e-12)


def test_requests_for_several_are_those_of_the_makers_library() -> None:
    golden = {f["what"]: f["request"] for f in GOLDEN}
    assert X.sync_read((1, 2)).hex() == golden["fast sync read 124..146 of ids 1,2"]
    assert DynamixelX(fast=False).sync_read((1, 2)).hex() == golden["sync read 124..146 of ids 1,2"]


def test_data_that_looks_like_a_head_comes_back_whole() -> None:
    data = b"\xff\xff\xfd\x00\xff\xff\xfd\xfd".ljust(23, b"\x07")
    packet = protocol2.packet(5, protocol2.STATUS, b"\x00" + data)
    assert packet.count(b"\xff\xff\xfd\xfd") == 2
    assert protocol2.Decoder(23).feed(b"\x00" + packet) == [protocol2.Status(5, 0, data)]


def test_one_packet_of_several_servos_is_taken_apart() -> None:
    chain = DynamixelChain({1: sine_motor(0.01), 2: sine_motor(0.02)})
    decoder = X.decoder()
    chain.receive(X.sync_read((1, 2)))  # both begin at the same place
    statuses = decoder.feed(X.sync_read((1, 2)) + chain.receive(X.sync_read((1, 2))))
    assert [s.servo for s in statuses] == [1, 2] and all(len(s.data) == 23 for s in statuses)
    assert (decoder.crc_errors, decoder.framing_errors) == (0, 0)
    assert statuses[0].data != statuses[1].data


def test_a_current_of_the_supply_is_told_and_used_only_when_asked() -> None:
    forward = bytes.fromhex(STATUSES[1]["status"])[9:-2]
    for number, model in DYNAMIXEL.items():
        driver = _driver(model=number)
        block = _block(driver, forward)
        assert (block.current_A is not None) == (model.current_A is not None and not model.supply_side)
        assert set(driver.info.channels) == set(block.channels)
        assert (driver.remark is None) == (block.current_A is not None)
    divided = _block(_driver(model=1200, supply_current="divided"), forward, bytes(23))
    assert divided.current_A is not None
    assert divided.current_A[0] == pytest.approx(0.25 * 885 / 443)
    assert np.isnan(divided.current_A[1]) and divided.quality[1] & Quality.CURRENT_INVALID


def test_an_unknown_model_has_no_current_until_its_step_is_given() -> None:
    forward = bytes.fromhex(STATUSES[1]["status"])[9:-2]
    assert _block(_driver(model=4711), forward).current_A is None
    given = _block(_driver(model=4711, current_lsb_A=2e-3), forward).current_A
    assert given is not None and given[0] == pytest.approx(0.5)


def test_feetech_has_sizes_and_signs() -> None:
    def registers(position: int, speed: int, load: int, current: int) -> bytes:
        return struct.pack("<HHHBB5xH", position, speed, load, 120, 30, current)

    driver = _driver("feetech", model=777)
    turns = [(4000, 0, 500, 100), (100, 0x8000 | 2048, 0x400 | 250, 0x8000 | 200)]
    block = _block(driver, *(registers(*t) for t in turns))
    assert block.voltage_V is not None and block.current_A is not None
    assert block.position_rad is not None and block.velocity_rad_s is not None
    np.testing.assert_allclose(block.voltage_V, [6.0, -3.0])
    np.testing.assert_allclose(block.current_A, [0.65, -1.3])
    np.testing.assert_allclose(block.velocity_rad_s, [0.0, -np.pi])
    np.testing.assert_allclose(np.diff(block.position_rad), 196 * 2 * np.pi / 4096)  # on over the end of the turn


@pytest.mark.parametrize("seed", range(20))
def test_any_bytes_come_to_nothing_worse_than_a_counter(seed: int) -> None:
    random = np.random.default_rng(seed)
    first, second = protocol1.Decoder((15, 2)), protocol2.Decoder(23)
    for _ in range(100):
        status = bytearray(bytes.fromhex(STATUSES[seed % len(STATUSES)]["status"]))
        for _ in range(random.integers(0, 3)):
            status[random.integers(0, len(status))] = random.integers(0, 256)
        noise = random.integers(250, 256, random.integers(0, 40), dtype=np.uint8).tobytes()
        for answer in second.feed(noise + bytes(status)):
            if len(answer.data) == 23:
                assert len(_block(_driver(), answer.data)) == 1
        first.feed(bytes(status) + noise)
    good = bytes.fromhex(STATUSES[0]["status"])
    answers = [a for _ in range(40) for a in second.feed(good)]  # whatever was before, it finds its way back
    assert answers[-1].data == good[9:-2]


def _chain(kind: str, *servos: int) -> DynamixelChain | FeetechChain:
    motors = {servo: sine_motor(0.01) for servo in servos}
    return DynamixelChain(motors) if kind == "dynamixel" else FeetechChain(motors)


def _heard_only(heard: bytes, allowed: frozenset[bytes]) -> bool:
    """Whether bytes are nothing but requests that are allowed."""
    while heard:
        request = next((a for a in allowed if heard.startswith(a)), None)
        if request is None:
            return False
        heard = heard[len(request) :]
    return True


class _Servos(OnAPort):
    wrong_types = {"port": 5, "baudrate": "x", "drive_id": 253, "rate_hz": 0, "fast": 1, "current_lsb_A": -1.0}  # noqa: RUF012

    @pytest.fixture
    def options(self, tmp_path: Path) -> Iterator[dict[str, Any]]:
        with line(tmp_path / "chain", _chain(self.kind, 3)) as rig:
            yield {"port": str(rig.link), "drive_id": 3, "rate_hz": 200.0}
        family = X if self.kind == "dynamixel" else FeetechSts()
        assert _heard_only(bytes(rig.heard), may_send(family, (3,)))


class TestDynamixelConformance(_Servos):
    kind = "dynamixel"


class TestFeetechConformance(_Servos):
    kind = "feetech"


@pytest.mark.parametrize(("kind", "fast"), [("dynamixel", True), ("dynamixel", False), ("feetech", True)])
def test_several_drives_share_a_line(kind: str, fast: bool, tmp_path: Path) -> None:
    servos = (1, 2, 7)
    with line(tmp_path / "chain", _chain(kind, *servos)) as rig:
        options = {"port": str(rig.link), "rate_hz": 100.0, "fast": fast}
        drivers = [make_driver(kind, f"axis{s}", options | {"drive_id": s}) for s in servos]
        for driver in drivers:
            driver.open()
        for driver in drivers:
            block = concatenate(read_until(driver, 80))
            assert_follows_the_sine(block.slice(10, len(block)), 0.01, voltage=None, tolerance=0.06)
        sent = drivers[0].counters.extra["polls_sent"]
        drivers[1].close()
        assert len(concatenate(read_until(drivers[0], 20))) >= 20
        assert drivers[0].counters.extra["polls_sent"] > sent  # on from there, without the one that has left
        with pytest.raises(DriverConfigError, match="axis9"):
            make_driver(kind, "axis9", options | {"drive_id": 1}).open()
        for driver in drivers:
            driver.close()
    family = DynamixelX(fast=fast) if kind == "dynamixel" else FeetechSts()
    assert _heard_only(bytes(rig.heard), may_send(family, servos))


def test_a_servo_that_is_not_there_does_not_silence_the_others(tmp_path: Path) -> None:
    with line(tmp_path / "chain", _chain("dynamixel", 1, 2)) as rig:
        drivers = [
            make_driver("dynamixel", f"axis{s}", {"port": str(rig.link), "drive_id": s, "rate_hz": 100.0})
            for s in (1, 2, 9)
        ]
        for driver in drivers:
            driver.open()
        for driver in drivers[:2]:
            read_until(driver, 50)
        assert drivers[2].read(0.0) is None and drivers[2].counters.samples == 0
        for driver in drivers:
            driver.close()


def test_values_of_a_live_servo(tmp_path: Path) -> None:
    for kind in ("dynamixel", "feetech"):
        options = {"port": str(tmp_path / kind), "rate_hz": 100.0}
        with line(tmp_path / kind, _chain(kind, 1)), make_driver(kind, "axis1", options) as driver:
            block = concatenate(read_until(driver, 100))
        assert_follows_the_sine(block, 0.01)
