"""FMPy validates and runs what is written for FMI 2.0, and it moves as the plant does."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from servo_daemon.commands.export.source import from_document
from servo_daemon.export.fmu.write import write
from servo_daemon.export.reference import simulated
from tests.unit.export.motor import document

fmpy = pytest.importorskip("fmpy")
H, GEAR, FACTOR = 1e-3, 5.0, np.sqrt(1.5)


@pytest.mark.filterwarnings("ignore")  # FMPy's own
def test_a_held_out_input_moves_it_as_the_plant_and_the_drive_shows_it(
    program: Callable[..., str], tmp_path: Path
) -> None:
    program("gcc", "cc")
    content = document("coulomb_friction", "winding_heating", names=("Tc", "R_th", "C_th"), gear=GEAR)
    content["signals"] |= {"convention": "dq", "publish": "phase", "pole_pairs": 7}
    (tmp_path / "fit.json").write_text(json.dumps(content))
    model = from_document(tmp_path / "fit.json", None)
    path = tmp_path / "motor.fmu"
    path.write_bytes(write(model).content)
    assert importlib.import_module("fmpy.validation").validate_fmu(str(path)) == []

    v_q = np.repeat(np.random.default_rng(5).uniform(-3.0, 3.0, 10), 20)
    given = np.array([(k * H, v) for k, v in enumerate(v_q)], dtype=[("time", float), ("in_voltage_V", float)])
    names = ("current_A", "velocity_rad_s", "position_rad")
    run = fmpy.simulate_fmu(str(path), stop_time=len(v_q) * H, output_interval=H, input=given, output=list(names),
                            step_size=H, fmi_type="CoSimulation", start_values={"Tc": 0.012})  # fmt: skip
    content["parameters"]["Tc"]["value"] = 0.012
    (tmp_path / "fit.json").write_text(json.dumps(content))
    x = simulated(from_document(tmp_path / "fit.json", None), FACTOR * v_q, H).x[:, :3]
    for name, column, factor in zip(names, x.T, (1.0 / FACTOR, 1.0 / GEAR, 1.0 / GEAR), strict=True):
        np.testing.assert_allclose(run[name][: len(x)], factor * column, atol=1e-9 * np.ptp(column), err_msg=name)
