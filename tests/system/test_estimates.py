"""What a user gets: estimates of a simulated motor, through the daemon itself and through both real wires."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from servo_daemon.simulate import PAPER_MOTOR
from tests.system.harness import (
    LINEAR,
    all_tracking,
    assert_close,
    daemon,
    nominal_table,
    sim_drive,
    wait_for,
    write_config,
)


def _numbers(document: Any) -> list[float]:
    if isinstance(document, dict):
        return [x for v in document.values() for x in _numbers(v)]
    if isinstance(document, list):
        return [x for v in document for x in _numbers(v)]
    return [document] if isinstance(document, float) else []


def test_run_alone_follows_its_simulated_motor() -> None:
    with daemon() as program:
        early = program.estimates()
        estimates = program.until(all_tracking, "every parameter is tracking")
        drive = program.get("/drives/axis1")
        assert_close(estimates, drive["truth"])
        # Nothing was learned before the first second, and then the nominal value is what is published.
        for name, p in early["parameters"].items():
            if p["status"] == "estimating":
                assert p["value"] == p["nominal"], name
                assert p["reason"]
        assert set(estimates) == {
            "drive", "time", "samples", "sample_rate_hz", "model", "parameters", "state", "estimators", "health",
        }  # fmt: skip
        assert estimates["drive"] == "axis1" and estimates["time"].endswith("Z") and estimates["model"] == []
        assert estimates["samples"] > 500
        assert estimates["sample_rate_hz"] == pytest.approx(1000, rel=0.02)
        assert list(estimates["parameters"]) == [*LINEAR, "J_d"]
        for name, p in estimates["parameters"].items():
            assert set(p) == {"value", "std", "unit", "nominal", "status", "reason", "age_s"}
            assert 0 < p["std"] < 0.2 * p["value"], name
            assert p["nominal"] > 0 and p["unit"] and p["reason"] is None
        assert set(estimates["state"]) == {"current_A", "velocity_rad_s", "position_rad"}
        assert set(estimates["estimators"]) >= {"ekf", "rls"}
        for name in LINEAR:
            rls = estimates["estimators"]["rls"]["parameters"][name]
            assert rls["value"] == pytest.approx(drive["truth"][name], rel=0.2)
        assert all(math.isfinite(x) for x in _numbers(estimates))
        health = estimates["health"]
        assert health["samples_lost"] == 0 and health["connection"] == "connected"
        assert health["filter_restarts"] == 0 and health["pipeline_failures"] == 0
        # J_d is what is left of J without the motor's own inertia.
        J, J_d = estimates["parameters"]["J"], estimates["parameters"]["J_d"]
        assert J["value"] - J_d["value"] == pytest.approx(J["nominal"] - J_d["nominal"])
        assert program.get("/health")["status"] == "ok"
        assert program.get("/ready")["ready"] is True
        assert program.said("device opened") == 1
        assert not [line for line in program.log if " WARNING " in line or " ERROR " in line]


@pytest.mark.parametrize("seed", [3])
@pytest.mark.slow
def test_the_same_through_both_real_wires(tmp_path: Path, seed: int) -> None:
    """Three drives in one daemon: binary and text over pyserial, python-can's slcan; each against its own device."""
    link = {name: tmp_path / name for name in ("binary", "text", "slcan")}
    config = write_config(
        tmp_path / "c.toml",
        f'name = "binary"\ndriver = "serial"\n{nominal_table()}[drive.options]\nport = "{link["binary"]}"',
        f'name = "text"\ndriver = "serial"\n{nominal_table()}[drive.options]\nport = "{link["text"]}"\nwire = "text"\n'
        "counts_per_rev = 8192\nsample_period_s = 1e-3",
        f'name = "slcan"\ndriver = "can"\n{nominal_table()}[drive.options]\ninterface = "slcan"\n'
        f'channel = "{link["slcan"]}"',
    )
    with (
        sim_drive("serial", link["binary"], "--seed", str(seed)),
        sim_drive("serial", link["text"], "--wire", "text", "--seed", str(seed + 1)),
        sim_drive("slcan", link["slcan"], "--seed", str(seed + 2)),
        daemon("--config", config, "--state-dir", tmp_path / "state") as program,
    ):
        assert [d["name"] for d in program.get("/drives")["drives"]] == list(link)
        for name in link:
            estimates = program.until(all_tracking, f"{name} is tracking", name)
            assert_close(estimates, PAPER_MOTOR)  # its ageing takes minutes
            assert estimates["sample_rate_hz"] == pytest.approx(1000, rel=0.02)
            assert set(estimates["parameters"]) == {*LINEAR, "J_d"}
            assert "truth" not in program.get(f"/drives/{name}")
        for name in link:
            health = program.estimates(name)["health"]
            lost = {k: health[k] for k in ("samples_lost", "crc_errors", "queue_dropped", "device_restarts")}
            assert not any(lost.values()), (name, lost, health)
            assert program.said(f"drive {name}: device opened") == 1


@pytest.mark.slow
def test_estimates_follow_a_motor_that_ages_fast(tmp_path: Path) -> None:
    """40 % more resistance within 30 s, with the drift that is assumed when nobody says anything."""
    config = write_config(
        tmp_path / "c.toml",
        f'{nominal_table()}[drive.options]\nJ_m = 0.0081\nageing = {{ R = "+40%/30s" }}\n',
    )
    with daemon("--config", config, "--state-dir", tmp_path / "state") as program:
        program.until(all_tracking, "every parameter is tracking")
        seen: list[float] = []

        def grown() -> bool:
            drive, estimates = program.get("/drives/axis1"), program.estimates()
            assert_close(estimates, drive["truth"], 0.03)
            seen.append(drive["truth"]["R"])
            return bool(seen[-1] > 1.35 * PAPER_MOTOR["R"])

        wait_for(grown, "the resistance has grown by 35 %", every_s=0.2)
        assert all_tracking(program.estimates())
        assert len(seen) > 20
