"""The plant in free run against the event-driven generator: same voltage, same friction, other equations."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.errors import BadInputError
from servo_daemon.identification.paper.free_run import free_run
from servo_daemon.plant.build import build_plant
from tests.recovery.generator import GEAR_MOTOR, PAPER, Motor
from tests.recovery.open_loop import broadband, run

pytestmark = pytest.mark.usefixtures("generator_built")


@pytest.mark.parametrize("motor", [PAPER, GEAR_MOTOR], ids=lambda m: m.name)
def test_asymmetric_friction(motor: Motor) -> None:
    """Slides both ways, sticks and is torn off, each way at its own level."""
    torque = 0.15 * motor.working_torque_Nm
    effect = {"Tc": torque, "Tc_neg": 1.8 * torque, "B_neg": 2.5 * motor.B}
    n = 4000
    swing = np.repeat(np.tile([1.0, 0.0, -1.0, 0.1, -0.1], 8), 100)
    voltage = 0.25 * motor.supply_V * swing + 0.05 * broadband(motor, n)
    recording = run(motor, voltage, 4.0, effects={"asymmetric_friction": effect})
    values = {name: getattr(motor, name) for name in ("R", "L", "K", "J", "B")} | effect
    states = free_run(build_plant(("asymmetric_friction",)), values, recording.time_s, recording.voltage_V, {})
    truth = recording.truth
    assert set(np.unique(truth.slip)) == {-1, 0, 1}
    assert np.max(np.abs(states[:, 1] - truth.speed_rad_s)) < 0.01 * np.max(np.abs(truth.speed_rad_s))
    assert np.max(np.abs(states[:, 2] - truth.position_rad)) < 0.002 * np.ptp(truth.position_rad)


def test_a_missing_value_is_named() -> None:
    plant = build_plant(("coulomb_friction",), "torque")
    with pytest.raises(BadInputError, match="B, Tc"):
        free_run(plant, {"J": 1.0}, np.arange(3.0), np.zeros(3), {})
