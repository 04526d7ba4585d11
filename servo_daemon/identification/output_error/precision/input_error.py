"""What is not known of a current or torque between its samples, and what that makes of the estimate.

The voltage of a capture is held (docs/captures.md). A current or a torque is a sample of something that goes on. Its
mean over a step is

    u_k + a (u_{k+1} − u_k),

a = 1/2 if it runs straight, 0 if it is commanded and held, 1/(1 − e^{−x}) − 1/x with x = h R/L, up to 1, if it settles
after a step of the voltage. Which of them a capture does not say; against the motion a is a delay of up to half a
sample. So a is a number between 0 and 1 of which nothing is known, and moves the estimate by dq/da: one more column of
the root of its covariance, of 1/√12 dq/da.

A drive that holds its voltage for whole samples does more: within each the current falls as the speed rises, and its
samples are where it has fallen most. The mean is larger by (a − 1/2) h (K/R) dω/dt, which looks like less inertia,

    δJ = −(a − 1/2) h K²/R,

half a sample over the mechanical time constant R J/K² at the most (2 % for an RE 40 at 1 kHz, whatever its motion).
That shows in no residual; it is another column, for J alone. Where R is not known a usual time constant stands in.

In neither is the input's own noise, which an angle adds up twice: B of a motion with little speed is off by up to 2 %
where 0.3 to 1 % are claimed. Its rounding is, see `rounding.py`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from servo_daemon.identification.output_error.precision.information import Information
from servo_daemon.identification.output_error.precision.rounding import DRAWS, rounded_otherwise
from servo_daemon.identification.output_error.problem.inputs import STRAIGHT
from servo_daemon.identification.output_error.problem.linearisation import Linearisation, linearise
from servo_daemon.identification.output_error.problem.problem import Problem
from servo_daemon.identification.output_error.problem.setup import Recording
from servo_daemon.identification.output_error.solver.solver import Point, in_units_of_each, normal_equations
from servo_daemon.numerics import UNIFORM_STD
from servo_daemon.samples import F64

#: The share that the derivative by it is taken with.
SHIFTED = STRAIGHT + 0.1
#: Mechanical time constant of a motor with its load where R is not known, s: motors of catalogues have 3 ms (coreless)
#: to 30 ms without a load. The fastest one's J is then off by 4 standard deviations, one of 12 ms by 1.
USUAL_S = 12e-3
#: A voltage is held for no longer than the loops of slow firmware take, 200 Hz, however seldom it is logged.
LONGEST_HOLD_S = 5e-3


def with_input_error(
    info: Information,
    recordings: Sequence[Recording],
    problems: tuple[Problem, Problem],
    point: Point,
    known: Mapping[str, float] | None,
) -> Information:
    """The same with the columns of both, and of the input's rounding.

    Args:
        recordings: of the problem.
        problems: it, and the same problem with `input_share=SHIFTED`.
        point: where it is estimated.
        known: values that are given, by name; None: the drive holds no voltage for whole samples.
    """
    problem, shifted = problems
    share = UNIFORM_STD / (SHIFTED - STRAIGHT) * _shifts(problem, [shifted], point)
    held = np.zeros(len(info.names)) if known is None else _shift_by_held_voltage(problem, point, known)
    rounding = _shifts(problem, rounded_otherwise(problem, recordings), point) / np.sqrt(DRAWS)
    return replace(info, root=np.column_stack([info.root, share, held, rounding]))


def _shifts(problem: Problem, others: Iterable[Problem], point: Point) -> F64:
    """By how much the parameters move, to first order, if the input is that of each of other problems, shape (k, ·);
    zero where that cannot be simulated."""
    n = len(problem.parameter_of_column)
    J, here = point.linearisation.jacobian, point.linearisation.residuals

    def equations(moved: Sequence[F64]) -> tuple[F64, F64]:
        return normal_equations(problem, replace(point, linearisation=Linearisation(tuple(moved), J, True)))

    H, at_rest = equations([np.zeros_like(r) for r in here])
    A, size = in_units_of_each(H)
    columns = []
    for other in others:
        with np.errstate(over="ignore", invalid="ignore"):
            there = linearise(other, point.unknowns)
        if there.finite:
            _, g = equations([b - a for a, b in zip(here, there.residuals, strict=True)])
            columns.append((np.linalg.solve(A, (g - at_rest) / size) / size)[:n])
    return np.column_stack(columns) if columns else np.zeros((n, 0))


def _share_settled(period_s: float, values: Mapping[str, float]) -> float:
    """a where the voltage is held: of R and L, or 1 where L is not among them."""
    x = period_s * values["R"] / values["L"] if "L" in values else np.inf
    if x > 50.0:
        return 1.0 - 1.0 / x
    return 0.5 + x / 12.0 if x < 1e-3 else float(-1.0 / np.expm1(-x) - 1.0 / x)


def _shift_by_held_voltage(problem: Problem, point: Point, known: Mapping[str, float]) -> F64:
    """1 σ of the parameters' coordinates from not knowing whether the drive held its voltage, shape (k,).

    Args:
        known: values that are given, by name.
    """
    names = problem.parameter_of_column
    out = np.zeros(len(names))
    if problem.plant.drive == "current" and "J" in names:
        h = problem.sample_period_s
        if "R" in known:
            q = dict(zip(problem.plant.parameter_names, problem.coordinates(point.unknowns, 0), strict=True))
            share = (_share_settled(h, known) - 0.5) * h * np.exp(2 * q["K"] - q["J"]) / known["R"]
        else:
            share = 0.5 * min(h, LONGEST_HOLD_S) / USUAL_S
        out[names.index("J")] = share
    return out
