"""Every make's decoder over 10⁵ inputs: spoilt bytes of its own wire and noise. Nothing is raised, and what comes out
is a sample with finite times."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.cia402.objects import STANDARD
from drivers.cia402.sdo import Uploads
from drivers.moteus.drive import Query
from drivers.polling.can_link import Frame, pack
from drivers.polling.poller import Answer
from drivers.registry import make_driver
from drivers.servo_bus import protocol1, protocol2
from drivers.servo_bus.chain import State
from servo_daemon.sim_drive.makes.servos import FeetechChain
from tests.drivers.makes.can_rig import batch
from tests.drivers.makes.rig import sine_motor

INPUTS = 100_000
GOLDEN = Path(__file__).parents[1] / "golden"
CAN = {"interface": "virtual", "channel": "fuzz"}
Step = Callable[[bytes, int], None]


def _spoilt(random: np.random.Generator, good: bytes) -> bytes:
    """Good bytes with up to three changed, cut or prolonged; or noise."""
    kind = random.integers(0, 8)
    if kind == 0:
        return bytes(random.integers(0, 256, random.integers(0, 64), dtype=np.uint8))
    data = bytearray(good)
    for _ in range(random.integers(0, 4)):
        data[random.integers(0, len(data))] = random.integers(0, 256)
    if kind == 1:
        return bytes(data[: random.integers(0, len(data))])
    return bytes(data) + (good[: random.integers(0, 9)] if kind == 2 else b"")


def _polled(kind: str, dialogue: Any, **options: Any) -> Step:
    driver: Any = make_driver(kind, "axis1", {"port": "fuzz", **options})

    def step(data: bytes, k: int) -> None:
        replies = dialogue.feed(data)
        if replies:
            block = driver._samples([Answer(k, 1e-3 * k, 1e-3 * k, r.value) for r in replies[:1]])
            assert np.isfinite(block.time_s).all()

    return step


def _servo(kind: str, decoder: Any, length: int) -> Step:
    driver: Any = make_driver(kind, "axis1", {"port": "fuzz"})
    driver._place.model = 1020

    def step(data: bytes, k: int) -> None:
        for status in decoder.feed(data):
            if len(status.data) == length:
                driver._samples([Answer(k, 1e-3 * k, 1e-3 * k, State(status.data, status.error))])

    return step


def _framed(decoder: Any, key: int) -> Step:
    frames: list[tuple[int, bytes]] = []

    def step(data: bytes, k: int) -> None:
        frames.append((key, data[:8]))
        if len(frames) == 10:
            for block in decoder.feed(batch(frames, start_s=1e-3 * k)):
                assert np.isfinite(block.time_s).all()
            frames.clear()

    return step


def _monitor() -> Step:
    driver: Any = make_driver("simplefoc", "axis1", {"port": "fuzz", "period_s": 1e-3})
    return lambda data, k: driver._decoder.feed(data, 1e-3 * k) and None


def _uploads() -> Step:
    uploads = Uploads(5, list(STANDARD.values()))
    return lambda data, _: uploads.feed(pack(Frame(0x585, data[:8]))) and None


def _frames(name: str) -> Any:
    return json.loads((GOLDEN / f"{name}.json").read_text())["frames"]


def _moteus() -> tuple[bytes, Step]:
    good = next(f["fdcanusb"] for f in _frames("moteus") if "fdcanusb" in f)
    return good.encode() + b"\n", _polled("moteus", Query(1, text=True))


def _dynamixel() -> tuple[bytes, Step]:
    return bytes.fromhex(_frames("dynamixel")[2]["status"]), _servo("dynamixel", protocol2.Decoder(23), 23)


def _feetech() -> tuple[bytes, Step]:
    good = FeetechChain({1: sine_motor(0.01)}).receive(protocol1.read(1, 56, 15))
    return good, _servo("feetech", protocol1.Decoder((15, 2)), 15)


def _mit() -> tuple[bytes, Step]:
    driver: Any = make_driver("mit", "axis1", CAN | {"model": "AK80-9"})
    return bytes.fromhex("017fff7ff7ff1e00"), _framed(driver._frames, 0)


def _cia402() -> tuple[bytes, Step]:
    pdo = {"0x185": ["statusword", "position", "torque"]}
    options = CAN | {"node_id": 5, "counts_per_rev": 8192, "rated_torque_Nm": 2.0, "pdo": pdo}
    driver: Any = make_driver("cia402", "axis1", options)
    return bytes.fromhex("37060010000006ff"), _framed(driver._inner._frames, 0x185)


def _sdo() -> tuple[bytes, Step]:
    return bytes.fromhex("4364600010270000"), _uploads()


def _simplefoc() -> tuple[bytes, Step]:
    return b"0.0000\t0.2746\t3617.8605\t7.7842\t0.0475\r\n", _monitor()


@pytest.mark.slow
@pytest.mark.parametrize("case", [_moteus, _dynamixel, _feetech, _mit, _cia402, _sdo, _simplefoc])
def test_a_hundred_thousand_inputs(case: Callable[[], tuple[bytes, Step]]) -> None:
    random = np.random.default_rng(28)
    good, step = case()
    for k in range(INPUTS):
        step(_spoilt(random, good), k)
