"""Driver "odrive" against simulated ODrives: CANSimple 0.5 and 0.6 behind an adapter, text of 0.5 on a port."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.base import DriverCounters
from drivers.odrive.asking import MAY_SEND, OdriveDialogue, Told
from drivers.odrive.listening import ENCODER, IQ, TORQUES, fields_of, key_of
from drivers.polling.poller import Answer
from drivers.registry import make_driver
from servo_daemon.errors import DriverConfigError
from servo_daemon.samples import Quality, concatenate
from servo_daemon.sim_drive.makes.can_nodes import SlcanBus
from servo_daemon.sim_drive.makes.foc import FocDrive, RunningFoc
from servo_daemon.sim_drive.makes.odrive import Generation, OdriveNode, OdriveText
from tests.drivers.conformance import read_until
from tests.drivers.makes.can_rig import batch
from tests.drivers.makes.conformance import OnABus, OnAPort
from tests.drivers.makes.rig import line

GOLDEN = json.loads((Path(__file__).parents[1] / "golden/odrive.json").read_text())["frames"]
USED = [f for f in GOLDEN if f["message"] in ("Get_Encoder_Estimates", "Get_Iq", "Get_Torques")]


@pytest.mark.parametrize("frame", USED, ids=lambda f: f"{f['generation']}-{f['message']}-{f['node']}-{f['data']}")
def test_fields_are_the_makers(frame: dict[str, Any]) -> None:
    read = 0
    for field_name, field in fields_of(frame["node"]).items():
        if field_name in frame["decoded"] and field.key == frame["id"]:
            told = float(frame["decoded"][field_name])
            (value,) = field.physical(np.frombuffer(bytes.fromhex(frame["data"]), np.uint8)[None, :])
            assert value == pytest.approx(told, rel=1e-9, nan_ok=True)
            read += 1
    assert read >= 1


def node(generation: Generation = "0.6", **kwargs: Any) -> SlcanBus:
    return SlcanBus(OdriveNode(RunningFoc(FocDrive()), generation=generation, **kwargs))


class TestOdriveOnCan(OnABus):
    kind = "odrive"
    wrong_types = {"node_id": 64, "firmware": 0.6, "channel": 0.5}  # noqa: RUF012

    @pytest.fixture
    def options(self, tmp_path: Path) -> Iterator[dict[str, Any]]:
        with line(tmp_path / "can0", node()):
            yield {"interface": "slcan", "channel": str(tmp_path / "can0")}


class TestOdriveText(OnAPort):
    kind = "odrive"
    wrong_types = {"baudrate": "fast", "rate_hz": 0.0, "axis": 2}  # noqa: RUF012

    @pytest.fixture
    def options(self, tmp_path: Path) -> Iterator[dict[str, Any]]:
        with line(tmp_path / "odrive", OdriveText(RunningFoc(FocDrive()))):
            yield {"port": str(tmp_path / "odrive")}


@pytest.mark.first_is_fast
@pytest.mark.parametrize("node_id", [0, 9, 63])
@pytest.mark.parametrize("generation", ["0.5", "0.6"])
def test_any_node_of_both_generations(tmp_path: Path, generation: Generation, node_id: int) -> None:
    bus = node(generation, node_id=node_id)
    options = {"interface": "slcan", "channel": str(tmp_path / "can0")}
    with line(tmp_path / "can0", bus), make_driver("odrive", "axis1", options) as driver:
        block = concatenate(read_until(driver, 100))
        assert driver.info.identity.endswith(f":{node_id}")
        assert driver.remark is None
        assert driver.meaning is not None and driver.meaning.convention == "dq"
    effort = "torque_Nm" if generation == "0.6" else "current_A"
    assert set(block.channels) == {"position_rad", "velocity_rad_s", effort}
    # what the values are and when, no live test can tell on a busy machine: see test_estimates_listed.py
    assert np.ptp(block.position_rad) > 0.0
    assert bus.heard == [], "a frame was put on the bus"


def burst(k: int, *, torque: bool, node_id: int = 3) -> list[tuple[int, bytes]]:
    """Encoder, Iq, torques of burst k, each with k in it; Iq and torque of the same instant as the position."""
    position = np.array([k * 0.01, 1.0], "<f4").tobytes()
    effort = np.array([0.0, k * 0.5], "<f4").tobytes()
    frames = [(key_of(node_id, ENCODER), position), (key_of(node_id, IQ), effort)]
    return [*frames, (key_of(node_id, TORQUES), effort)] if torque else frames


@pytest.mark.parametrize("torque", [False, True])
def test_a_sample_is_of_one_burst(torque: bool) -> None:
    """Position and effort that left together belong together, however the burst is cut into batches."""
    driver = make_driver("odrive", "axis1", {"interface": "virtual"})
    decoder = driver._decoder  # type: ignore[attr-defined]
    frames = [f for k in range(600) for f in burst(k, torque=torque)]
    stamps = [k * 0.01 + j * 2e-4 for k in range(600) for j in range(3 if torque else 2)]
    rng, at, blocks = random.Random(2), 0, []
    while at < len(frames):
        n = rng.randrange(1, 6)
        one = batch(frames[at : at + n])
        stamp_s = np.array(stamps[at : at + n])
        one = type(one)(one.keys, one.data, one.lengths, one.shortest, stamp_s, stamp_s[-1], stamp_s[-1])
        blocks += decoder.feed(one)
        at += n
    block = concatenate(blocks)
    assert len(block) > 400
    effort = block.torque_Nm if torque else block.current_A
    known = np.isfinite(block.position_rad)  # the first sample may begin in the middle of a burst
    assert known[1:].all()
    np.testing.assert_allclose(effort[known] / 0.5, block.position_rad[known] / (2 * math.pi) / 0.01, rtol=1e-5)


def test_a_position_too_coarse_for_a_float_is_no_measurement() -> None:
    driver = make_driver("odrive", "axis1", {"interface": "virtual", "node_id": 3})
    decoder, blocks = driver._decoder, []  # type: ignore[attr-defined]
    for k in range(400):
        frames = [(key_of(3, ENCODER), np.array([8000.0 + k, 1.0], "<f4").tobytes()), burst(k, torque=False)[1]]
        one = batch(frames)
        stamp_s = np.array([k * 0.01, k * 0.01 + 2e-4])
        blocks += decoder.feed(type(one)(one.keys, one.data, one.lengths, one.shortest, stamp_s, stamp_s[-1], 0.0))
    block = concatenate(blocks)
    coarse = (block.quality & int(Quality.POSITION_INVALID)) != 0
    assert coarse[-1] and np.isnan(block.position_rad[coarse]).all() and not coarse[0]
    assert np.isfinite(block.velocity_rad_s).all()


def test_several_nodes_have_to_be_told_apart() -> None:
    driver = make_driver("odrive", "axis1", {"interface": "virtual"})
    decoder = driver._decoder  # type: ignore[attr-defined]
    for k in range(300):
        one = batch([*burst(k, torque=False), *burst(k, torque=False, node_id=5)])
        stamp_s = k * 0.01 + np.arange(4) * 1e-4
        assert decoder.feed(type(one)(one.keys, one.data, one.lengths, one.shortest, stamp_s, stamp_s[-1], 0.0)) == []
    assert "node_id" in driver.remark and "3, 5" in driver.remark  # type: ignore[operator]


def test_only_the_two_reads_leave_the_port(tmp_path: Path) -> None:
    options = {"port": str(tmp_path / "odrive")}
    with (
        line(tmp_path / "odrive", OdriveText(RunningFoc(FocDrive()))) as rig,
        make_driver("odrive", "axis1", options) as driver,
    ):
        block = concatenate(read_until(driver, 50))
    assert bytes(rig.heard).replace(MAY_SEND[0], b"") == b"" and rig.heard
    assert block.channels == ("current_A", "position_rad", "velocity_rad_s")
    assert all(text.split() == [b"f", b"%d" % a, b"r", b"axis%d.motor.current_control.Iq_measured" % a]
               for a, text in MAY_SEND.items())  # fmt: skip


def test_a_firmware_without_the_text_protocol_is_told() -> None:
    dialogue = OdriveDialogue(0, DriverCounters())
    assert dialogue.feed(b"unknown command\r\n1.0 2.0\r\n") == []
    assert dialogue.refused == "unknown command"
    assert dialogue.feed(b"-3.0\r\n")[0].value.iq_A == -3.0
    assert dialogue.refused is None  # the answer was to what somebody else had asked before


def fuzz(seed: int, inputs: int) -> None:
    rng = random.Random(seed)
    counters = DriverCounters()
    dialogue = OdriveDialogue(0, counters)
    for _ in range(inputs):
        text = bytes(rng.choices(b"0123456789+-.eEnaif \r\n\x00\xff", k=rng.randrange(40)))
        for reply in dialogue.feed(text):
            assert isinstance(reply.value.iq_A, float)
    driver = make_driver("odrive", "axis1", {"interface": "virtual", "node_id": 3})
    decoder = driver._decoder  # type: ignore[attr-defined]
    keys = [key_of(3, c) for c in (1, ENCODER, IQ, TORQUES)]
    now, n = 0.0, 200
    for _ in range(inputs // n):
        one = batch([(rng.choice(keys), rng.randbytes(rng.choice((8, 8, 8, 4, 0)))) for _ in range(n)])
        stamp_s = now + 1e-3 * np.arange(n)
        now = float(stamp_s[-1]) + 1e-3
        for block in decoder.feed(type(one)(one.keys, one.data, one.lengths, one.shortest, stamp_s, now, now)):
            assert np.isfinite(block.time_s).all()


def test_anything_at_all_raises_nothing() -> None:
    fuzz(0, 4_000)


@pytest.mark.slow
def test_a_hundred_thousand_inputs_raise_nothing() -> None:
    fuzz(1, 100_000)


def test_wrong_options_are_named() -> None:
    with pytest.raises(DriverConfigError, match="interface"):
        make_driver("odrive", "axis1", {})


def test_a_busy_host_does_not_shift_what_it_asked() -> None:
    """Answers of up to 8 ms after the question: the shaft's way tells when they were taken, to 0.3 ms."""
    driver: Any = make_driver("odrive", "axis1", {"port": "none"})
    rng = np.random.default_rng(3)
    sent_s = 0.01 * np.arange(300) + rng.uniform(0.0, 1e-3, 300)
    taken_s = sent_s + rng.choice([2e-4, 2e-4, 2e-4, 6e-3], 300)
    turns, speed = 6.0 * taken_s + 0.3 * np.sin(3.0 * taken_s), 6.0 + 0.9 * np.cos(3.0 * taken_s)
    told = map(Told, turns.tolist(), speed.tolist(), np.zeros(300).tolist())
    answers = [
        Answer(k, sent, taken + 2e-3, one)
        for k, (sent, taken, one) in enumerate(zip(sent_s.tolist(), taken_s.tolist(), told, strict=True))
    ]
    block = driver._samples(answers)
    assert np.abs(block.time_s - taken_s).max() < 3e-4
