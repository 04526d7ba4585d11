"""`sim-drive --MAKE`: every simulated drive is there, and its driver gets samples of it."""

from __future__ import annotations

import argparse
import threading
from pathlib import Path
from typing import Any

import pytest

from drivers.registry import make_driver
from servo_daemon.commands import sim_drive, sim_makes
from servo_daemon.errors import BadInputError
from servo_daemon.sim_drive.source import Reversed
from tests.drivers.conformance import read_until

ON_CAN = {"interface": "slcan", "bitrate": 1_000_000}
PDO = {"0x183": ["statusword", "position", "torque"]}
MAKES: dict[str, dict[str, Any]] = {
    "moteus": {"drive_id": 3, "rate_hz": 200.0},
    "dynamixel": {"drive_id": 3},
    "feetech": {"drive_id": 3},
    "simplefoc": {},
    "cia402": ON_CAN | {"node_id": 3, "counts_per_rev": 8192, "rated_torque_Nm": 2.0, "pdo": PDO},
    "mit": ON_CAN | {"model": "AK80-9", "motor_id": 3},
}  # fmt: skip


def _arguments(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    sim_drive.add_arguments(parser)
    return parser.parse_args(words)


@pytest.mark.parametrize("make", MAKES)
def test_its_driver_reads_it(make: str, tmp_path: Path) -> None:
    link, stop = tmp_path / "link", threading.Event()
    arguments = _arguments(f"--{make}", str(link), "--drive-id", "3")
    assert sim_makes.is_asked_for(arguments)
    server = threading.Thread(target=sim_makes.serve, args=(arguments, stop), daemon=True)
    server.start()
    while not link.exists():
        assert server.is_alive()
        stop.wait(0.005)
    try:
        options = MAKES[make] | {"channel" if "interface" in MAKES[make] else "port": str(link)}
        with make_driver(make, "axis1", options) as driver:
            assert sum(map(len, read_until(driver, 30))) >= 30
    finally:
        stop.set()
        server.join(10)
    assert not server.is_alive()


def test_effects_are_for_the_brushed_ones(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="--effect"):
        sim_makes.serve(_arguments("--moteus", str(tmp_path / "x"), "--effect", "coulomb_friction"), threading.Event())


def test_a_sensor_may_be_the_wrong_way_round(tmp_path: Path) -> None:
    drives = [sim_makes.brushed_motor(_arguments("--serial", "x")) for _ in range(2)]
    right, turned = drives[0].next_block(500), Reversed(drives[1], "position_rad").next_block(500)
    assert right.position_rad is not None and turned.position_rad is not None
    assert right.position_rad.any() and (turned.position_rad == -right.position_rad).all()
    assert (turned.current_A == right.current_A).all()
    with pytest.raises(BadInputError, match="--reversed is for"):
        sim_drive.run(_arguments("--moteus", str(tmp_path / "x"), "--reversed", "encoder"))
