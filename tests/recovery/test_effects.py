"""Every effect against the independent generator: the same parameters give the same motion, and fits find them.

"The same" is counted in what the effect does: the error of the plant's free run with it over that without it. What is
left is the plant's step of a whole sample against the generator's of 20 µs, with dry friction and teeth as events.
"""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.identification.output_error import FitOptions, OutputErrorFit, Recording, fit_output_error
from servo_daemon.identification.output_error.problem.rollout import free_run
from servo_daemon.kalman.gaussian import to_coordinate
from servo_daemon.plant.build import build_plant
from servo_daemon.plant.effects import effects_by_name, parameter_table
from servo_daemon.samples import F64, SampleBlock
from tests.recovery.generator import GEAR_MOTOR, LISTED, PAPER, RE40, Motor, Scenario, Sensors, generate, typical
from tests.recovery.generator import Recording as Generated

CHANNELS = ("current_A", "position_rad")
#: Largest share of the effect that may be left, where it is not 1.5 %. RE 40 turns its 13th harmonic by 3 rad a sample
#: and has L/R = 0.3 samples (gear: 0.6): what is within a sample shows. Teeth that rattle part within a second.
LEFT = {
    ("magnetic_saturation", "re40"): 0.08,
    ("magnetic_saturation", "gear"): 0.02,
    ("cogging_torque", "re40"): 0.04,
    ("shaft_compliance", "re40"): 0.05,
    ("winding_heating", "re40"): 0.08,
    ("winding_heating", "gear"): 0.03,
    ("brush_voltage_drop", "paper"): 0.02,
}
#: Hidden for a fit so strongly, from a start so far off where a search must have come near.
SHARE, NEAR = 0.1, {"t_TL": 1.01, "t_R": 1.01}
#: Fits that need more than one short capture, or another: see the report of each.
NOT_FROM_THIS = {
    "current_sensor_gain": "R/g, L/g, J g and B g make the same motion: it takes a known R or load",
    "winding_heating": "6 s are too short for it",
    "backlash": "chaotic over 6 s",
}


def true_values(motor: Motor, capture: Generated) -> dict[str, float]:
    values = {name: float(getattr(motor, name)) for name in "RLKJB"}
    choices = parameter_table()["channel"].choices
    for own in capture.truth.effects.values():
        values |= {k: float(choices.index(v)) if isinstance(v, str) else float(v) for k, v in own.items()}
    return values


def model_of(capture: Generated) -> tuple[str, ...]:
    return tuple(name for name in effects_by_name() if name in capture.truth.effects)


def error(effects: tuple[str, ...], values: dict[str, float], capture: Generated) -> F64:
    """RMS of the free run's current and speed against what the ideal sensors showed, shape (2,)."""
    plant = build_plant(effects)
    q = np.array([to_coordinate(p, values[p.name]) for p in plant.parameters])
    step = np.append(np.diff(capture.time_s), 1e-3)
    x0 = np.array([s.initial for s in plant.states])
    shown, _ = free_run(plant, CHANNELS, q, x0, np.column_stack([capture.time_s, step, capture.voltage_V]))
    off = shown - np.column_stack([capture.current_A, capture.position_rad])
    return np.array([np.sqrt(np.mean(off[:, 0] ** 2)), np.sqrt(np.mean((np.diff(off[:, 1]) / step[:-1]) ** 2))])


@pytest.mark.parametrize("motor", [RE40, PAPER, GEAR_MOTOR], ids=lambda m: m.name)
@pytest.mark.parametrize("name", LISTED)
def test_the_plant_moves_like_the_generators_motor(name: str, motor: Motor) -> None:
    if (name, motor.name) == ("torque_ripple", "re40"):
        pytest.skip("3 rad of its phase a sample are not followed over 4 s")
    seconds = 0.2 if name == "backlash" else 4.0
    effects = typical(name, motor, 0.2, seconds=seconds, rng=np.random.default_rng(1))
    motion = "steps" if name == "position_dependent_friction" else "multisine"
    capture = generate(motor, Scenario(motion, seconds=seconds, effects=effects, sensors=Sensors(), seed=1))
    values, model = true_values(motor, capture), model_of(capture)
    base = error(tuple(n for n in model if n != name), values, capture)
    left = error(model, values, capture)
    size = np.array([motor.rated_current_A, motor.speed_max_rad_s])
    seen = base > 1e-6 * size  # a sensor's error is in one channel only
    limit = 0.12 if name == "backlash" else LEFT.get((name, motor.name), 0.015)
    assert seen.any()
    assert np.all(left[seen] < limit * base[seen])
    assert np.all(left[~seen] <= 1e-6 * size[~seen])


def fitted(name: str, motor: Motor) -> tuple[OutputErrorFit, dict[str, float]]:
    effects = typical(name, motor, SHARE, seconds=6, rng=np.random.default_rng(2))
    motion = "steps" if name == "position_dependent_friction" else "multisine"
    capture = generate(motor, Scenario(motion, seconds=6, effects=effects, seed=4))
    true = true_values(motor, capture)
    table = parameter_table()
    start = {k: 1.2 * true[k] for k in "RLKJB"}
    start |= {k: v * NEAR.get(k, 1.0) for k, v in true.items() if k in table and table[k].searched}
    n = len(capture.time_s)
    block = SampleBlock(
        time_s=capture.time_s,
        sequence=np.arange(n),
        quality=np.zeros(n, np.uint8),
        host_time_s=0.0,
        voltage_V=capture.voltage_V,
        current_A=capture.current_A,
        position_rad=capture.position_rad,
    )
    return fit_output_error([Recording(name, block)], model_of(capture), FitOptions(nominal=start)), true


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n in LISTED if n not in NOT_FROM_THIS])
def test_a_fit_recovers_it(name: str) -> None:
    """Noise, quantisation, hidden voltage and jitter; from values 20 % off. Within 4 σ or a few per cent."""
    fit, true = fitted(name, GEAR_MOTOR)
    for key, found in fit.parameters.items():
        if found.status == "fixed":
            continue
        assert found.value is not None and found.std is not None, key
        off = found.value - true[key]
        if key.startswith("phi"):
            off = (off + np.pi) % (2 * np.pi) - np.pi
            assert abs(off) < max(4 * found.std, 0.05), key
        else:
            assert abs(off) < max(4 * found.std, 0.05 * abs(true[key])), (key, found.value, true[key])


def test_a_gain_of_the_current_is_no_more_than_a_combination() -> None:
    fit, _ = fitted("current_sensor_gain", GEAR_MOTOR)
    assert fit.parameters["g_i"].status == "undetermined"
    assert fit.parameters["K"].status == "estimated"
