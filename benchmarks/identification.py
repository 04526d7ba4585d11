"""Output-error fits: ours, what a user would write with SciPy, and CasADi with IPOPT as its examples do it.

    python benchmarks/identification.py             # all of it: a quarter of an hour or more, all of it SciPy
    python benchmarks/identification.py --quick     # without the slow rival

The capture is from the independent generator of the tests: the paper's motor, multisine, laboratory sensors without
hidden voltage noise, 10 s at 1 kHz. All fit R, L, K, J, B and the three initial states to current and angle with the
same weights; what is compared is the optimum (largest relative difference of a parameter) and the time.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from servo_daemon.estimators.output_error import FitOptions, OutputErrorFit, Recording, fit_output_error
from servo_daemon.plant import equations
from servo_daemon.samples import F64, SampleBlock, make_block
from tests.recovery.generator import PAPER, Scenario, Sensors, generate

NAMES = ("R", "L", "K", "J", "B")
#: Where all of them start: the truth, each off by 20–30 %.
START = {"R": 0.64, "L": 1.7e-3, "K": 0.25, "J": 0.0125, "B": 0.41}


def recording(seconds: float, effects: dict[str, dict[str, float]] | None = None) -> SampleBlock:
    """A capture of the paper's motor by the independent generator."""
    sensors = replace(Sensors.laboratory(PAPER), hidden_V=0.0)
    scenario = Scenario("multisine", seconds=seconds, seed=7, sensors=sensors, effects=effects or {})
    r = generate(PAPER, scenario)
    return make_block(r.time_s, voltage_V=r.voltage_V, current_A=r.current_A, position_rad=r.position_rad)


def ours(block: SampleBlock) -> tuple[OutputErrorFit, float]:
    """The fit, warm: the second of two."""
    options = FitOptions(nominal=START, robust=False)
    fit_output_error([Recording("capture", block)], (), options)
    began = time.perf_counter()
    fit = fit_output_error([Recording("capture", block)], (), options)
    return fit, time.perf_counter() - began


def with_scipy(block: SampleBlock, sigma: F64, near_by: dict[str, float]) -> tuple[dict[str, float], float, int]:
    """`least_squares` around `solve_ivp`, the voltage looked up by index, derivatives by differences."""
    from scipy.integrate import solve_ivp
    from scipy.optimize import least_squares

    t = block.time_s - block.time_s[0]
    v, i, theta = (np.asarray(x) for x in (block.voltage_V, block.current_A, block.position_rad))
    calls = 0

    def residuals(x: F64) -> F64:
        nonlocal calls
        calls += 1
        R, L, K, J, B = np.exp(x[:5])

        def rates(at: float, s: F64) -> list[float]:
            u = v[min(int(np.searchsorted(t, at, side="right")) - 1, len(v) - 1)]
            return [(u - R * s[0] - K * s[1]) / L, (K * s[0] - B * s[1]) / J, s[1]]

        y = solve_ivp(rates, (0.0, t[-1]), x[5:], t_eval=t, max_step=1e-3, rtol=1e-7, atol=1e-10).y
        return np.concatenate([(y[0] - i) / sigma[0], (y[2] - theta) / sigma[1]])

    # In its favour: a start 2 % from the optimum. From START it takes more than a quarter of an hour.
    near = np.log([near_by[n] for n in NAMES]) + 0.02 * np.array([1, -1, 1, -1, 1])
    x0 = np.concatenate([near, [i[0], 0.0, theta[0]]])
    began = time.perf_counter()
    # Differences must be larger than the integrator's own noise: with the default step this ends 34 % off.
    found = least_squares(residuals, x0, x_scale="jac", diff_step=1e-4, ftol=1e-7, xtol=1e-7)
    return dict(zip(NAMES, np.exp(found.x[:5]), strict=True)), time.perf_counter() - began, calls


def with_ipopt(block: SampleBlock, sigma: F64) -> tuple[dict[str, float], float]:
    """Single shooting as in CasADi's own `sysid.py`: RK4 by `mapaccum`, Gauss–Newton Hessian, IPOPT."""
    x, p, u, h = ca.SX.sym("x", 3), ca.SX.sym("p", 5), ca.SX.sym("u"), ca.SX.sym("h")
    R, L, K, J, B = (p[k] for k in range(5))

    def rates(s: ca.SX) -> ca.SX:
        return ca.vertcat(
            equations.current_rate(u, s[0], s[1], R, L, K),
            equations.speed_rate(s[0], s[1], ca.SX(0), K, J, B),
            equations.angle_rate(s[1]),
        )

    k1 = rates(x)
    k2 = rates(x + h / 2 * k1)
    k3 = rates(x + h / 2 * k2)
    k4 = rates(x + h * k3)
    step = ca.Function("step", [x, u, h, p], [x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])
    n = len(block)
    t = block.time_s - block.time_s[0]
    scale = np.array([START[name] for name in NAMES])
    unknown, x0 = ca.MX.sym("unknown", 5), ca.MX.sym("x0", 3)
    path = step.mapaccum("path", n - 1)(
        x0,
        ca.DM(np.asarray(block.voltage_V)[:-1]).T,
        ca.DM(np.diff(t)).T,
        ca.repmat(unknown * scale, 1, n - 1),
    )
    states = ca.horzcat(x0, path)
    error = ca.vertcat(
        (states[0, :].T - ca.DM(block.current_A)) / sigma[0], (states[2, :].T - ca.DM(block.position_rad)) / sigma[1]
    )
    w = ca.vertcat(unknown, x0)
    jacobian = ca.jacobian(error, w)
    hessian = ca.triu(ca.mtimes(jacobian.T, jacobian))
    weight = ca.MX.sym("weight")
    lagrangian = ca.Function(
        "nlp_hess_l",
        {"x": w, "lam_f": weight, "hess_gamma_x_x": weight * hessian},
        ["x", "p", "lam_f", "lam_g"],
        ["hess_gamma_x_x"],
    )
    options = {
        "show_eval_warnings": False,
        "hess_lag": lagrangian,
        "ipopt.print_level": 0,
        "print_time": False,
        "ipopt.sb": "yes",
    }
    began = time.perf_counter()
    solver = ca.nlpsol("solver", "ipopt", {"x": w, "f": 0.5 * ca.dot(error, error)}, options)
    start = ca.vertcat(ca.DM.ones(5), ca.DM([block.current_A[0], 0.0, block.position_rad[0]]))
    found = np.array(solver(x0=start)["x"]).ravel()
    return dict(zip(NAMES, found[:5] * scale, strict=True)), time.perf_counter() - began


def difference(a: dict[str, float], b: dict[str, float]) -> float:
    """Largest relative difference of a parameter."""
    return max(abs(a[n] / b[n] - 1.0) for n in NAMES)


def timed(function: Callable[[], OutputErrorFit]) -> tuple[OutputErrorFit, float]:
    """The second of two runs: caches warm."""
    function()
    began = time.perf_counter()
    fit = function()
    return fit, time.perf_counter() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="without solve_ivp, which takes a quarter of an hour")
    arguments = parser.parse_args()
    block = recording(10.0)
    fit, seconds = ours(block)
    mine = {n: float(fit.parameters[n].value or np.nan) for n in NAMES}
    sigma = fit.solution.point.sigma
    iterations = fit.solution.iterations[-1]
    print(f"10 s at 1 kHz, R L K J B and initial state: ours {seconds:.3f} s, {iterations.evaluations} simulations")
    values, theirs = with_ipopt(block, sigma)
    print(
        f"  CasADi + IPOPT {theirs:8.2f} s   {theirs / seconds:6.0f} x   optimum differs by "
        f"{difference(mine, values):.1e}"
    )
    if not arguments.quick:
        values, theirs, calls = with_scipy(block, sigma, mine)
        print(
            f"  SciPy          {theirs:8.2f} s   {theirs / seconds:6.0f} x   optimum differs by "
            f"{difference(mine, values):.1e}   ({calls} simulations)"
        )
    _, plain = timed(lambda: fit_output_error([Recording("capture", block)]))
    print(f"a whole fit of it from nothing (limit 1 s): {plain:.2f} s")
    effects = {
        "coulomb_friction": {"Tc": 0.1},
        "constant_load_torque": {"TL": 0.05},
        "current_sensor_offset": {"i0": 0.1},
    }
    long = recording(60.0, effects)
    fit, seconds = timed(lambda: fit_output_error([Recording("capture", long)], tuple(effects)))
    errors = [
        abs(float(p.value or np.nan) - truth) / float(p.std or np.nan)
        for p, truth in zip(
            fit.parameters.values(), [PAPER.R, PAPER.L, PAPER.K, PAPER.J, PAPER.B, 0.1, 0.05, 0.1], strict=True
        )
    ]
    print(
        f"60 s at 1 kHz, 8 parameters (limit 5 s): {seconds:.2f} s; errors in standard deviations: "
        + ", ".join(f"{n} {e:.1f}" for n, e in zip(fit.parameters, errors, strict=True))
    )


if __name__ == "__main__":
    main()
