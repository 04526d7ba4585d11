"""Dry friction: sticks, breaks away and slides as the textbook says, against an event-driven integrator of its own."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from servo_daemon.parameters import LINEAR
from servo_daemon.plant.build import build_plant
from servo_daemon.plant.compiled import SampleLoop
from servo_daemon.samples import F64

PAPER = {p.name: p.nominal for p in LINEAR}
#: A light pendulum on a small motor: swings, sticks where gravity is too weak to move it, is torn off again.
PENDULUM = {"R": 1.0, "L": 1e-3, "K": 0.05, "J": 2e-3, "B": 1e-3, "Tc": 0.08, "Tg": 0.3, "phi_g": 0.0}
#: Voltages and for how long: let go, pull one way until it breaks away, the other way, let go.
PULLS = ((0.0, 1.5), (3.0, 1.0), (-4.5, 1.0), (0.0, 1.0))


def loop_of(effects: tuple[str, ...]) -> tuple[SampleLoop, tuple[str, ...]]:
    model = build_plant(effects)
    x, p = ca.SX.sym("x", len(model.states)), ca.SX.sym("p", len(model.parameters))
    row = ca.SX.sym("row", 3)
    step = ca.Function("step", [x, p, row], [model.step(x, row[2], p, row[0], row[1]), x])
    return SampleLoop(step), model.parameter_names


def rows(voltage: F64, h: float) -> F64:
    n = len(voltage)
    return np.column_stack([np.arange(n) * h, np.full(n, h), voltage])


def test_sticks_without_creep() -> None:
    """100,000 samples under 90 % of the friction torque: not one bit of movement beyond rounding."""
    loop, names = loop_of(("coulomb_friction",))
    p = PAPER | {"Tc": 0.3}
    i = 0.9 * 0.3 / p["K"]
    x = np.array([i, 0.0, 0.7])
    out = loop.run(x, np.array([p[n] for n in names]), rows(np.full(100_000, p["R"] * i), 1e-3))
    assert np.max(np.abs(out[:, 1])) < 1e-15
    assert np.ptp(out[:, 2]) < 1e-15


def test_an_alternating_torque_below_the_level_moves_nothing_on_average() -> None:
    loop, names = loop_of(("coulomb_friction",))
    p = PAPER | {"Tc": 0.3}
    t = np.arange(100_000) * 1e-3
    x = np.array([0.0, 0.0, 0.7])
    v = 0.9 * 0.3 / p["K"] * p["R"] * np.sin(2 * np.pi * 7 * t)
    out = loop.run(x, np.array([p[n] for n in names]), rows(v, 1e-3))
    # Within a sample the held friction torque and the current's change do not quite cancel: 5 µrad, to and fro.
    assert np.ptp(out[:, 2]) < 1e-5
    assert abs(np.mean(out[-1000:, 2]) - np.mean(out[:1000, 2])) < 1e-6


@pytest.mark.parametrize("torque_of_level, moves", [(0.999, False), (1.001, True), (-0.999, False), (-1.001, True)])
def test_breaks_away_at_its_level(torque_of_level: float, moves: bool) -> None:
    loop, names = loop_of(("coulomb_friction",))
    p = PAPER | {"Tc": 0.3}
    i = torque_of_level * 0.3 / p["K"]
    x = np.array([i, 0.0, 0.0])
    loop.run(x, np.array([p[n] for n in names]), rows(np.full(1000, p["R"] * i), 1e-3))
    assert (abs(x[1]) > 1e-12) == moves
    assert not moves or math.copysign(1, x[1]) == math.copysign(1, torque_of_level)


@pytest.mark.parametrize("direction", [1, -1])
def test_slides_like_under_a_constant_load(direction: int) -> None:
    """As long as the direction does not change, Coulomb friction is a constant load torque, exactly."""
    loop, names = loop_of(("coulomb_friction",))
    loaded, loaded_names = loop_of(("constant_load_torque",))
    p = PAPER | {"Tc": 0.3, "TL": direction * 0.3}
    v = direction * (8.0 + 2.0 * np.sin(np.arange(2000) * 0.05))
    start = np.array([direction * 5.0, direction * 2.0, 0.0])
    ours = loop.run(start.copy(), np.array([p[n] for n in names]), rows(v, 1e-3))
    theirs = loaded.run(start.copy(), np.array([p[n] for n in loaded_names]), rows(v, 1e-3))
    assert np.all(direction * ours[:, 1] > 0)
    np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    "torque, moves",
    [(0.299, False), (0.301, True), (-0.499, False), (-0.501, True)],
    ids=["+in", "+out", "-in", "-out"],
)
def test_asymmetric_levels_break_away_each_at_its_own(torque: float, moves: bool) -> None:
    loop, names = loop_of(("asymmetric_friction",))
    p = PAPER | {"Tc": 0.3, "Tc_neg": 0.5, "B_neg": 1.5}
    i = torque / p["K"]
    x = np.array([i, 0.0, 0.7])
    out = loop.run(x, np.array([p[n] for n in names]), rows(np.full(1000, p["R"] * i), 1e-3))
    assert (abs(x[1]) > 1e-12) == moves
    assert not moves or math.copysign(1, x[1]) == math.copysign(1, torque)
    assert moves or np.ptp(out[:, 2]) < 1e-15


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("B_neg", [0.1, 2.0, 2000.0])
def test_asymmetric_friction_is_linear_in_either_direction(direction: int, B_neg: float) -> None:
    """One way a motor with B and a constant load Tc, the other way one with B_neg and −Tc_neg, however stiff."""
    loop, names = loop_of(("asymmetric_friction",))
    loaded, loaded_names = loop_of(("constant_load_torque",))
    p = PAPER | {"Tc": 0.3, "Tc_neg": 0.5, "B_neg": B_neg}
    same = PAPER | ({"TL": 0.3} if direction > 0 else {"TL": -0.5, "B": B_neg})
    v = direction * (8.0 + 2.0 * np.sin(np.arange(2000) * 0.05))
    start = np.array([direction * 5.0, direction * 1e-3, 0.0])
    ours = loop.run(start.copy(), np.array([p[n] for n in names]), rows(v, 1e-3))
    theirs = loaded.run(start.copy(), np.array([same[n] for n in loaded_names]), rows(v, 1e-3))
    assert np.all(direction * ours[:, 1] > 0)
    np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12)


def test_asymmetric_friction_with_equal_sides_is_coulomb_friction() -> None:
    loop, names = loop_of(("asymmetric_friction",))
    plain, plain_names = loop_of(("coulomb_friction",))
    p = PAPER | {"Tc": 0.3, "Tc_neg": 0.3, "B_neg": PAPER["B"]}
    v = 8.0 * np.sin(np.arange(3000) * 0.02)
    ours = loop.run(np.zeros(3), np.array([p[n] for n in names]), rows(v, 1e-3))
    theirs = plain.run(np.zeros(3), np.array([p[n] for n in plain_names]), rows(v, 1e-3))
    np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-13)


def event_driven(p: dict[str, float], x: F64) -> tuple[F64, int]:
    """(i, ω, θ) after PULLS, each change between sticking and sliding found as an event; and how many there were."""

    def torque(y: F64) -> float:
        return p["K"] * y[0] - p["Tg"] * math.sin(y[2] + p["phi_g"])

    def sliding(direction: float, v: float):
        def rates(_: float, y: F64) -> list[float]:
            acceleration = (torque(y) - p["B"] * y[1] - direction * p["Tc"]) / p["J"]
            return [(v - p["R"] * y[0] - p["K"] * y[1]) / p["L"], acceleration, y[1]]

        def stops(_: float, y: F64) -> float:
            return direction * y[1]

        return rates, stops

    def sticking(v: float):
        def rates(_: float, y: F64) -> list[float]:
            return [(v - p["R"] * y[0]) / p["L"], 0.0, 0.0]

        def breaks(_: float, y: F64) -> float:
            return p["Tc"] - abs(torque(y))

        return rates, breaks

    changes = 0
    for v, duration in PULLS:
        t = 0.0
        while t < duration:
            if x[1] == 0 and abs(torque(x)) <= p["Tc"] * (1 + 1e-9):
                rates, event = sticking(v)
                if event(0, x) < 1e-12:  # just torn off
                    rates, event = sliding(math.copysign(1, torque(x)), v)
            else:
                rates, event = sliding(math.copysign(1, x[1] if x[1] else torque(x)), v)
            event.terminal, event.direction = True, -1
            part = solve_ivp(rates, (t, duration), x, events=event, method="LSODA", rtol=1e-10, atol=1e-12)
            t, x = part.t[-1], part.y[:, -1]
            if part.status == 1:
                changes += 1
                if "stops" in event.__name__:
                    x[1] = 0.0
    return x, changes


def stepped(p: dict[str, float], x: F64, h: float) -> F64:
    loop, names = loop_of(("coulomb_friction", "gravity_load"))
    x = x.copy()
    v = np.concatenate([np.full(round(duration / h), voltage) for voltage, duration in PULLS])
    loop.run(x, np.array([p[n] for n in names]), rows(v, h))
    return x


def test_recovers_true_stick_slip() -> None:
    """A pendulum that sticks, is torn off and swings: within the time-step error, which shrinks with the step."""
    start = np.array([0.0, 0.0, 2.0])
    exact, changes = event_driven(PENDULUM, start)
    assert changes >= 6  # it did stick and slip
    errors = {h: np.max(np.abs(stepped(PENDULUM, start, h) - exact)[1:]) for h in (1e-3, 1e-4)}
    assert errors[1e-3] < 1e-4
    assert errors[1e-4] < 0.2 * errors[1e-3]
