"""Multi-start over event times and frequencies, which no descent finds.

Moving the time of a step changes the simulation only between the old time and the new one, so that the sum of squares
falls towards the true one from nearby alone; and while the step has no size its time has no effect at all. A frequency
is found from within half a period over the whole recording. So times all over the recording are tried, and the
frequencies that stand out of the residual, each for a few iterations; the best goes on.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from servo_daemon.identification.output_error.problem.event_times import event_times_of
from servo_daemon.identification.output_error.problem.problem import Problem
from servo_daemon.identification.output_error.problem.rollout import TIME
from servo_daemon.identification.output_error.solver.solver import Solution, solve
from servo_daemon.plant.columns.scans import spectral_lines
from servo_daemon.plant.effects import event_times
from servo_daemon.samples import F64

#: Event times that are tried, iterations of each (the first finds the step's size, the others its time), and how often
#: times closer together are tried around the best: the sum of squares has small valleys of its own.
_TRIED, _ITERATIONS, _CLOSER = 16, 6, 3
#: So many on either side, at this part of the distance before.
_ASIDE, _PART = 3, 0.25
#: Event times nearby are tried this part of a piece apart.
_NEARBY = 0.75
#: Lines of the residual's spectrum that are tried, with these phases.
_LINES, _PHASES = 4, (0.0, np.pi / 2, np.pi, -np.pi / 2)
#: A periodic torque is at first so much of the motor's.
_SHARE = 0.05


def is_to_be_searched(problem: Problem) -> bool:
    """Whether an event time or a frequency is free."""
    return not {*event_times().values(), "f_per"}.isdisjoint(problem.free)


def from_other_starts(
    problem: Problem, found: Solution, seconds: float, torque_Nm: float, *, robust: bool
) -> Solution | None:
    """The best of a few iterations from other event times and frequencies, if that is better than what was found; None:
    nothing is.

    Args:
        found: where the search has ended.
        seconds: length of the longest recording.
        torque_Nm: what the motor typically exerts.
    """
    best = found
    for size, name in event_times().items():
        if name in problem.free:
            best = _from_event_times(problem, best, name, size, seconds, robust=robust)
    if "f_per" in problem.free:
        best = _from_frequencies(problem, best, float(np.log(_SHARE * torque_Nm)), robust=robust)
    return None if best is found else best


def _from_event_times(
    problem: Problem, best: Solution, name: str, size: str, seconds: float, *, robust: bool
) -> Solution:
    """Args: name, size: of the event time and of what steps then."""
    column, apart_s = problem.free.index(name), seconds / _TRIED
    tried_s = (np.arange(_TRIED) + 0.5) * apart_s
    for level in range(_CLOSER + 1):
        for at_s in tried_s:
            unknowns = best.point.unknowns.copy()
            unknowns[column] = at_s
            if level == 0 and size in problem.free:
                unknowns[problem.free.index(size)] = 0.0
            best = _better(problem, best, unknowns, robust=robust)
        apart_s *= _PART
        tried_s = best.point.unknowns[column] + np.arange(-_ASIDE, _ASIDE + 1) * apart_s
    return best


def from_nearby(problem: Problem, found: Solution, *, robust: bool) -> Solution | None:
    """The same of event times within some pieces of the recording of where the search has ended: across the edge of a
    piece, which begins in a state of its own, no derivative leads."""
    best = found
    spans_s = [float(s.rows[-1, TIME] - s.rows[0, TIME]) for s in problem.segments]
    apart_s = _NEARBY * float(np.median(spans_s))
    for column in event_times_of(problem):
        for _ in range(_CLOSER):
            before = best
            for at_s in before.point.unknowns[column] + apart_s * np.array([-4.0, -2.0, -1.0, 1.0, 2.0, 4.0]):
                unknowns = before.point.unknowns.copy()
                unknowns[column] = at_s
                best = _better(problem, best, unknowns, robust=robust)
            if best is before:
                break
    return None if best is found else best


def _from_frequencies(problem: Problem, best: Solution, amplitude: float, *, robust: bool) -> Solution:
    """Args: amplitude: coordinate to begin with; at a wrong frequency a search has driven it to nothing."""
    begun = best.point.unknowns
    for frequency_Hz in _lines_Hz(problem, best):
        for phase in _PHASES:
            unknowns = begun.copy()
            unknowns[problem.free.index("f_per")] = np.log(frequency_Hz)
            for name, value in (("phi_per", phase), ("Tper", amplitude)):
                if name in problem.free:
                    unknowns[problem.free.index(name)] = value
            best = _better(problem, best, unknowns, robust=robust)
    return best


def _better(problem: Problem, best: Solution, unknowns: F64, *, robust: bool) -> Solution:
    tried = solve(problem, unknowns, robust=robust, max_iterations=_ITERATIONS, curved=False)
    return tried if tried is not None and tried.point.value < best.point.value else best


def _lines_Hz(problem: Problem, found: Solution) -> Iterator[float]:
    """Frequencies that stand out of what is left of each channel of the longest piece, the strongest first. An angle
    shows a torque by its second derivative, a speed by its first."""
    k = max(range(len(problem.segments)), key=lambda s: len(problem.segments[s].rows))
    time_s = problem.segments[k].rows[:, TIME]
    for c, name in enumerate(problem.channels):
        order = {"position_rad": 2, "velocity_rad_s": 1}.get(name, 0)
        changes = np.diff(found.point.linearisation.residuals[k][:, c], n=order)
        yield from spectral_lines(time_s[order:], changes, _LINES)
