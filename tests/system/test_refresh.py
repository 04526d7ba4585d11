"""A fault while the drive was off, and what the learned model is worth then: two drives with the same samples, one with
the refresh and one without, asked by REST.

The motor is the independent generator's. After twenty seconds it stands still for a second; when it runs again its
brushes are worn: more resistance, and a voltage drop that the drive's model does not have.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest

from servo_daemon.captures import write_capture
from servo_daemon.samples import SampleBlock, make_block
from servo_daemon.simulate import PAPER_MOTOR
from tests.recovery.generator import PAPER, Scenario, find_compiler, generate
from tests.system.harness import daemon, run_once, write_config

WORN = 1.3 * PAPER.R
FAULT_S, PAUSE_S, END_S = 20.0, 1.0, 60.0
#: Of the clock: the learned model is there, and the samples are worked off in step, also on a slow machine.
SPEED = 2.0


def recording() -> SampleBlock:
    well = generate(PAPER, Scenario("multisine", seconds=FAULT_S, seed=3))
    drop = {"brush_voltage_drop": {"Vb": 0.02 * PAPER.supply_V}}
    worn = generate(replace(PAPER, R=WORN), Scenario("multisine", seconds=END_S - FAULT_S, seed=4, effects=drop))
    after_s = float(well.time_s[-1]) + PAUSE_S

    def joined(name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
        return np.concatenate([getattr(well, name), getattr(worn, name)])

    turned = well.position_rad[-1] - worn.position_rad[0]
    return make_block(
        np.concatenate([well.time_s, worn.time_s - worn.time_s[0] + after_s]),
        voltage_V=joined("voltage_V"),
        current_A=joined("current_A"),
        position_rad=np.concatenate([well.position_rad, worn.position_rad + turned]),
    )


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_refreshed_drive_recovers_sooner(missing: Callable[[str], NoReturn], tmp_path: Path) -> None:
    if find_compiler() is None:
        missing("a C compiler: the independent generator cannot be built")
    write_capture(tmp_path / "worn.csv", recording())
    nominal = "\n".join(f"{n} = {v}" for n, v in PAPER_MOTOR.items())

    def drive(name: str, refresh: str) -> str:
        return (
            f'name = "{name}"\ndriver = "replay"\n[drive.nominal]\n{nominal}\n'
            f"[drive.estimation]\nrefresh = {refresh}\nrefresh_window_s = 2.0\nrefresh_every_s = 2.0\n"
            f'[drive.options]\npath = "{tmp_path / "worn.csv"}"\nspeed = {SPEED}\n'
        )

    config = write_config(
        tmp_path / "c.toml", drive("refreshed", "true") + "\n[[drive]]\n" + drive("alone", "false"),
        head="[learning]\ntrain = false\n",
    )  # fmt: skip
    environment = dict(os.environ, XDG_CACHE_HOME=str(tmp_path / "cache"), PYTHONUNBUFFERED="1")
    words = ("train", "--config", config, "--drive", "refreshed", "--motors", "800")
    trained = run_once(*words, env=environment, within_s=300.0)
    assert trained.returncode == 0, trained.stderr

    def recovered(d: dict[str, Any]) -> bool:
        R = d["parameters"]["R"]
        return R["status"] == "tracking" and abs(R["value"] / WORN - 1) < 0.03

    with daemon("--config", config, env=environment) as program:
        program.until(
            lambda d: d["estimators"].get("grnn", {}).get("parameters"), "the model speaks", "refreshed", 120.0
        )
        program.until(recovered, "the refreshed drive has found the worn brushes", "refreshed", 120.0)
        assert not recovered(program.estimates("alone"))
        last = program.until(lambda d: d["health"]["connection"] == "ended", "the recording ends", "alone", 120.0)
        assert not recovered(last), "without the refresh it never does: its model lacks the drop"
        assert last["parameters"]["R"]["status"] != "tracking", "and says so"
        assert "grnn" not in last["estimators"]
        refreshed = program.estimates("refreshed")
        grnn = refreshed["estimators"]["grnn"]
        assert grnn["detail"]["mode"] == "trusted"
        assert grnn["detail"]["applied"] >= 1
        assert 0 < grnn["detail"]["familiarity"] <= 1
        assert abs(grnn["parameters"]["R"]["value"] / WORN - 1) < 0.05
        assert "refreshed" in program.events("refreshed")
        program.stop()
