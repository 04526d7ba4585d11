"""What noise of the measured voltage makes of the estimate, where a current answers it.

A voltage that is measured has noise n that the motor never sees. The simulation answers it all the same, and least
squares prefers the parameters that let less of it through: a winding that is slower than it is (errors in variables:
Söderström, *Errors-in-Variables Methods in System Identification*, 2018, ch. 3). An L/R far below a sample is known
from the few steps of a voltage that stands for a while, while every sample has its noise: L comes out 7 to 150 % too
large and claims 2 to 10 %. No residual shows it, since a sensor's own noise looks the same.

At the estimate the normal equations g = J(u)ᵀ W r(u) = 0 hold with the noise in u. What as much noise again adds to
them on average, b = E[J(u + n')ᵀ W r(u + n')] − g, is in them already. Without it they would hold where g = b (Cook &
Stefanski, *J. Am. Stat. Assoc.* 89, 1994, extrapolate by added noise in the same way). Whether the noise is the
sensor's or a dither that the motor follows the recording does not say, nor, beside the current's noise, how large it
is; it is no larger than the voltage's own roughness, nor than what the residuals leave room for. So the way to where
g = b for the largest noise that both allow is one more column of the root of the covariance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from servo_daemon.identification.output_error.precision.information import Information
from servo_daemon.identification.output_error.problem.linearisation import linearise
from servo_daemon.identification.output_error.problem.problem import Problem, Segment
from servo_daemon.identification.output_error.problem.rollout import INPUT
from servo_daemon.identification.output_error.solver.solver import Point, in_units_of_each, normal_equations, within
from servo_daemon.kalman.gaussian import natural_values
from servo_daemon.samples import F64

#: Share of the second differences, the smallest, that noise alone makes: those across a step of the voltage are not
#: among them. And the mean square of that share of a normal distribution's values.
_WITHOUT_STEPS, _MEAN_SQUARE = 0.75, 0.368
#: A winding slower than so many samples lets less than a quarter of the noise's power through, and what one draw of it
#: says of a motor with a poorly known direction would be chance.
_SLOW = 2.0
#: Samples that the noise is averaged over; fewer are drawn anew.
_SAMPLES = 4000
#: Steps to where g = b, the longest of one (an L that the data do not show runs away), and one of this many standard
#: deviations is the last.
_STEPS, _LONGEST, _LAST = 6, 0.5, 0.3


def with_voltage_noise(
    info: Information, problem: Problem, point: Point, whiten: Callable[[Point], Point]
) -> Information:
    """The same with the column of the voltage's noise; as it is where the voltage has none, no current answers it, L
    is not estimated or the winding slow.

    Args:
        point: where the parameters are estimated, as a free run.
        whiten: makes of a free run what the estimate is weighed by.
    """
    if problem.plant.drive != "voltage" or "current_A" not in problem.channels or "L" not in info.names:
        return info
    at_end = natural_values(problem.plant.parameters, problem.coordinates(point.unknowns, 0))
    if at_end["L"] / at_end["R"] > _SLOW * problem.sample_period_s:
        return info
    room = float(point.sigma[problem.channels.index("current_A")]) * at_end["R"]
    sizes = [min(roughness(s.rows[:, INPUT]), room) for s in problem.segments]
    if not any(sizes):
        return info
    noisy = _noisy(problem, sizes)
    unknowns, n, at = point.unknowns, len(info.names), info.names.index("L")
    for _ in range(_STEPS):
        found = _equations(problem, replace(point, unknowns=unknowns), noisy, whiten)
        if found is None:
            break
        H, g = found
        A, size = in_units_of_each(H)
        inverse = np.linalg.inv(A)
        # L and what goes with it; along a direction that is known poorly b is chance.
        share = float(inverse[at] @ (g / size)) / float(inverse[at, at])
        step = np.clip(share * inverse[:, at] / size, -_LONGEST, _LONGEST)
        unknowns = within(problem, unknowns + step)
        if (np.abs(step[:n]) < _LAST * np.sqrt(np.diag(inverse)[:n]) / size[:n]).all():
            break
    return replace(info, root=np.column_stack([info.root, (unknowns - point.unknowns)[:n]]))


def _noisy(problem: Problem, sizes: Sequence[float]) -> list[Problem]:
    """The same with noise of these sizes on top of each segment's voltage, and with its opposite."""
    random = np.random.default_rng(0)
    samples = sum(len(s.rows) for s in problem.segments)
    out = []
    for _ in range(-(-_SAMPLES // samples)):
        noise = [size * random.standard_normal(len(s.rows)) for size, s in zip(sizes, problem.segments, strict=True)]
        for sign in (1.0, -1.0):
            moved = tuple(_moved(s, sign * n) for s, n in zip(problem.segments, noise, strict=True))
            out.append(replace(problem, segments=moved))
    return out


def _moved(segment: Segment, by: F64) -> Segment:
    rows = segment.rows.copy()
    rows[:, INPUT] += by
    return replace(segment, rows=rows)


def _equations(
    problem: Problem, point: Point, noisy: Sequence[Problem], whiten: Callable[[Point], Point]
) -> tuple[F64, F64] | None:
    """H and g − b at the point's unknowns; None where the motor cannot be simulated."""
    found = []
    for each in (problem, *noisy):
        with np.errstate(over="ignore", invalid="ignore"):
            linear = linearise(each, point.unknowns)
        if not linear.finite:
            return None
        found.append(normal_equations(problem, whiten(replace(point, linearisation=linear))))
    H, g = found[0]
    return H, 2.0 * g - np.mean([more for _, more in found[1:]], axis=0)


def roughness(values: F64) -> float:
    """1 σ of the noise in a signal that is smooth, or stands, but for steps."""
    if len(values) < 4:
        return 0.0
    square = np.sort(np.diff(values, 2) ** 2)
    few = square[: int(_WITHOUT_STEPS * len(square))]
    return float(np.sqrt(few.mean() / (6.0 * _MEAN_SQUARE))) if len(few) else 0.0
