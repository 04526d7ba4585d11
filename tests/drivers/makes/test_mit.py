"""Driver "mit": frames decoded by the maker's own library, and a simulated actuator behind an SLCAN adapter."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.mit import MODELS, MitDecoder, MitDriver
from drivers.registry import make_driver
from servo_daemon.errors import DriverConfigError
from servo_daemon.samples import Quality, concatenate
from servo_daemon.sim_drive.makes.can_nodes import SlcanBus
from servo_daemon.sim_drive.makes.mit import MitActuator
from tests.drivers.conformance import DriverConformance, read_until
from tests.drivers.makes.can_rig import batch
from tests.drivers.makes.rig import assert_follows_the_sine, current_of, line, sine_motor

GOLDEN = json.loads((Path(__file__).parents[1] / "golden" / "mit.json").read_text())["frames"]
REPLIES = [f for f in GOLDEN if "decoded" in f and f["decoded"]["temperature"] is not None]
BUS = {"interface": "virtual", "channel": "unused"}


def _decoder(**options: Any) -> MitDecoder:
    driver = make_driver("mit", "axis1", BUS | options)
    assert isinstance(driver, MitDriver)
    return driver._decoder


@pytest.mark.parametrize("frame", REPLIES, ids=lambda f: f["what"])
def test_the_makers_own_values(frame: dict[str, Any]) -> None:
    limits, expected = frame["limits"], frame["decoded"]
    decoder = _decoder(limits=[limits["P_max"], limits["V_max"], limits["T_max"]], motor_id=expected["id"])
    (block,) = decoder.feed(batch([(0, bytes.fromhex(frame["data"]))]))
    assert block.velocity_rad_s is not None and block.torque_Nm is not None and block.position_rad is not None
    assert block.velocity_rad_s[0] == pytest.approx(expected["velocity_rad_s"], abs=1e-12)
    assert block.torque_Nm[0] == pytest.approx(expected["torque_like"], abs=1e-12)
    assert block.temperature_C is not None and block.temperature_C[0] == expected["temperature"]
    if abs(expected["position_rad"]) == limits["P_max"]:  # at the end of the codes: anywhere beyond
        assert math.isnan(block.position_rad[0]) and block.quality[0] & Quality.POSITION_INVALID
    else:
        assert block.position_rad[0] == pytest.approx(expected["position_rad"], abs=1e-12)


@pytest.mark.parametrize("frame", [f for f in REPLIES if f["motor"] in MODELS], ids=lambda f: f["what"])
def test_the_table_has_the_makers_limits(frame: dict[str, Any]) -> None:
    model = MODELS[frame["motor"]]
    limits = frame["limits"]
    assert (model.position_rad, model.velocity_rad_s, model.torque_Nm) == (
        limits["P_max"], limits["V_max"], limits["T_max"],
    )  # fmt: skip


def test_short_replies_and_other_motors_are_passed_over() -> None:
    decoder = _decoder(model="AK80-9", motor_id=1)
    short, other = bytes.fromhex("0181238117f0"), bytes.fromhex("0290009003002800")
    assert decoder.feed(batch([(0, short), (0, other), (5, REPLIES[0]["data"].encode()[:8])])) == []


def test_damiao_has_the_fault_above_the_motor_and_the_rotors_temperature_last() -> None:
    decoder = _decoder(model="DM4310", motor_id=0x13, reply_id=0x23)
    (block,) = decoder.feed(batch([(0x23, bytes.fromhex("13c00080080a1e28"))]))
    assert block.position_rad is not None and block.temperature_C is not None
    assert block.position_rad[0] == pytest.approx(-12.5 + 25.0 * 0xC000 / 0xFFFF)
    assert block.temperature_C[0] == 0x28


def test_robstride_has_motor_state_and_faults_in_the_identifier() -> None:
    decoder = _decoder(model="CyberGear", motor_id=0x7F)
    data = bytes.fromhex("c000a000600001 2c".replace(" ", ""))
    frames = [(0x02 << 24 | state << 16 | 0x7F << 8 | 0xFD, data) for state in (0x80, 0x00, 0xC1)]
    (block,) = decoder.feed(batch([*frames, (0x02807EFD, data)], extended=True))
    assert len(block) == 3
    assert block.position_rad is not None and block.velocity_rad_s is not None
    assert block.torque_Nm is not None and block.temperature_C is not None
    assert block.position_rad[0] == pytest.approx(4 * math.pi * (2 * 0xC000 / 0xFFFF - 1))
    assert block.velocity_rad_s[0] == pytest.approx(30 * (2 * 0xA000 / 0xFFFF - 1))
    assert block.torque_Nm[0] == pytest.approx(12 * (2 * 0x6000 / 0xFFFF - 1))
    assert block.temperature_C[0] == pytest.approx(30.0)


def test_the_position_goes_on_where_the_codes_begin_anew() -> None:
    decoder = _decoder(model="AK80-9", motor_id=1)
    turning = 3.0 * np.arange(40)
    wrapped = (turning + 12.5) % 25.0 - 12.5
    codes = [round((p + 12.5) * 65535 / 25.0) for p in wrapped]
    frames = [(0, bytes([1]) + c.to_bytes(2, "big") + bytes.fromhex("8008001e00")) for c in codes]
    position = concatenate(decoder.feed(batch(frames[:17])) + decoder.feed(batch(frames[17:]))).position_rad
    assert position is not None
    np.testing.assert_allclose(position, turning, atol=25.0 / 65535)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({}, "model"),
        ({"model": "AK80-9", "limits": [1, 2, 3]}, "model"),
        ({"model": "AK99"}, "AK80-9"),
        ({"limits": [1, 2]}, "limits"),
        ({"limits": [1, 2, -3]}, "limits"),
        ({"limits": [1, 2, 3], "layout": "odd"}, "layout"),
    ],
)
def test_impossible_options_are_named(options: dict[str, Any], text: str) -> None:
    with pytest.raises(DriverConfigError, match=text):
        make_driver("mit", "axis1", BUS | options)


@pytest.mark.parametrize("seed", range(10))
def test_any_frames_come_to_nothing_worse_than_an_invalid_sample(seed: int) -> None:
    random = np.random.default_rng(seed)
    for model in ("AK80-9", "DM4310", "CyberGear"):
        decoder = _decoder(model=model, motor_id=1)
        keys = sorted(decoder.keys)
        for _ in range(30):
            frames = [
                (
                    int(random.choice(keys)) & 0x1FFF_FFFF if random.random() < 0.8 else int(random.integers(0, 2048)),
                    random.integers(0, 256, random.integers(0, 9), dtype=np.uint8).tobytes(),
                )
                for _ in range(20)
            ]
            for block in decoder.feed(batch(frames, extended=model == "CyberGear")):
                assert np.isfinite(block.velocity_rad_s).all()


def _actuator(**options: Any) -> SlcanBus:
    return SlcanBus(MitActuator(sine_motor(2e-3), torque_per_ampere=0.5, **options))


class TestMitConformance(DriverConformance):
    kind = "mit"
    wrong_types = {"model": 7, "motor_id": "1", "reply_id": -1, "period_s": 0, "channel": [], "bitrate": "x"}  # noqa: RUF012

    @pytest.fixture
    def options(self, tmp_path: Path) -> Iterator[dict[str, Any]]:
        bus = _actuator()
        with line(tmp_path / "can", bus) as rig:
            yield {"interface": "slcan", "channel": str(rig.link), "bitrate": 1_000_000, "model": "AK80-9"}
        assert bus.heard == []

    @pytest.fixture
    def silent_options(self, tmp_path: Path) -> Iterator[dict[str, Any] | None]:
        yield {"interface": "virtual", "channel": "mit-silent", "model": "AK80-9"}

    @pytest.fixture
    def missing_options(self, tmp_path: Path) -> Iterator[dict[str, Any] | None]:
        yield {"interface": "slcan", "channel": str(tmp_path / "nothing"), "model": "AK80-9"}


def test_values_of_a_live_actuator(tmp_path: Path) -> None:
    bus = _actuator(motor_id=9, reply_id=0x11)
    options = {"interface": "slcan", "bitrate": 1_000_000, "model": "AK80-9", "motor_id": 9, "reply_id": 0x11}
    options |= {"channel": str(tmp_path / "can"), "period_s": 2e-3}
    with line(tmp_path / "can", bus), make_driver("mit", "axis1", options) as driver:
        block = concatenate(read_until(driver, 800))
    assert_follows_the_sine(block, 2e-3, voltage=None)
    assert block.torque_Nm is not None and block.position_rad is not None and block.voltage_V is None
    np.testing.assert_allclose(block.torque_Nm, 0.5 * current_of(block.position_rad), atol=0.02)
    assert bus.heard == []
