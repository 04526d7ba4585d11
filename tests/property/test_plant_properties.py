"""What must hold for any motor: energy is never created, steps compose, blocks and order of asking do not matter."""

from __future__ import annotations

import casadi as ca
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from servo_daemon.plant.build import build_plant
from servo_daemon.plant.compiled import SampleLoop
from servo_daemon.samples import F64

motors = st.tuples(
    st.floats(-2, 2),  # log10 R
    st.floats(-4, -1),  # log10 L/R
    st.floats(-3, 0),  # log10 K
    st.floats(-6, -1),  # log10 J
    st.floats(-6, 0),  # log10 B
)
starts = st.tuples(*[st.floats(-30, 30)] * 3)


def natural(motor: tuple[float, ...]) -> F64:
    R, tau, K, J, B = (10.0**v for v in motor)
    return np.array([R, R * tau, K, J, B])


def fastest(p: F64) -> float:
    """Largest |eigenvalue| of the linear core, 1/s."""
    R, L, K, J, B = p[:5]
    return float(np.max(np.abs(np.linalg.eigvals(np.array([[-R / L, -K / L], [K / J, -B / J]])))))


def decay(loop: SampleLoop, p: F64, x: tuple[float, ...], h: float, n: int = 60) -> tuple[F64, F64]:
    """(energy, angle) of the short-circuited motor after 0, 1, … n − 1 steps."""
    rows = np.zeros((n, 3))
    rows[:, 0], rows[:, 1] = np.arange(n) * h, h
    out = loop.run(np.array(x), p, rows)
    return 0.5 * p[1] * out[:, 0] ** 2 + 0.5 * p[3] * out[:, 1] ** 2, out[:, 2]


def _loop(effects: tuple[str, ...]) -> SampleLoop:
    model = build_plant(effects)
    x, p = ca.SX.sym("x", len(model.states)), ca.SX.sym("p", len(model.parameters))
    row = ca.SX.sym("row", 3)
    return SampleLoop(ca.Function("step", [x, p, row], [model.step(x, row[2], p, row[0], row[1]), x]))


LINEAR_LOOP, DRY_LOOP = _loop(()), _loop(("coulomb_friction",))


@settings(max_examples=150, derandomize=True, deadline=None)
@given(motors, starts, st.floats(-5, 1))
def test_a_shorted_motor_never_gains_energy(motor: tuple[float, ...], x: tuple[float, ...], log_h: float) -> None:
    energy, _ = decay(LINEAR_LOOP, natural(motor), x, 10.0**log_h)
    assert np.all(np.diff(energy) <= 1e-12 * energy[:-1])


@settings(max_examples=150, derandomize=True, deadline=None)
@given(motors, starts, st.floats(-4, 1), st.floats(-3, np.log10(0.2)))
def test_nor_does_one_with_dry_friction(
    motor: tuple[float, ...], x: tuple[float, ...], log_Tc: float, log_step: float
) -> None:
    """While the step resolves the motor (h·|λ| ≤ 0.2: 1 kHz for the paper's)."""
    p = np.append(natural(motor), 10.0**log_Tc)
    energy, _ = decay(DRY_LOOP, p, x, 10.0**log_step / fastest(p))
    assert np.all(np.diff(energy) <= 1e-12 * energy[:-1] + 1e-30)


@settings(max_examples=150, derandomize=True, deadline=None)
@given(motors, starts, st.floats(-4, 1), st.floats(-1, 3))
def test_a_coarse_step_gains_at_most_one_reversal_of_friction(
    motor: tuple[float, ...], x: tuple[float, ...], log_Tc: float, log_step: float
) -> None:
    """With coarser steps the friction of a whole step has the sign of its end: the work of that is the bound."""
    p = np.append(natural(motor), 10.0**log_Tc)
    energy, angle = decay(DRY_LOOP, p, x, 10.0**log_step / fastest(p))
    work = p[5] * np.abs(np.diff(angle))
    assert np.all(np.diff(energy) <= work * (1 + 1e-9) + 1e-12 * energy[:-1] + 1e-30)


@settings(max_examples=100, derandomize=True, deadline=None)
@given(motors, starts, st.floats(-24, 24), st.floats(-5, 0), st.floats(0.01, 0.99))
def test_a_linear_step_is_any_two_that_make_it_up(
    motor: tuple[float, ...], x: tuple[float, ...], u: float, log_h: float, share: float
) -> None:
    p, h, start = natural(motor), 10.0**log_h, np.array(x)
    whole, parts = start.copy(), start.copy()
    LINEAR_LOOP.run(whole, p, np.array([[0.0, h, u]]))
    LINEAR_LOOP.run(parts, p, np.array([[0.0, share * h, u], [share * h, (1 - share) * h, u]]))
    scale = np.sqrt(np.array([p[1], p[3], p[3] / (h * h)]))  # √energy in each state
    size = np.linalg.norm(scale * start) + abs(u) * np.sqrt(h / p[0]) + np.linalg.norm(scale * whole)
    np.testing.assert_allclose(scale * whole, scale * parts, rtol=0, atol=1e-11 * size + 1e-100)
