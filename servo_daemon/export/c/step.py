"""One step of the motor with its derivatives, as the estimator on the drive computes it: the plant's own equations,
with the exponential by a series of fixed length and single precision in mind."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca

from servo_daemon.plant import flow
from servo_daemon.plant.core import linear_core
from servo_daemon.plant.dry import friction_over_step

#: Effects that the estimator knows beside the linear motor: their parameter stands in the step below.
KNOWN = {"coulomb_friction": "Tc", "constant_load_torque": "TL"}
#: Terms of the series and the spectral radius up to which it serves: 1.5¹¹/13! = 1e-8 is cut off, which single
#: precision rounds away. A doubling costs as much as eight terms.
_TERMS, _RADIUS = 11, 1.5
#: Parameters may become so much different from what they were at the export.
_MARGIN = 1.5


@dataclass(frozen=True)
class StepCode:
    """The step as a CasADi function and what it was made for.

    Attributes:
        function: (x, trajectory, away, p, u, h) -> (x_next, trajectory_next, by_state, by_parameter, gain); x, away and
            trajectory (i, ω, θ); p in natural units; by_state (3 × 2 by i and ω, row by row), by_parameter (3 × n,
            row by row) by the logarithms of positive parameters; gain (3 × 2) by voltage and load torque.
        operations: how many it has.
        doublings: of the series.
    """

    function: ca.Function
    operations: int
    doublings: int


def doublings_for(values: Mapping[str, float], longest_step_s: float) -> int:
    """So many that the series holds for steps up to this."""
    R, L, K, J, B = (values[name] for name in ("R", "L", "K", "J", "B"))
    radius = _MARGIN * longest_step_s * max(R / L + B / J, K / math.sqrt(L * J))
    return max(0, math.ceil(math.log2(radius / _RADIUS)))


def build_step(names: Sequence[str], L: float, doublings: int) -> StepCode:
    """The step for these parameters.

    Args:
        names: estimated ones, R, K, J, B first; of them `TL` is signed, the others positive.
        L: held, H.
    """
    x, trajectory, away = (ca.SX.sym(n, 3) for n in ("x", "trajectory", "away"))
    p, u, h = ca.SX.sym("p", len(names)), ca.SX.sym("u"), ca.SX.sym("h")
    by_name = {name: p[k] for k, name in enumerate(names)} | {"L": ca.SX(L)}
    # The series is differentiated by the two numbers that it is of, m and d of the matrix, not by every parameter.
    f, seen = ca.SX.sym("f", 6), list[ca.SX]()

    def phi(Z: ca.SX) -> tuple[flow.MatrixFunction, flow.MatrixFunction, flow.MatrixFunction]:
        seen.append(Z)
        first, second, third = (flow.MatrixFunction(f[2 * k], f[2 * k + 1]) for k in range(3))
        return first, second, third

    def after(at: ca.SX) -> tuple[ca.SX, ca.SX]:
        core = linear_core("voltage", at, by_name, h, phi=phi)
        free = core.free + core.per_input * u + core.per_load * by_name.get("TL", ca.SX(0))
        if "Tc" in by_name:
            Tc = by_name["Tc"]
            free += core.per_load * friction_over_step(at[1], free[1], core.per_load[1], Tc, Tc)
        return free, ca.horzcat(core.per_input, core.per_load)

    x_next, gain = after(x)
    modelled, _ = after(trajectory)
    moved, _ = after(away)
    scale = ca.diag(ca.vertcat(*[1.0 if name == "TL" else p[k] for k, name in enumerate(names)]))
    values, by_p = _series(seen[0], doublings, p)
    by_state = ca.jacobian(moved, away)[:, :2]
    by_parameter = (ca.jacobian(modelled, p) + ca.jacobian(modelled, f) @ by_p) @ scale
    results = [x_next, modelled, by_state.T.reshape((-1, 1)), by_parameter.T.reshape((-1, 1)), gain.T.reshape((-1, 1))]
    results = ca.substitute([ca.densify(r) for r in results], [f], [values])
    function = ca.Function("step", [x, trajectory, away, p, u, h], ca.cse(results))
    return StepCode(function, function.n_instructions(), doublings)


def _series(Z: ca.SX, doublings: int, p: ca.SX) -> tuple[ca.SX, ca.SX]:
    """α and β of φ_0, φ_1, φ_2 at Z, shape (6,), and their derivatives by p, (6, n)."""
    md = ca.SX.sym("md", 2)
    # Any matrix with this m and d will do: the functions depend on nothing else.
    stand_in = ca.vertcat(ca.horzcat(0, -md[1]), ca.horzcat(1, 2 * md[0]))
    values = ca.vertcat(*(part for g in flow.phi_series(stand_in, _TERMS, doublings) for part in g))
    of_Z = ca.vertcat((Z[0, 0] + Z[1, 1]) / 2, Z[0, 0] * Z[1, 1] - Z[0, 1] * Z[1, 0])
    at, by_md = ca.substitute([values, ca.jacobian(values, md)], [md], [of_Z])
    return at, by_md @ ca.jacobian(of_Z, p)
