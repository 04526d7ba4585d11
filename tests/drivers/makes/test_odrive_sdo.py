"""Driver "odrive" on CAN with endpoints: reads of firmware 0.6, its q voltage among them."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.odrive.sdo import ENDPOINTS, SdoDialogue, SdoOdrive, may_send
from drivers.polling.can_link import Frame, pack, unpack
from drivers.polling.poller import Reply
from drivers.registry import make_driver
from servo_daemon.errors import DriverConfigError
from servo_daemon.samples import concatenate
from servo_daemon.sim_drive.makes import odrive as simulated
from servo_daemon.sim_drive.makes.can_nodes import SlcanBus
from servo_daemon.sim_drive.makes.foc import FocDrive, Pmsm, RunningFoc
from servo_daemon.sim_drive.makes.odrive import OdriveNode
from servo_daemon.sim_drive.slcan_adapter import BusFrame
from tests.drivers.conformance import read_until
from tests.drivers.makes.conformance import OnABus
from tests.drivers.makes.rig import Silent, line
from tests.recovery.foc.lockstep import Clock, assert_told_by_its_voltage, exchanged

#: A request with 4 bytes and an answer with 8 on a bus of 500 kbit/s, with stuffing.
REQUEST_S, ANSWER_S = 1.8e-4, 2.6e-4


def endpoints_file(folder: Path, fw_version: str = "0.6.10-1", **instead: Any) -> str:
    table = {name: {"id": number, "type": "float"} for name, number in simulated.ENDPOINTS.items()}
    table |= {"axis0.requested_state": {"id": 3, "type": "uint8"}}
    path = folder / "flat_endpoints.json"
    path.write_text(json.dumps({"fw_version": fw_version, "hw_version": "4.4.58", "endpoints": table} | instead))
    return str(path)


class TestOdriveBySdo(OnABus):
    kind = "odrive"
    wrong_types = {"node_id": 64, "firmware": "0.5", "rate_hz": -1.0, "endpoints": 5}  # noqa: RUF012

    @pytest.fixture
    def options(self, tmp_path: Path) -> Iterator[dict[str, Any]]:
        bus = SlcanBus(OdriveNode(RunningFoc(FocDrive()), node_id=3))
        with line(tmp_path / "can0", bus):
            yield {
                "interface": "slcan",
                "channel": str(tmp_path / "can0"),
                "node_id": 3,
                "endpoints": endpoints_file(tmp_path),
            }
        allowed = {(f.key, f.data) for f in may_send(3, tuple(simulated.ENDPOINTS[name] for name in ENDPOINTS))}
        assert {(f.frame_id, f.data) for f in bus.heard} <= allowed

    @pytest.fixture
    def silent_options(self, tmp_path: Path, silent_bus: dict[str, Any]) -> dict[str, Any]:
        return silent_bus | {"endpoints": endpoints_file(tmp_path)}

    @pytest.fixture
    def silent_bus(self, tmp_path: Path) -> Iterator[dict[str, Any]]:
        with line(tmp_path / "silent", Silent()):
            yield {"interface": "slcan", "channel": str(tmp_path / "silent")}

    @pytest.fixture
    def missing_options(self, tmp_path: Path) -> dict[str, Any]:
        return {
            "interface": "slcan",
            "channel": str(tmp_path / "nothing"),
            "endpoints": endpoints_file(tmp_path),
        }


@pytest.mark.parametrize(
    ("at_once", "late_s", "most"),
    [
        pytest.param(True, 0.0, 0.01, id="requests go before answers: the smaller identifier"),
        pytest.param(False, 0.0, 0.03, id="an adapter that sends the next when the last is answered"),
        pytest.param(True, 4e-3, 0.01, id="a busy host: every other answer is read late"),
    ],
)
def test_the_voltage_tells_r_and_k(tmp_path: Path, at_once: bool, late_s: float, most: float) -> None:
    motor, clock = Pmsm(), Clock()
    options = {"interface": "virtual", "channel": "x", "endpoints": endpoints_file(tmp_path), "pole_pairs": 7}
    driver = make_driver("odrive", "axis1", options)
    assert isinstance(driver, SdoOdrive)
    node = OdriveNode(RunningFoc(FocDrive(motor), clock))
    dialogue = driver._new_dialogue()
    late = itertools.cycle((late_s, 0.0))

    def exchange(data: bytes) -> list[Reply[Any]]:
        answers: list[bytes] = []
        for frame in unpack(data):
            clock.now_s += REQUEST_S
            answers += (pack(Frame(a.frame_id, a.data)) for a in node.receive(BusFrame(frame.key, frame.data)))
            clock.now_s += 0.0 if at_once else ANSWER_S
        clock.now_s += ANSWER_S * len(answers) * at_once + next(late)
        return dialogue.feed(b"".join(answers))

    assert_told_by_its_voltage(motor, driver, exchanged(driver, dialogue, exchange, clock, 100.0, 2400), most)


def test_endpoints_of_another_firmware_are_not_read(tmp_path: Path) -> None:
    bus = SlcanBus(OdriveNode(RunningFoc(FocDrive())))
    options = {"interface": "slcan", "channel": str(tmp_path / "can0"), "endpoints": endpoints_file(tmp_path, "0.6.9")}
    with line(tmp_path / "can0", bus), make_driver("odrive", "axis1", options) as driver:
        while driver.remark is None:
            assert driver.read(0.05) is None
        assert driver.read(0.05) is None
        assert "0.6.10" in driver.remark and "0.6.9" in driver.remark
    assert {f.data for f in bus.heard} == {b""}, "only the version was asked for"


@pytest.mark.parametrize(
    ("instead", "said"),
    [({"endpoints": {}}, "vel_estimate"), ({"fw_version": "new"}, "flat_endpoints"), ({"endpoints": []}, "endpoints")],
)
def test_another_file_is_refused_by_name(tmp_path: Path, instead: dict[str, Any], said: str) -> None:
    path = endpoints_file(tmp_path, **instead)
    with pytest.raises(DriverConfigError, match=said):
        make_driver("odrive", "axis1", {"interface": "virtual", "endpoints": path})
    with pytest.raises(DriverConfigError, match=r"nowhere\.json"):
        make_driver("odrive", "axis1", {"interface": "virtual", "endpoints": "nowhere.json"})


def test_a_round_with_an_answer_missing_is_no_sample() -> None:
    dialogue = SdoDialogue(0, (1, 2), (0, 6, 10))
    dialogue.next_request()
    assert len(dialogue.feed(pack(Frame(0x00, bytes([2, 4, 4, 58, 0, 6, 10, 0]))))) == 1

    def told(endpoint: int) -> bytes:
        return pack(Frame(0x05, bytes([0, endpoint, 0, 0]) + np.float32(endpoint).tobytes()))

    dialogue.next_request()
    assert dialogue.feed(told(1)) == []
    dialogue.next_request()
    assert dialogue.feed(told(2)) == []
    (reply,) = dialogue.feed(told(1))
    assert reply.value == (1.0, 2.0)


def test_its_samples_are_the_motors(tmp_path: Path) -> None:
    bus = SlcanBus(OdriveNode(RunningFoc(FocDrive())))
    options = {"interface": "slcan", "channel": str(tmp_path / "can0"), "endpoints": endpoints_file(tmp_path)}
    with line(tmp_path / "can0", bus), make_driver("odrive", "axis1", options) as driver:
        block = concatenate(read_until(driver, 60))
    motor = Pmsm()
    assert block.voltage_V is not None and block.velocity_rad_s is not None and block.current_A is not None
    columns = np.c_[block.current_A, block.velocity_rad_s]
    _, K = np.linalg.lstsq(columns, block.voltage_V, rcond=None)[0]
    assert pytest.approx(motor.pole_pairs * motor.flux, rel=0.1) == K
