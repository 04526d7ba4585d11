"""Driver "vesc" against a simulated VESC on a pseudo-terminal: what it measures, what it sends, what it notices."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.base import DriverCounters
from drivers.registry import make_driver
from drivers.vesc.coverage import polls_a_check
from drivers.vesc.listening import fields_of, key_of
from drivers.vesc.packets import PacketReader
from drivers.vesc.polling import PolledVesc
from drivers.vesc.requests import FORWARD_CAN, GET_MCCONF, MAY_SEND
from servo_daemon.samples import F64, Quality, concatenate
from servo_daemon.sim_drive.makes.can_nodes import SlcanBus
from servo_daemon.sim_drive.makes.foc import FocDrive, Motion, RunningFoc
from servo_daemon.sim_drive.makes.vesc import UUID, VescDevice, VescNode
from tests.drivers.conformance import read_until
from tests.drivers.makes.conformance import OnABus, OnAPort
from tests.drivers.makes.rig import Line, Silent, line

ALLOWED = {payload for payloads in MAY_SEND.values() for payload in payloads} - {bytes([GET_MCCONF])}  # only scan's


def vesc(**kwargs: Any) -> VescDevice:
    return VescDevice(RunningFoc(FocDrive()), **kwargs)


def payloads_in(rig: Line) -> list[bytes]:
    counters = DriverCounters()
    found = PacketReader(counters).feed(bytes(rig.heard))
    assert (counters.framing_errors, counters.crc_errors) == (0, 0), "bytes left the port that are no packet"
    return found


class TestVesc(OnAPort):
    kind = "vesc"
    wrong_types = {  # noqa: RUF012
        "port": 5, "baudrate": "fast", "rate_hz": -1.0, "can_id": 300, "pole_pairs": 0, "position": "left",
    }  # fmt: skip

    @pytest.fixture
    def options(self, tmp_path: Path) -> Iterator[dict[str, Any]]:
        with line(tmp_path / "vesc", vesc()):
            yield {"port": str(tmp_path / "vesc"), "position": "encoder"}


class Timed(VescDevice):
    """Keeps time and angle of every answer with values."""

    def __init__(self, motor: RunningFoc, **kwargs: Any) -> None:
        super().__init__(motor, **kwargs)
        self.at: list[tuple[float, float]] = []

    def _values(self, mask: int) -> bytes:
        body = super()._values(mask)
        self.at.append((self._motor.now_s, self._motor.theta))
        return body


def balance(block: Any, time_s: F64) -> F64:
    """R and K by least squares of ∫v = R ∫i + K Δθ over good intervals. L Δi is left out: 16 µV·s an ampere, against
    200 of R i."""
    bad = (block.quality & int(Quality.VOLTAGE_INVALID | Quality.CURRENT_INVALID)) != 0
    T = np.diff(time_s)
    columns = np.c_[block.current_A[1:] * T, np.diff(block.position_rad)]
    good = ~bad[1:] & (np.diff(block.sequence) == 1) & (T < 0.02)
    solution: F64 = np.linalg.lstsq(columns[good], (block.voltage_V[1:] * T)[good], rcond=None)[0]
    return solution


@pytest.mark.first_is_fast
@pytest.mark.parametrize(("encoder", "extra"), [(True, {}), (False, {"pole_pairs": 7})])
def test_means_and_angle_are_the_motors(tmp_path: Path, encoder: bool, extra: dict[str, Any]) -> None:
    """The port alone is enough with an encoder. R and K by the electrical balance, on the device's own times: the
    driver's hang on how busy this machine is."""
    device = Timed(RunningFoc(FocDrive()), encoder=encoder)
    options = {"port": str(tmp_path / "vesc"), **extra}
    with line(tmp_path / "vesc", device) as rig, make_driver("vesc", "axis1", options) as driver:
        block = concatenate(read_until(driver, 1000))
        assert driver.info.identity == f"vesc:{UUID.hex()}"
        assert driver.meaning is not None
        assert (driver.meaning.voltage, driver.meaning.current, driver.meaning.convention) == ("mean", "mean", "dq")
    sent = payloads_in(rig)
    assert set(sent) == ALLOWED and sent[0] == b"\x00"
    at_s, theta = np.array(device.at)[block.sequence - sent.count(b"\x00")].T
    np.testing.assert_allclose(block.position_rad - block.position_rad[0], theta - theta[0], atol=1e-5)
    R, K = balance(block, at_s)
    motor = FocDrive().motor
    assert pytest.approx(motor.R, rel=0.02) == R
    assert pytest.approx(motor.pole_pairs * motor.flux, rel=0.01) == K


def test_a_drive_behind_another_is_asked_by_forwarding(tmp_path: Path) -> None:
    with (
        line(tmp_path / "vesc", vesc(can_id=3)) as rig,
        make_driver("vesc", "axis1", {"port": str(tmp_path / "vesc"), "can_id": 3, "rate_hz": 200.0}) as driver,
    ):
        read_until(driver, 2 * polls_a_check(rate_hz=200.0))  # the seldom request is among them
        assert driver.info.identity.endswith("#3")
    assert {p[2:] for p in payloads_in(rig)} == ALLOWED
    assert {p[:2] for p in payloads_in(rig)} == {bytes([FORWARD_CAN, 3])}


def test_another_poller_is_noticed_and_its_averages_are_not_believed(tmp_path: Path) -> None:
    class Shared(VescDevice):
        """Every tenth read comes right after somebody else's."""

        reads = 0

        def _answer(self, payload: bytes) -> bytes:
            self.reads += 1
            if self.reads % 10 == 0:
                self.read_by_another()
                self._motor = Still(self._motor._drive)
                answer = super()._answer(payload)
                self._motor = self._motor.running
                return answer
            return super()._answer(payload)

    class Still:
        def __init__(self, drive: FocDrive) -> None:
            self._drive, self.running = drive, running

        def now(self) -> FocDrive:
            return self._drive

    running = RunningFoc(FocDrive())
    with (
        line(tmp_path / "vesc", Shared(running)),
        make_driver("vesc", "axis1", {"port": str(tmp_path / "vesc"), "position": "encoder"}) as driver,
    ):
        block = concatenate(read_until(driver, 100))
        assert driver.remark is not None and "another program" in driver.remark
        assert driver.counters.extra["averages_reset"] >= 5
    after = np.flatnonzero(block.quality & int(Quality.CURRENT_INVALID))[0]
    assert after < 30
    assert np.isnan(block.current_A[after:]).all() and np.isnan(block.voltage_V[after:]).all()
    assert np.isfinite(block.position_rad).all()


@pytest.mark.parametrize(
    ("motion", "encoder", "missing"),
    [(None, False, "pole_pairs"), (Motion(()), True, "turn")],
    ids=["no encoder", "at rest"],
)
def test_what_is_missing_is_told(tmp_path: Path, motion: Motion | None, encoder: bool, missing: str) -> None:
    with (
        line(tmp_path / "vesc", VescDevice(RunningFoc(FocDrive(motion=motion)), encoder=encoder)),
        make_driver("vesc", "axis1", {"port": str(tmp_path / "vesc")}) as driver,
    ):
        deadline = time.monotonic() + 30.0
        while missing not in (driver.remark or ""):
            assert driver.read(0.1) is None
            assert time.monotonic() < deadline, driver.remark


def test_a_port_without_a_vesc_is_told(tmp_path: Path) -> None:
    with (
        line(tmp_path / "silent", Silent()) as rig,
        make_driver("vesc", "axis1", {"port": str(tmp_path / "silent")}) as driver,
    ):
        assert isinstance(driver, PolledVesc)
        for _ in range(5):
            assert driver.read(0.1) is None
        assert driver.remark is not None and "firmware" in driver.remark
        assert driver.counters.extra["polls_timed_out"] >= 1
    assert set(payloads_in(rig)) == {b"\x00"}


class TestVescOnCan(OnABus):
    kind = "vesc"
    wrong_types = {  # noqa: RUF012
        "channel": 0.5, "bitrate": -1, "can_id": "7", "pole_pairs": 0.5, "position": 3, "encoder_inverted": "no",
    }  # fmt: skip

    @pytest.fixture
    def options(self, tmp_path: Path) -> Iterator[dict[str, Any]]:
        with line(tmp_path / "can0", SlcanBus(VescNode(RunningFoc(FocDrive())))):
            yield {"interface": "slcan", "channel": str(tmp_path / "can0"), "position": "encoder"}


@pytest.mark.slow
@pytest.mark.parametrize("encoder", [True, False])
def test_status_messages_are_the_motors(tmp_path: Path, encoder: bool) -> None:
    """v = R iq + K ω of one instant, with the sign that the current of message 1 does not have."""
    bus = SlcanBus(VescNode(RunningFoc(FocDrive()), encoder=encoder, rate_hz=200.0))
    options = {"interface": "slcan", "channel": str(tmp_path / "can0")} | ({} if encoder else {"pole_pairs": 7})
    with line(tmp_path / "can0", bus), make_driver("vesc", "axis1", options) as driver:
        block = concatenate(read_until(driver, 1500))
        assert driver.info.identity.endswith(":7")
        assert driver.meaning is not None and driver.meaning.voltage == "instant"
        assert driver.meaning.voltage_scale_std == pytest.approx(0.1 / math.sqrt(12.0) / FocDrive().motor.supply_V)
    good = np.isfinite(block.current_A) & np.isfinite(block.voltage_V)
    assert good.any()
    if encoder:  # how exact its angle and times are is tested in lockstep (test_estimates_listed.py)
        assert block.position_rad is not None
        assert np.nanmax(block.position_rad) - np.nanmin(block.position_rad) > 1.0
    else:
        assert block.velocity_rad_s is not None
        good &= np.isfinite(block.velocity_rad_s)
        columns = np.c_[block.current_A, block.velocity_rad_s][good]
        R, K = np.linalg.lstsq(columns, block.voltage_V[good], rcond=None)[0]
        assert pytest.approx(FocDrive().motor.pole_pairs * FocDrive().motor.flux, rel=0.03) == K
        assert pytest.approx(FocDrive().motor.R, rel=0.25) == R  # an instant's, in steps of 0.1 A
    assert bus.heard == [], "a frame was put on the bus"


GOLDEN = json.loads((Path(__file__).parents[1] / "golden/vesc.json").read_text())["frames"]
STATUS = [f for f in GOLDEN if f["transport"] == "can" and f["status"] in (1, 4, 5)]


@pytest.mark.parametrize("frame", STATUS, ids=lambda f: f["case"])
def test_status_fields_are_the_firmwares(frame: dict[str, Any]) -> None:
    fields = fields_of(frame["id"] & 0xFF)
    names = {"motor_current_A": "current", "pid_pos_deg": "pid_pos", "v_in_V": "v_in"}
    read = 0
    for name, told in frame["decoded"].items():
        field = fields.get(names.get(name, name))
        if field is not None:
            assert field.key == key_of(frame["id"] >> 8, frame["id"] & 0xFF)
            (value,) = field.physical(np.frombuffer(bytes.fromhex(frame["data"]), np.uint8)[None, :])
            assert value == pytest.approx(told, abs=1e-6), name
            read += 1
    assert read == {1: 3, 4: 1, 5: 2}[frame["status"]]
