"""Inverse-dynamic identification on data of the independent generator: every signal set, every linear effect."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from servo_daemon.errors import BadInputError, ConfigError
from servo_daemon.identification.inverse_dynamics.filter import FilterChoice
from servo_daemon.identification.inverse_dynamics.fit import InverseDynamics, identify_inverse_dynamics
from servo_daemon.samples import Quality, SampleBlock, make_block
from tests.recovery.generator import (
    GEAR_MOTOR,
    LARGE_SERVO,
    MOTORS,
    PAPER,
    RE40,
    Motor,
    Recording,
    Scenario,
    generate,
    typical,
)

pytestmark = pytest.mark.usefixtures("generator_built")
LINEAR = ("R", "L", "K", "J", "B")


def block(r: Recording, *channels: str) -> SampleBlock:
    named = {"voltage": "voltage_V", "current": "current_A", "position": "position_rad"}
    return make_block(r.time_s, **{named[c]: getattr(r, named[c]) for c in channels or named})


def truth_of(motor: Motor, effects: Mapping[str, Mapping[str, float | str]]) -> dict[str, float]:
    truth = {name: getattr(motor, name) for name in LINEAR}
    for values in effects.values():
        truth |= {k: float(v) for k, v in values.items()}
    return truth


def check(found: InverseDynamics, truth: Mapping[str, float], within: Mapping[str, float], sigmas: float = 4.0) -> None:
    for name, tolerance in within.items():
        e = found.parameters[name]
        scale = abs(truth[name]) if name != "phi_g" else 1.0
        assert abs(e.value - truth[name]) < tolerance * scale, (name, e.value / truth[name] - 1)
        assert abs(e.value - truth[name]) < sigmas * e.std, (name, (e.value - truth[name]) / e.std)


@pytest.mark.first_is_fast
@pytest.mark.parametrize("motor", MOTORS)
@pytest.mark.parametrize("motion", ["prbs", "multisine"])
def test_both_balances(motor: str, motion: str) -> None:
    """L/R from a third of the sampling period to 16 of them, jitter, encoder steps, hidden voltage."""
    m = MOTORS[motor]
    for seed in (1, 2):
        found = identify_inverse_dynamics([block(generate(m, Scenario(motion, seed=seed)))])
        check(found, truth_of(m, {}), {"R": 0.003, "L": 0.06, "K": 0.003, "J": 0.003, "B": 0.006})
        assert not found.undetermined and not found.null_directions


EFFECTS = {
    "coulomb": ("coulomb_friction",),
    "asymmetric": ("asymmetric_friction",),
    "pendulum": ("gravity_load", "coulomb_friction"),
    "offsets": ("current_sensor_offset", "constant_load_torque"),
}


@pytest.mark.first_is_fast
@pytest.mark.parametrize("effects", EFFECTS.values(), ids=EFFECTS)
@pytest.mark.parametrize("motor", [PAPER, GEAR_MOTOR, LARGE_SERVO, RE40], ids=lambda m: m.name)
def test_effects_that_are_linear(effects: tuple[str, ...], motor: Motor) -> None:
    hidden: dict[str, Mapping[str, float | str]] = {}
    for name in effects:
        hidden |= typical(name, motor, 0.1)
    truth = truth_of(motor, hidden)
    for seed in (1, 2):
        found = identify_inverse_dynamics(
            [block(generate(motor, Scenario("prbs", seed=seed, effects=hidden)))], effects
        )
        within = {"R": 0.003, "K": 0.003, "J": 0.004, "B": 0.03}
        own = {n: 0.02 for values in hidden.values() for n in values}
        check(found, truth, within | own)


def test_current_with_K_fixed_and_without() -> None:
    r = generate(LARGE_SERVO, Scenario("prbs", seed=4))
    known = identify_inverse_dynamics([block(r, "current", "position")], fixed={"K": LARGE_SERVO.K})
    check(known, truth_of(LARGE_SERVO, {}), {"J": 0.003, "B": 0.02})
    ratios = identify_inverse_dynamics([block(r, "current", "position")])
    assert set(ratios.parameters) == {"J/K", "B/K"} and ratios.parameters["J/K"].unit == "kg·m²/(N·m/A)"
    assert ratios.parameters["J/K"].value == pytest.approx(LARGE_SERVO.J / LARGE_SERVO.K, rel=0.003)
    assert any("ratios" in note for note in ratios.notes)


def test_a_known_pendulum_makes_K_visible_without_a_voltage() -> None:
    hidden = {"gravity_load": {"Tg": 0.4 * LARGE_SERVO.working_torque_Nm, "phi_g": 0.3}}
    r = generate(LARGE_SERVO, Scenario("prbs", seed=4, effects=hidden))
    fixed = {"Tg": hidden["gravity_load"]["Tg"]}
    found = identify_inverse_dynamics([block(r, "current", "position")], ("gravity_load",), fixed)
    check(found, truth_of(LARGE_SERVO, hidden), {"K": 0.005, "J": 0.005, "B": 0.03, "phi_g": 0.003})


def test_voltage_alone_with_the_armature_given() -> None:
    r = generate(LARGE_SERVO, Scenario("prbs", seed=4))
    fixed = {name: getattr(LARGE_SERVO, name) for name in ("R", "L", "K")}
    found = identify_inverse_dynamics([block(r, "voltage", "position")], fixed=fixed)
    check(found, truth_of(LARGE_SERVO, {}), {"J": 0.02, "B": 0.05})
    with pytest.raises(BadInputError, match="R and K"):
        identify_inverse_dynamics([block(r, "voltage", "position")])


def test_a_torque_needs_no_armature() -> None:
    """The torque that the generator's motor made, held or sampled: the shaft alone."""
    hidden = typical("coulomb_friction", PAPER, 0.1)
    r = generate(PAPER, Scenario("prbs", seed=6, effects=hidden))
    torque = PAPER.K * r.truth.current_A
    b = make_block(r.time_s, torque_Nm=torque, position_rad=r.position_rad)
    check(
        identify_inverse_dynamics([b], ("coulomb_friction",)),
        truth_of(PAPER, hidden),
        {"J": 0.003, "B": 0.003, "Tc": 0.02},
    )


def test_gaps_cut_the_capture_and_cost_nothing_else() -> None:
    r = generate(GEAR_MOTOR, Scenario("prbs", seed=5, seconds=30.0))
    whole = block(r)
    keep = np.ones(len(whole), np.bool_)
    keep[12_000:12_040] = False
    quality = np.zeros(len(whole), np.uint8)
    quality[12_040] = Quality.GAP_BEFORE
    holed = make_block(
        r.time_s[keep], quality=quality[keep], voltage_V=r.voltage_V[keep], current_A=r.current_A[keep],
        position_rad=r.position_rad[keep],
    )  # fmt: skip
    check(identify_inverse_dynamics([holed]), truth_of(GEAR_MOTOR, {}), {"R": 0.003, "L": 0.03, "K": 0.002, "J": 0.003})


def test_what_the_motion_does_not_show_is_not_claimed() -> None:
    """Slow triangles without friction: i and ω in proportion, R and K are not identifiable."""
    found = identify_inverse_dynamics([block(generate(PAPER, Scenario("reversals", seed=1)))])
    assert not {"R", "K", "L"} & set(found.parameters)
    assert {"R", "L"} <= set(found.undetermined)
    slow = identify_inverse_dynamics([block(generate(RE40, Scenario("reversals", seed=1)))])
    assert "L" in slow.undetermined and any("L is not determined" in note for note in slow.notes)
    check(slow, truth_of(RE40, {}), {"R": 0.03, "K": 0.001, "J": 0.01, "B": 0.01})


def test_collinear_terms_are_named() -> None:
    hidden = typical("asymmetric_friction", PAPER, 0.1)
    data = [block(generate(PAPER, Scenario("prbs", seed=1, effects=hidden)))]
    found = identify_inverse_dynamics(data, ("asymmetric_friction", "constant_load_torque"))
    (direction,) = found.null_directions
    assert set(direction) == {"Tc", "Tc_neg", "TL"} and not set(direction) & set(found.parameters)
    assert found.parameters["J"].value == pytest.approx(PAPER.J, rel=0.003)


def test_what_cannot_be_linear_is_refused() -> None:
    data = [block(generate(PAPER, Scenario("prbs", seconds=3.0, seed=1)))]
    with pytest.raises(ConfigError, match="winding_heating is not linear"):
        identify_inverse_dynamics(data, ("winding_heating",))
    with pytest.raises(BadInputError, match="needs voltage and current"):
        identify_inverse_dynamics(
            [make_block(data[0].time_s, current_A=data[0].current_A, position_rad=data[0].position_rad)],
            ("current_sensor_offset",),
        )
    with pytest.raises(BadInputError, match="no 50 samples"):
        identify_inverse_dynamics([data[0].slice(0, 45)])
    with pytest.raises(BadInputError, match="too short: a filter at 2 Hz"):
        identify_inverse_dynamics([data[0].slice(0, 500)], choice=FilterChoice(dynamics_Hz=2.0))
    with pytest.raises(BadInputError, match="R = -"):
        current = data[0].current_A
        assert current is not None
        signals = {"voltage_V": data[0].voltage_V, "current_A": -current, "position_rad": data[0].position_rad}
        identify_inverse_dynamics([make_block(data[0].time_s, **signals)])


@pytest.mark.slow
def test_deviations_are_honest() -> None:
    """24 captures: errors of J, K and R scatter by about what is stated, and no more."""
    z = []
    for seed in range(24):
        found = identify_inverse_dynamics([block(generate(LARGE_SERVO, Scenario("prbs", seconds=8.0, seed=seed)))])
        z.append([(found.parameters[n].value - getattr(LARGE_SERVO, n)) / found.parameters[n].std for n in "RKJ"])
    rms = np.sqrt(np.mean(np.square(z), axis=0))
    assert (rms < 1.4).all() and (rms > 0.05).all(), rms


def test_the_filter_can_be_chosen() -> None:
    data = [block(generate(PAPER, Scenario("prbs", seed=1)))]
    found = identify_inverse_dynamics(data, choice=FilterChoice(dynamics_Hz=10.0, cutoff_Hz=70.0, decimation=12))
    f = found.filters["shaft"]
    assert (f.dynamics_Hz, f.cutoff_Hz, f.decimation) == (10.0, 70.0, 12)
    check(found, truth_of(PAPER, {}), {"J": 0.005, "B": 0.005})
