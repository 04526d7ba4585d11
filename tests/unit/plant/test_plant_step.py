"""The composed step: against an integrator that knows nothing of it, its order, its derivatives, its twin."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from servo_daemon.errors import ConfigError
from servo_daemon.parameters import LINEAR
from servo_daemon.plant import build, equations
from servo_daemon.plant.build import PlantModel, build_plant
from servo_daemon.plant.compiled import SampleLoop
from servo_daemon.samples import F64
from tests.twin import reference_step

EFFECTS = ("coulomb_friction", "constant_load_torque", "gravity_load", "winding_heating")
SMOOTH = EFFECTS[1:]
SETS = [c for n in range(len(EFFECTS) + 1) for c in itertools.combinations(EFFECTS, n)]
SETS += [("asymmetric_friction",), ("asymmetric_friction", *SMOOTH)]
VALUES = {p.name: p.nominal for p in LINEAR} | {
    "Tc": 0.3, "TL": 0.4, "Tg": 0.9, "phi_g": 0.4, "R_th": 2.0, "C_th": 3.0,
    "Tc_neg": 0.5, "B_neg": 0.9,
}  # fmt: skip


def values(model: PlantModel) -> F64:
    return np.array([VALUES[name] for name in model.parameter_names])


def loop_of(model: PlantModel, *, compiled: bool = True) -> SampleLoop:
    """(x; p; t, h, u) -> x_next, with x as output."""
    x, p = ca.SX.sym("x", len(model.states)), ca.SX.sym("p", len(model.parameters))
    row = ca.SX.sym("row", 3)
    step = ca.Function("step", [x, p, row], [model.step(x, row[2], p, row[0], row[1]), x])
    return SampleLoop(step, compiled=compiled)


def balances(v: float, p: dict[str, float]) -> Callable[[float, F64], list[float]]:
    """The equations as a textbook has them, for (i, ω, θ, ϑ): written here once more, on purpose."""

    def rates(t: float, x: F64) -> list[float]:
        i, omega, theta, rise = x
        R = p["R"] * (1 + 0.0039 * rise)
        load = p["TL"] + p["Tg"] * math.sin(theta + p["phi_g"])
        return [
            (v - R * i - p["K"] * omega) / p["L"],
            (p["K"] * i - p["B"] * omega - load) / p["J"],
            omega,
            (R * i * i - rise / p["R_th"]) / p["C_th"],
        ]

    return rates


def error_after(seconds: float, steps: int) -> F64:
    """|composed step − DOP853| of (i, ω, θ, ϑ) after a swing through a large angle."""
    model = build_plant(SMOOTH)
    rows = np.column_stack([np.arange(steps) * seconds / steps, np.full(steps, seconds / steps), np.full(steps, 6.0)])
    x = np.array([0.0, 0.0, 0.2, 0.0])
    loop_of(model).run(x, values(model), rows)
    exact = solve_ivp(balances(6.0, VALUES), (0, seconds), [0, 0, 0.2, 0], method="DOP853", rtol=1e-12, atol=1e-12)
    return np.abs(x - exact.y[:, -1])


def test_agrees_with_an_independent_integrator() -> None:
    assert np.all(error_after(0.3, 3000) < [1e-6, 1e-6, 1e-6, 1e-5])


def test_converges_with_second_order() -> None:
    coarse, fine = error_after(0.3, 150), error_after(0.3, 300)
    order = np.log2(np.linalg.norm(coarse) / np.linalg.norm(fine))
    assert 1.9 < order < 2.2


@pytest.mark.parametrize("effects", SETS, ids="+".join)
def test_twin_agrees(effects: tuple[str, ...]) -> None:
    """Twin and compiled step take the same decisions on other arithmetic: equal to rounding."""
    model, rng = build_plant(effects), np.random.default_rng(7)
    for _ in range(20):
        p = values(model) * np.exp(rng.normal(size=len(model.parameters)) * 0.5)
        x = rng.normal(size=len(model.states)) * np.array([10.0, 5.0, 2.0, 30.0])[: len(model.states)]
        u, t, h = rng.normal() * 12, rng.uniform(0, 10), 10 ** rng.uniform(-5, -1.5)
        ours = np.asarray(model.step(x, u, p, t, h)).ravel()
        np.testing.assert_allclose(ours, reference_step(model, x, u, p, t, h), rtol=1e-11, atol=1e-11)


def jacobians(model: PlantModel) -> ca.Function:
    arguments = [ca.SX.sym(name, *size) for name, size in zip(model.step.name_in(), shapes(model), strict=True)]
    stepped = model.step(*arguments)
    return ca.Function("jacobians", arguments, [ca.jacobian(stepped, a) for a in arguments])


def shapes(model: PlantModel) -> list[tuple[int, int]]:
    return [model.step.size_in(k) for k in range(model.step.n_in())]


@pytest.mark.parametrize("effects", [(), SMOOTH, EFFECTS, SETS[-1]], ids="+".join)
def test_derivatives_are_the_slopes(effects: tuple[str, ...]) -> None:
    model, rng = build_plant(effects), np.random.default_rng(5)
    derive = jacobians(model)
    for _ in range(20):
        x = rng.normal(size=len(model.states)) * 5 + np.array([0, 20, 0, 30])[: len(model.states)]  # sliding, smooth
        p = values(model) * np.exp(rng.normal(size=len(model.parameters)) * 0.3)
        point = [x, np.array([5.0]), p, np.array([1.0]), np.array([10 ** rng.uniform(-4, -2)])]
        for k, exact in enumerate(derive(*point)):
            for column in range(point[k].size):
                d = 1e-5 * max(abs(point[k][column]), 1e-3)
                above, below = ([a.copy() for a in point] for _ in range(2))
                above[k][column] += d
                below[k][column] -= d
                slope = (np.asarray(model.step(*above)) - np.asarray(model.step(*below))).ravel() / (2 * d)
                scale = np.max(np.abs(slope)) + 1e-9
                np.testing.assert_allclose(np.asarray(exact)[:, column] / scale, slope / scale, atol=2e-6)


@pytest.mark.parametrize("effects", [(), EFFECTS, SETS[-1]], ids="+".join)
@pytest.mark.parametrize("h", [1e-9, 1e-4, 1e-2, 10.0])
def test_derivatives_are_finite_everywhere(effects: tuple[str, ...], h: float) -> None:
    """At rest, at a double eigenvalue, with parameters at their bounds' order of magnitude: no branch leaks its NaN."""
    model = build_plant(effects)
    derive = jacobians(model)
    R, J, B = 1.0, 1e-3, 1.0
    double = {"R": R, "L": J * R / B, "K": 1e-6, "J": J, "B": B}  # both time constants equal, hardly coupled
    extremes = [{}, double, {"L": 1e-8}, {"J": 1e-10, "K": 1e-6}, {"B": 1e-10, "R": 1e-4}, {"R": 1e4}]
    for change in extremes:
        p = [(VALUES | change)[name] for name in model.parameter_names]
        for x in (np.zeros(len(model.states)), np.ones(len(model.states))):
            results = [*derive(x, 0.0, p, 0.0, h), model.step(x, 0.0, p, 0.0, h)]
            assert all(np.all(np.isfinite(np.asarray(r))) for r in results), (change, x)


def test_heated_winding_settles_where_heat_in_is_heat_out() -> None:
    model = build_plant(("winding_heating",))
    p = values(model)
    x = np.zeros(4)
    n = 60_000  # ten time constants R_th C_th
    loop_of(model).run(x, p, np.column_stack([np.arange(n) * 1e-3, np.full(n, 1e-3), np.full(n, 12.0)]))
    hot = VALUES["R"] * (1 + 0.0039 * x[3])
    assert x[3] == pytest.approx(VALUES["R_th"] * hot * x[0] ** 2, rel=1e-4)
    assert x[0] == pytest.approx(12.0 * VALUES["B"] / (hot * VALUES["B"] + VALUES["K"] ** 2), rel=1e-6)


@pytest.mark.parametrize("L", [3e-5, 1e-4, 1e-3, 1e-2], ids="L={:g}".format)
def test_heat_within_a_step_is_the_whole_loss(L: float) -> None:
    """A winding that settles within a sample, and a speed that follows while it does: the mean of i² is not the square
    of the middle (7 % of the heat of a 1 kHz capture with L/R = 0.3 ms; 0.3 % are left)."""
    model = build_plant(("winding_heating",))
    motor = {"R": 0.3, "L": L, "K": 0.03, "J": 1.4e-5, "B": 4e-6, "R_th": 1.0, "C_th": 5.0}
    p = np.array([motor[name] for name in model.parameter_names])
    n, fine, h = 2000, 100, 1e-3
    u = np.random.default_rng(3).choice([-3.0, 3.0], n)
    hot = []
    for parts in (1, fine):
        x = np.zeros(4)
        rows = [np.arange(n * parts) * h / parts, np.full(n * parts, h / parts), np.repeat(u, parts)]
        loop_of(model).run(x, p, np.column_stack(rows))
        hot.append(x[3])
    assert hot[0] == pytest.approx(hot[1], rel=5e-3)


def test_content_hash_follows_the_equations(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = build_plant(()).content_hash
    assert build._built.__wrapped__((), "voltage", 1).content_hash == plain  # built again: the same
    assert len({plain, *(build_plant((e,)).content_hash for e in EFFECTS)}) == 1 + len(EFFECTS)
    original = equations.speed_rate
    monkeypatch.setattr(equations, "speed_rate", lambda i, w, T, K, J, B: original(i, w, T, K, J, B) - w / 1e6)
    assert build._built.__wrapped__((), "voltage", 1).content_hash != plain


@pytest.mark.parametrize("drive, hidden", [("current", {"R", "L"}), ("torque", {"R", "L", "K"})])
def test_other_inputs_have_fewer_parameters_and_the_same_shaft(drive: build.Drive, hidden: set[str]) -> None:
    """Driven by the torque that the voltage model makes at constant current, the shaft moves the same."""
    model = build_plant((), drive)
    assert set(model.parameter_names) == {"R", "L", "K", "J", "B"} - hidden
    u = 7.0 if drive == "current" else 7.0 * VALUES["K"]
    omega, theta = np.asarray(model.step([1.0, 0.5], u, values(model), 0.0, 0.01)).ravel()
    lag = VALUES["J"] / VALUES["B"]
    final = VALUES["K"] * 7.0 / VALUES["B"]
    assert omega == pytest.approx(final + (1 - final) * math.exp(-0.01 / lag), rel=1e-12)
    assert theta == pytest.approx(0.5 + final * 0.01 + (1 - final) * lag * -math.expm1(-0.01 / lag), rel=1e-12)


@pytest.mark.parametrize("effects", [("no_such_effect",), ("gravity_load", "gravity_load")])
def test_wrong_effects_are_refused_by_name(effects: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError, match=effects[0]):
        build_plant(effects)


def test_a_model_has_one_dry_friction() -> None:
    with pytest.raises(ConfigError, match="coulomb_friction and asymmetric_friction"):
        build_plant(("coulomb_friction", "asymmetric_friction"))
