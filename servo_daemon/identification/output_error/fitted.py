"""How to fit, and what comes of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from servo_daemon.identification.output_error.noise.noise import NoiseModel
from servo_daemon.identification.output_error.noise.residual import ResidualTest
from servo_daemon.identification.output_error.outcome import NoiseOption
from servo_daemon.identification.output_error.precision.combinations import (
    Combination,
    VoltageAnswer,
)
from servo_daemon.identification.output_error.precision.information import Information, NullDirection
from servo_daemon.identification.output_error.precision.parameters import (
    FittedParameter,
)
from servo_daemon.identification.output_error.problem.problem import Problem
from servo_daemon.identification.output_error.refine import Refined
from servo_daemon.identification.output_error.solver.solver import Iteration, Solution
from servo_daemon.samples import F64


@dataclass(frozen=True, slots=True)
class FitOptions:
    """How to fit.

    Attributes:
        nominal: start values, and values of what the data do not determine; natural units.
        fixed: held at these values.
        robust: isolated wrong samples lose weight.
        segment_s: cut recordings into pieces of about this length.
        noise_model: "auto": noise that enters the motor is looked for and, if it explains the residuals, weighed;
            "none": plain output error.
        thorough: False: only the first start is searched from, and only as far as the simulation gets visibly better:
            for starts that are known to be near the best end.
        deviance_below: the noise model is given up where the deviance will not come below this: the fit of a rival that
            is no better than what there is need not be exact.
        misfit: standard deviations hold what the model lacks, and nothing has a value where it explains nothing; see
            `misfit.py`.
        holds_voltage: whether the drive may hold its voltage for whole samples where the voltage is not in the capture;
            see `input_error.py`.
    """

    nominal: Mapping[str, float] = field(default_factory=dict)
    fixed: Mapping[str, float] = field(default_factory=dict)
    robust: bool = True
    segment_s: float | None = None
    noise_model: NoiseOption = "auto"
    thorough: bool = True
    deviance_below: float = np.inf
    misfit: bool = True
    holds_voltage: bool = True


@dataclass(frozen=True)
class OutputErrorFit:
    """The result.

    Attributes:
        problem, solution: what was solved and how.
        parameters: every parameter of the model.
        offsets: per recording its own offsets, where there are several recordings.
        correlation: of the determined shared parameters, by name.
        before, after: what the recordings determine, at the start and at the end.
        combinations: what is determined of parameters that are not.
        answer: of the speed to the voltage, with its covariance; None where the data leave it open.
        residual: of the free run, by channel.
        innovation: of the noise model's filter, by channel, where that model is used.
        noise: noise that enters the motor, where it explains what the free run leaves: `solution` is then the estimate
            of largest likelihood under it. None: plain output error.
        refined: the estimate of largest likelihood under noise of the voltage, whether it is the published one or not;
            None: it was not asked for, none was seen, or it did not settle.
        unsettled: where a search for it ended that did not.
        plain: the plain output-error solution, whatever was published; `iterations` are its own.
        start: which start won.
        seconds: time taken.
        current_late_s: time constant of a filter that the current has, s; None: none was seen.
        current_is_mean: the current is shown as its mean over the row before, which the fit was not told.
        voltage_rows_late: by how many rows the voltage seems to be late beside a motion alone; negative: early.
    """

    problem: Problem
    solution: Solution
    parameters: Mapping[str, FittedParameter]
    offsets: tuple[Mapping[str, FittedParameter], ...]
    correlation: Mapping[str, Mapping[str, float]]
    before: Information
    after: Information
    combinations: tuple[Combination, ...]
    answer: VoltageAnswer | None
    residual: Mapping[str, ResidualTest]
    innovation: Mapping[str, ResidualTest] | None
    noise: NoiseModel | None
    refined: Refined | None
    unsettled: Refined | None
    plain: Solution
    start: str
    seconds: float
    current_late_s: float | None = None
    current_is_mean: bool = False
    voltage_rows_late: int = 0

    @property
    def null_directions(self) -> tuple[NullDirection, ...]:
        return self.after.null

    @property
    def values(self) -> dict[str, float]:
        """Natural values of the parameters that have one, held ones included."""
        return {name: p.value for name, p in self.parameters.items() if p.value is not None}

    @property
    def white(self) -> bool:
        """Whether the model and the noise explain the data."""
        return all(test.white for test in (self.innovation or self.residual).values())

    @property
    def deviance(self) -> float | None:
        """−2 log p of the data under this model with noise of voltage and sensors: what two fits of the same data are
        compared by (`solution.point.value` is that of a free run whose sensors alone are noisy, however it was
        fitted). None: that is not known."""
        if self.refined is not None:
            return self.refined.deviance
        return self.solution.point.value + float(self.problem.counts.sum()) if self.white else None

    @property
    def likeliest(self) -> Refined | None:
        """Where the search for the largest likelihood ended, settled or not."""
        return self.refined or self.unsettled

    @property
    def deviance_at_best(self) -> float | None:
        """What the deviance is, or may be at the best where the search for it did not settle; None: not known."""
        return self.unsettled.at_best if self.unsettled is not None else self.deviance

    def cost(self, iteration: Iteration) -> float:
        """Mean squared residual over the mean square of the measured signal about its mean; over several channels the
        geometric mean, which is what falls with the likelihood (one channel: the sum of squares but for a factor)."""
        counts = self.problem.counts
        with np.errstate(divide="ignore"):
            logs = np.log(iteration.sse / (counts * self.problem.spread**2))
        return float(np.exp(counts @ logs / counts.sum()))

    def coordinates(self, recording: int = 0) -> F64:
        """The plant's parameter vector in coordinates, shape (np,)."""
        return self.problem.coordinates(self.solution.point.unknowns, recording)
