"""MuJoCo loads what is written for it, and moves the motor as the plant does."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pytest

from servo_daemon.export import mujoco as mjcf
from servo_daemon.export import urdf
from servo_daemon.export.model import ExportedModel
from servo_daemon.export.reference import simulated
from tests.unit.export.motor import document

mujoco = pytest.importorskip("mujoco")

#: Of each signal's range: RMS of MuJoCo's error, which integrates to first order with ten steps in L/R.
TOLERANCE = 0.01
GEAR = 5.0


@pytest.mark.parametrize(
    ("effects", "names"),
    [
        (("coulomb_friction", "cogging_torque", "winding_heating"), ("Tc", "Tcog", "n_cog", "phi_cog", "R_th", "C_th")),
        (("stribeck_friction", "quadratic_drag"), ("Tc", "Ts", "ws", "c2")),
    ],
)
def test_a_held_out_voltage_moves_it_as_the_plant(
    effects: tuple[str, ...], names: tuple[str, ...], model_of: Callable[..., ExportedModel]
) -> None:
    model = model_of(document(*effects, names=names, gear=GEAR))
    sim = mujoco.MjModel.from_xml_string(mjcf.write(model).content.decode())
    data, rows = mujoco.MjData(sim), []
    steps = 5
    voltage = np.repeat(np.random.default_rng(7).uniform(-3.0, 3.0, 12), 40)
    expected = simulated(model, voltage, steps * sim.opt.timestep).x[1:, :3]
    for v in voltage:
        data.ctrl[0] = v
        for _ in range(steps):
            mujoco.mj_step(sim, data)
        rows.append((data.act[-1], GEAR * data.qvel[0], GEAR * data.qpos[0]))
    error = np.sqrt(np.mean((np.array(rows) - expected) ** 2, axis=0)) / np.ptp(expected, axis=0)
    assert np.all(error < TOLERANCE), error


def test_the_older_form_comes_to_the_same_speed(model_of: Callable[..., ExportedModel]) -> None:
    text = mjcf.write(model_of(document("coulomb_friction", names=("Tc",)))).content.decode()
    joint, general = (
        re.search(rf"<{tag} [^>]*gear[^>]*/>|<{tag} [^>]*armature[^>]*/>", text) for tag in ("joint", "general")
    )
    assert joint is not None and general is not None
    body = f'<body><inertial pos="0 0 0" mass="1e-9" diaginertia="1e-9 1e-9 1e-9"/>{joint[0]}</body>'
    option = '<option timestep="1e-4" gravity="0 0 0"/>'
    sim = mujoco.MjModel.from_xml_string(
        f"<mujoco>{option}<worldbody>{body}</worldbody><actuator>{general[0]}</actuator></mujoco>"
    )
    data = mujoco.MjData(sim)
    data.ctrl[0] = 3.0
    mujoco.mj_step(sim, data, 3000)
    R, K, B, Tc = 1.1, 0.06, 3e-5, 0.01
    assert data.qvel[0] * GEAR == pytest.approx((3.0 * K / R - Tc) / (B + K**2 / R), rel=1e-3)


def test_without_a_winding_the_current_moves_it(model_of: Callable[..., ExportedModel]) -> None:
    model = model_of(document("coulomb_friction", names=("Tc",), R={"value": None}, L={"value": None}))
    export = mjcf.write(model)
    sim = mujoco.MjModel.from_xml_string(export.content.decode())
    data = mujoco.MjData(sim)
    data.ctrl[0] = 1.0
    mujoco.mj_step(sim, data)
    assert data.qvel[0] * GEAR / sim.opt.timestep == pytest.approx((0.06 - 0.01) / 5e-5, rel=0.01)
    assert any("control is the current" in note for note in export.notes)


def test_a_urdf_is_loaded_with_damping_and_friction_at_the_output(model_of: Callable[..., ExportedModel]) -> None:
    text = urdf.write(model_of(document("coulomb_friction", names=("Tc",)))).content.decode()
    joint = mujoco.MjModel.from_xml_string(text)
    assert joint.dof_damping[0] == pytest.approx(3e-5 * 25)
    assert joint.dof_frictionloss[0] == pytest.approx(0.05)
    assert joint.body_inertia[1] == pytest.approx([5e-5 * 25] * 3)
