"""What becomes of effects at the end of a search."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.diagnosis.search.pruning import are_a_load, offsets_alike, pruned
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.trial import fit_trial
from servo_daemon.identification.output_error import Recording
from servo_daemon.samples import make_block

MOTOR = {"R": 0.5, "L": 1e-3, "K": 0.2, "J": 5e-3, "B": 5e-3}
PERIOD_S, INNER = 5e-3, 100


def winch(load: float, current_off: float) -> Recording:
    """A weight lifted and lowered by steps of the voltage, by Euler steps of 50 µs; and an offset of the current."""
    R, L, K, J, B = MOTOR.values()
    random, h = np.random.default_rng(3), PERIOD_S / INNER
    voltage = np.repeat(load * R / K + random.uniform(-6.0, 6.0, 40), 60)
    i = w = x = 0.0
    rows = []
    for v in voltage:
        rows.append((i, x))
        for _ in range(INNER):
            i, w, x = i + h * (v - R * i - K * w) / L, w + h * (K * i - B * w - load) / J, x + h * w
    current, angle = np.array(rows).T
    noisy = current + current_off + random.normal(0.0, 0.05, len(current))
    time = PERIOD_S * np.arange(len(voltage))
    return Recording("winch", make_block(time, voltage_V=voltage, current_A=noisy, position_rad=angle))


@pytest.mark.parametrize(
    ("load", "current_off", "name", "parameter"),
    [(0.4, 0.0, "constant_load_torque", "TL"), (0.0, 0.5, "current_sensor_offset", "i0")],
)
def test_one_offset_stands_where_two_were_taken_for_it(
    load: float, current_off: float, name: str, parameter: str
) -> None:
    """A load of 0.4 N·m is an offset of 2 A and one of 1 V as well, exactly, and no drive has both by chance."""
    data = Data.of([winch(load, current_off)], {}, (), 1.0)
    start = {**MOTOR, "i0": load / MOTOR["K"] + current_off, "v0": load * MOTOR["R"] / MOTOR["K"]}
    two = ("current_sensor_offset", "voltage_sensor_offset")
    trial = fit_trial(data, two, start)
    assert trial is not None
    chosen, kept = pruned(data, trial, two)
    assert kept == [name] and chosen.effects == (name,)
    assert chosen.values[parameter] == pytest.approx(load + current_off, rel=0.02)


def test_two_offsets_that_are_there_stay_with_the_third_beside_them() -> None:
    data = Data.of([winch(0.4, 1.0)], {}, (), 1.0)
    two = ("constant_load_torque", "current_sensor_offset")
    trial = fit_trial(data, two, {**MOTOR, "TL": 0.4, "i0": 1.0})
    assert trial is not None
    chosen, kept = pruned(data, trial, two)
    assert kept == list(two)
    assert offsets_alike(data, chosen, kept) == dict.fromkeys(two, ("voltage_sensor_offset",))


def test_offsets_of_current_and_voltage_that_are_a_load_s_have_no_name() -> None:
    added = ["current_sensor_offset", "voltage_sensor_offset", "coulomb_friction"]
    assert are_a_load(added, {"R": 0.47, "i0": 3.31, "v0": 1.55})
    assert not are_a_load(added, {"R": 0.47, "i0": 3.31, "v0": -1.55})
    assert not are_a_load(added[:1], {"R": 0.47, "i0": 3.31})
