"""The paper's own experiment redone: its method 1 to the digit, its method 2 from its start, its position test.

The paper's data are not published. Method 2 is run on a simulated experiment of the motor it found (steps of the angle,
laboratory sensors), once from the angle alone as in the paper, once from current and angle.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType

import numpy as np

from servo_daemon.identification.output_error import FitOptions, OutputErrorFit, Recording, fit_output_error
from servo_daemon.identification.output_error.problem.linearisation import linearise
from servo_daemon.identification.paper.coefficients import PaperCoefficients, redo_paper
from servo_daemon.identification.paper.position_experiment import PositionTest, position_test, product_for
from servo_daemon.kalman.gaussian import to_coordinate
from servo_daemon.parameters import MOTOR_NAMES
from servo_daemon.samples import SampleBlock, make_block
from servo_daemon.simulate import simulate_capture

#: Section 2, method 2: where the paper's estimation starts, and what it ends with.
START: Mapping[str, float] = MappingProxyType({"R": 1.93, "L": 2.348e-3, "K": 4.943e-3, "J": 9.027e-3, "B": 0.518})
RESULT: Mapping[str, float] = MappingProxyType({"R": 0.4937, "L": 2.2769e-3, "K": 0.30628, "J": 0.009751, "B": 0.51141})
#: Table 1: iteration, F-count, cost.
TABLE_1: tuple[tuple[int, int, float], ...] = (
    (0, 11, 308.1377),
    (1, 22, 83.5586),
    (2, 33, 5.7234),
    (3, 44, 0.7146),
    (4, 55, 0.7033),
)
_SECONDS, _RATE_HZ, _SEED = 10.0, 1000.0, 1


@dataclass(frozen=True, slots=True)
class PaperRedone:
    """Everything of the paper that can be computed again.

    Attributes:
        method1: its numbers beside ours.
        product_V_rad: k_io·k_s for which method 1's motor stands at 45° after 5 s: chosen so.
        tests: the position test of both methods' parameters with that gain; "method2" is a result, not a choice.
        from_angle, from_both: method 2 from the paper's start.
        experiment: the simulated recording.
    """

    method1: PaperCoefficients
    product_V_rad: float
    tests: Mapping[str, PositionTest]
    from_angle: OutputErrorFit
    from_both: OutputErrorFit
    experiment: SampleBlock


def noise_floor(fit: OutputErrorFit) -> dict[str, float]:
    """What the true parameters leave of the experiment, RMS by channel: the noise of its sensors."""
    problem = fit.problem
    true = {p.name: to_coordinate(p, RESULT[p.name]) for p in problem.plant.parameters}
    there = linearise(problem, problem.with_parameters(fit.solution.point.unknowns, true))
    left = np.concatenate(there.residuals)
    return {name: float(np.sqrt(np.mean(left[:, k] ** 2))) for k, name in enumerate(problem.channels)}


def method1_motor(found: PaperCoefficients) -> dict[str, float]:
    """R, L, K, J, B of the paper's method 1 (its D is our B)."""
    return {name: found.values["D" if name == "B" else name] for name in MOTOR_NAMES}


@cache
def paper_product() -> float:
    """k_io·k_s, V/rad, with which method 1's motor stands at the reported angle."""
    return product_for(method1_motor(redo_paper()))


def redo() -> PaperRedone:
    """Run it; deterministic."""
    method1 = redo_paper()
    first, product = method1_motor(method1), paper_product()
    true = position_test(RESULT, product)
    tests = {"method1": position_test(first, product, true), "method2": position_test(RESULT, product, true)}
    block, _ = simulate_capture(seconds=_SECONDS, rate_hz=_RATE_HZ, seed=_SEED, motion="steps", motor=dict(RESULT))
    angle = make_block(block.time_s, voltage_V=block.voltage_V, position_rad=block.position_rad)
    options = FitOptions(nominal=START)
    return PaperRedone(
        method1,
        product,
        MappingProxyType(tests),
        fit_output_error([Recording("angle alone", angle)], (), options),
        fit_output_error([Recording("current and angle", block)], (), options),
        block,
    )
