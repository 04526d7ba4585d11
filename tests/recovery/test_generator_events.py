"""Stick-slip, brushes, backlash: cases with an answer; and the energy of everything together."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.recovery.generator import (
    PAPER,
    RE40,
    Motor,
    Start,
    typical,
)
from tests.recovery.open_loop import INERT, run, states
from tests.recovery.reference_motor import exact_linear

pytestmark = [pytest.mark.system, pytest.mark.usefixtures("generator_built")]

# ---- stick-slip, brushes, backlash: cases with an answer -----------------------------------------------------------


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("Ts", [0.5, 0.9])
def test_breakaway_comes_at_the_right_instant_without_creep(Ts: float, direction: int) -> None:
    """A voltage that rises by steps: the rotor does not move at all until K i passes the breakaway torque."""
    seconds, rate = 0.4, 1000.0
    voltage = direction * 4.0 * np.arange(400) / 400
    effects = {"stribeck_friction": {"Tc": 0.5, "Ts": Ts, "ws": 0.5}}
    truth = run(PAPER, voltage, seconds, rate, effects=effects, start=Start(position_rad=0.25)).truth
    decay, current = math.exp(-PAPER.R / PAPER.L / rate), np.zeros(400)
    for k in range(399):
        current[k + 1] = decay * current[k] + (1 - decay) * voltage[k] / PAPER.R
    moves = int(np.argmax(PAPER.K * np.abs(current) > Ts))
    assert 20 < moves < 380
    assert np.all(truth.position_rad[:moves] == 0.25)
    assert np.all(truth.speed_rad_s[:moves] == 0)
    assert np.allclose(truth.current_A[:moves], current[:moves], rtol=1e-9)
    assert np.allclose(truth.dry_friction_Nm[:moves], PAPER.K * current[:moves], rtol=1e-9)
    assert np.all(truth.slip[:moves] == 0)
    assert np.all(truth.slip[moves:] == direction)
    assert direction * truth.speed_rad_s[moves] > 0


def test_speed_after_breakaway_starts_from_the_exact_instant() -> None:
    """Constant voltage on a rotor held by Coulomb friction: i(t) is an exponential up to K i = Tc, and from there the
    motor is the linear one with the load Tc."""
    Tc, volts = 1.5, 4.0
    actual = states(run(PAPER, volts, 0.05, effects={"coulomb_friction": {"Tc": Tc}}))
    breakaway = -PAPER.L / PAPER.R * math.log(1 - Tc / PAPER.K * PAPER.R / volts)
    start = np.array([Tc / PAPER.K, 0.0, 0.0])
    for k in (8, 20, 49):
        remaining = k * 1e-3 - breakaway
        expected = exact_linear(PAPER, np.full(2, volts), remaining, start, load=Tc)[1]
        assert np.allclose(actual[k], expected, rtol=1e-8)


def test_coasting_under_coulomb_friction_ends_where_it_must_and_stays() -> None:
    """ω₀ = 10, Tc/J = 20: at rest after 0.5 s and 2.5 rad, to the last bit from then on."""
    truth = run(INERT, 0.0, 1.0, effects={"coulomb_friction": {"Tc": 0.2}}, start=Start(speed_rad_s=10.0)).truth
    t = truth.time_s
    assert np.allclose(truth.speed_rad_s, np.maximum(10.0 - 20.0 * t, 0.0), atol=1e-9)
    rest = truth.position_rad[t > 0.5005]
    assert rest[0] == pytest.approx(2.5, abs=1e-9)
    assert np.all(rest == rest[0])
    assert np.all(truth.slip[t > 0.5005] == 0)


def test_a_mass_on_a_spring_loses_the_same_at_every_swing() -> None:
    """Amplitude falls by 2 Tc/k each half period and rests once k x ≤ Tc. A load too heavy to move holds the spring."""
    k, Tc, x0 = 100.0, 2.0, 0.33
    effects = {
        "coulomb_friction": {"Tc": Tc},
        "shaft_compliance": {"k_s": k, "c_s": 0.0, "J_l": 1e15},
    }
    truth = run(INERT, 0.0, 1.0, 10000.0, effects=effects, start=Start(position_rad=x0, load_position_rad=0.0)).truth
    half_period = math.pi * math.sqrt(INERT.J / k)
    turns = [(-1) ** n * (x0 - 2 * n * Tc / k) for n in range(9)]
    at = np.round(np.arange(9) * half_period * 1e4).astype(int)
    assert np.allclose(truth.position_rad[at], turns, atol=3e-5)  # a turn falls between two samples
    assert truth.position_rad[-1] == pytest.approx(turns[8], abs=1e-9)  # 0.33 - 8 * 0.04 = 0.01: within Tc/k = 0.02
    assert np.all(truth.slip[at[8] + 2 :] == 0)


def test_a_pulled_spring_breaks_away_when_it_carries_the_breakaway_torque() -> None:
    """The far end moves at 0.5 rad/s: at 100 N·m/rad the rotor starts at Ts/(k v) = 60 ms, and sticks and slips."""
    effects = {
        "stribeck_friction": {"Tc": 2.0, "Ts": 3.0, "ws": 0.05},
        "shaft_compliance": {"k_s": 100.0, "c_s": 0.0, "J_l": 1e15},
    }
    truth = run(INERT, 0.0, 1.0, 10000.0, effects=effects, start=Start(load_speed_rad_s=0.5)).truth
    assert np.all(truth.position_rad[:601] == 0)
    assert np.all(truth.slip[602:650] == 1)
    starts = np.flatnonzero((truth.slip[1:] == 1) & (truth.slip[:-1] == 0))
    assert len(starts) > 5
    assert np.allclose(-truth.spring_torque_Nm[starts + 1], 3.0, atol=0.02)  # carried at each of them
    assert np.all(truth.dry_friction_Nm[truth.slip == 0] <= 3.0 + 1e-9)


def test_brushes_block_the_current_until_their_drop_is_exceeded() -> None:
    """A rotor held fast under a slow sine of 3 V, the drop 1 V: no current at all below 1 V, (v - 1)/R above it."""
    voltage = 3 * np.sin(2 * math.pi * np.arange(4000) / 4000)
    effects = {"brush_voltage_drop": {"Vb": 1.0}, "coulomb_friction": {"Tc": 100.0}}
    truth = run(PAPER, voltage, 4.0, effects=effects).truth
    quasi_static = np.sign(voltage) * np.maximum(np.abs(voltage) - 1.0, 0.0) / PAPER.R
    assert np.allclose(truth.current_A, quasi_static, atol=0.08)  # 5 ms of lag behind 2 * 3 * 2 pi / 4 A/s
    # blocked as soon as the current has decayed through zero, and until the next 1 V: asin(1/3) of each quarter turn
    assert np.mean(truth.current_A == 0.0) == pytest.approx(2 / math.pi * math.asin(1 / 3), abs=0.02)
    assert np.all(truth.current_A[np.roll(np.abs(voltage) < 1.0, 20) & (np.abs(voltage) < 1.0)] == 0.0)


def test_backlash_lets_the_load_coast_through_the_gap() -> None:
    """The rotor runs into the far flank at constant speed: until then the load rests, after it the shaft pushes."""
    effects = {"backlash": {"gap": 0.1, "k_s": 50.0, "c_s": 0.01, "J_l": 0.005}}
    start = Start(speed_rad_s=2.0, position_rad=0.0, load_position_rad=0.0)
    truth = run(INERT, 0.0, 0.2, 10000.0, effects=effects, start=start).truth
    contact = 0.05 / 2.0
    before, after = truth.time_s < contact, truth.time_s > contact + 1e-4
    assert np.all(truth.load_speed_rad_s[before] == 0)
    assert np.all(truth.spring_torque_Nm[before] == 0)
    assert truth.spring_torque_Nm[after][0] > 0
    momentum = INERT.J * truth.speed_rad_s + 0.005 * truth.load_speed_rad_s
    assert np.allclose(momentum, INERT.J * 2.0, rtol=1e-9)
    flank = truth.spring_torque_Nm * np.sign(truth.position_rad - truth.load_position_rad)
    assert np.all(flank >= -1e-9)  # teeth never pull


# ---- energy --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("motor", [PAPER, RE40], ids=lambda motor: motor.name)
def test_energy_balance(motor: Motor) -> None:
    """What goes in at the terminals is stored, or lost in winding, brushes, friction and the shaft's damper."""
    n, rate = 20000, 100e3
    fx = {
        "brush_voltage_drop": {"Vb": 0.03 * motor.supply_V},
        "coulomb_friction": {"Tc": 0.1 * motor.working_torque_Nm},
        "torque_ripple": {"k_rip": 0.1, "n_rip": 7.0, "phi_rip": 0.3},
        "magnetic_saturation": {"I_sat": 3 * motor.rated_current_A},
        **typical("shaft_compliance", motor, 0.2),
        **typical("sector_mass", motor, 0.2),
        **typical("gravity_load", motor, 0.1),
    }
    voltage = 0.3 * motor.supply_V * np.sin(2 * math.pi * 11 * np.arange(n) / rate)
    truth = run(motor, voltage, n / rate, rate, effects=fx).truth
    i, w, th = truth.current_A, truth.speed_rad_s, truth.position_rad
    twist, slip_speed = th - truth.load_position_rad, w - truth.load_speed_rad_s
    shaft, mass, weight = fx["shaft_compliance"], fx["sector_mass"], fx["gravity_load"]
    away = (th - mass["theta_sector"] + math.pi) % (2 * math.pi) - math.pi
    edges = (
        (away + mass["width_sector"] / 2) / mass["edge_sector"],
        (away - mass["width_sector"] / 2) / mass["edge_sector"],
    )
    J = motor.J + mass["J_sector"] / 2 * (np.tanh(edges[0]) - np.tanh(edges[1]))
    stored = 0.5 * (
        motor.L * i**2 + J * w**2 + shaft["J_l"] * truth.load_speed_rad_s**2 + shaft["k_s"] * twist**2
    ) - weight["Tg"] * np.cos(th + weight["phi_g"])
    lost = (
        motor.R * i**2
        + fx["brush_voltage_drop"]["Vb"] * np.abs(i)
        + motor.B * w**2
        + truth.dry_friction_Nm * w
        + shaft["c_s"] * slip_speed**2
    )
    supplied = np.cumsum(voltage[:-1] * (i[1:] + i[:-1]) / 2 / rate)
    balance = supplied - np.cumsum((lost[1:] + lost[:-1]) / 2 / rate) - (stored[1:] - stored[0])
    assert np.abs(balance).max() < 2e-6 * supplied.max()
    assert 0.01 < np.mean(truth.slip == 0) < 0.9  # it did stick
