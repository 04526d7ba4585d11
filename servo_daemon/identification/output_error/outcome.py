"""Which estimate is published, with which covariance: plain output error, or the likelihood's with the noise it found.

Plain output error is the likelihood's own answer where the sensors' noise is all there is, and it is the safer one
where the model lacks something: a free run shows what is missing, a filter would follow it. So the likelihood's answer
is taken only if noise of the voltage explains the residuals: the innovations are white, and a white load torque beside
it adds nothing.

A white load torque is no explanation. Encoders are coarse against what a torque does to an angle within a sample, so
that a filter with enough of it follows whatever is missing and leaves white innovations: dry friction of 2 % of the
working torque passes for a white torque of 4 %. Where the likelihood asks for one, the model lacks something, and plain
output error is published, with the larger standard deviations. The same goes for drives without a measured current or
voltage, where noise of the input cannot be told from a torque.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import reduce
from typing import Literal

from servo_daemon.identification.output_error.noise.noise import WORTH, NoiseModel, resolution
from servo_daemon.identification.output_error.noise.residual import ResidualTest, innovation_tests, residual_tests
from servo_daemon.identification.output_error.noise.whitening import moving
from servo_daemon.identification.output_error.precision.information import (
    Information,
    information,
    largest,
    sandwich,
    wider,
)
from servo_daemon.identification.output_error.problem.problem import Problem
from servo_daemon.identification.output_error.refine import Refined, refine, with_lost_seen
from servo_daemon.identification.output_error.solver.solver import Point, Solution
from servo_daemon.identification.output_error.whitened_point import whiten_point
from servo_daemon.samples import F64

NoiseOption = Literal["auto", "none"]


@dataclass(frozen=True, slots=True)
class Outcome:
    """What is published.

    Attributes:
        solution: the estimate.
        information: what is known there; its covariance is that of the estimate.
        residual: of the free run there, by channel.
        innovation: of the filter, by channel; None without a noise model.
        noise: the noise model the estimate is for; None: plain output error.
        refined, unsettled: see `OutputErrorFit`.
    """

    solution: Solution
    information: Information
    residual: Mapping[str, ResidualTest]
    innovation: Mapping[str, ResidualTest] | None
    noise: NoiseModel | None
    refined: Refined | None
    unsettled: Refined | None = None

    def as_weighed(self, problem: Problem) -> Callable[[Point], Point]:
        """What makes of a free run what the estimate was made of: its innovations, where noise is modelled."""
        noise = self.refined.log_variance if self.refined is not None and self.noise is not None else None
        return lambda point: point if noise is None else whiten_point(problem, point, noise)[0]


def conclude(
    problem: Problem, plain: Solution, scale: F64, option: NoiseOption, torque_size: float, below: float
) -> Outcome:
    """From the plain output-error solution to what is published.

    Args:
        scale: as for `information`.
        torque_size: N·m, what the motor typically exerts.
        below: see `FitOptions.deviance_below`.
    """
    refined = None
    if option == "auto" and problem.plant.drive == "voltage":
        refined = refine(problem, plain.point, torque_size, below)
    if refined is None:
        return _plain(problem, plain, scale, None)
    for tried in (_from_lost(problem, refined, torque_size), refined):
        if tried is not None and (outcome := _explained(problem, plain, scale, tried)) is not None:
            return outcome
    if not refined.at_rest:
        return replace(_plain(problem, plain, scale, None), unsettled=refined)
    return _plain(problem, plain, scale, refined)


def _from_lost(problem: Problem, refined: Refined, torque_size: float) -> Refined | None:
    """The likelihood's end from where a parameter lost on the way is not at nothing; None: it is no better."""
    seen = with_lost_seen(problem, refined.point, refined.log_variance) if "current_A" in problem.channels else None
    other = None if seen is None else refine(problem, seen, torque_size, refined.deviance)
    return other if other is not None and other.deviance < refined.deviance else None


def _explained(problem: Problem, plain: Solution, scale: F64, refined: Refined) -> Outcome | None:
    """The likelihood's answer, if noise of the voltage explains the residuals."""
    if not refined.at_rest or refined.torque_gain >= WORTH or "current_A" not in problem.channels:
        return None
    innovations, rms = refined.whitened.linearisation.residuals, refined.innovation_rms
    tests = innovation_tests(problem, innovations, rms, moving(problem), resolution(problem))
    if not all(test.white for test in tests.values()):
        return None
    solution = replace(plain, point=refined.point, at_bound=refined.at_bound)
    known = wider(information(problem, refined.whitened, scale), refined.event_time_std)
    return Outcome(solution, known, residual_tests(problem, refined.point), tests, refined.noise, refined)


def _plain(problem: Problem, plain: Solution, scale: F64, rejected: Refined | None) -> Outcome:
    """The standard deviations are the largest of those that can be defended: of white residuals, of coloured ones by
    their spectrum, and of the noise model, whose innovations count as many times as they correlate. All at the same
    point, where they share what is not seen at all."""
    known = information(problem, plain.point, scale)
    residual = residual_tests(problem, plain.point)
    if rejected is not None or not all(test.white for test in residual.values()):
        others = [sandwich(problem, plain.point, known)]
        if rejected is not None:
            whitened, _ = whiten_point(problem, plain.point, rejected.log_variance)
            filtered = information(problem, whitened, scale)
            others += [filtered.root, sandwich(problem, whitened, filtered)]
        known = replace(known, root=reduce(largest, others, known.root))
    if rejected is not None:
        known = wider(known, _event_time_std(plain, rejected))
    return Outcome(plain, known, residual, None, None, rejected)


def _event_time_std(plain: Solution, rejected: Refined) -> dict[int, float]:
    """Of the event times in a free run, whose derivative knows no more of them: as far as the likelihood puts them
    at other values, and its own."""
    here, there = plain.point.unknowns, rejected.point.unknowns
    return {k: math.hypot(std, float(here[k] - there[k])) for k, std in rejected.event_time_std.items()}
