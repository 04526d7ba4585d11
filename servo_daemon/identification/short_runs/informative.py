"""Which runs of a recording are informative of a load behind a gap: those that a motor alone does not explain.

In slow reversals the load crosses its gap for a few percent of the time. Runs from all over the recording then say
nearly nothing of the teeth, and a descent goes where their noise leads it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from servo_daemon.identification.output_error.problem.problem import Problem
from servo_daemon.identification.output_error.problem.rollout import TIME
from servo_daemon.identification.short_runs.runs import RATE, TWIST, Runs, swing_s
from servo_daemon.identification.short_runs.states import descended, first_sigma, floor
from servo_daemon.kalman.gaussian import coordinates_of, natural_values
from servo_daemon.plant.effects import effects_by_name
from servo_daemon.samples import F64

#: Length of the runs of the motor alone, s.
_LENGTH_S = 0.05
#: Informative runs hold this share of what the motor alone leaves beyond the noise, and have so many samples at least:
#: winding and motor are to be seen, too.
_MOST_OF_IT, _LEAST_SAMPLES = 0.9, 2_500
#: Of the runs as many are taken for noise alone.
_QUIET = 0.25


@dataclass(frozen=True)
class RunSource:
    """A recording that is cut into runs, of one length after the other.

    Attributes:
        problem: of one recording.
        motor: natural values of the motor with all inertia on its shaft.
    """

    problem: Problem
    motor: Mapping[str, float]

    def runs(self, length_s: float, most_samples: int) -> Runs | None:
        """Of the runs of this length the informative ones, of which some are taken, evenly over the recording, that
        have no more samples than that; None as `Runs.of`."""
        runs = Runs.of(self.problem, length_s)
        if runs is None or self._left is None:
            return runs
        time, left = self._left
        begin = np.searchsorted(time, runs.rows[:, 0, TIME])
        end = np.searchsorted(time, runs.rows[:, -1, TIME], side="right")
        return runs.only(_informative(left[end] - left[begin], _LEAST_SAMPLES // runs.measured.shape[1])).some(
            most_samples
        )

    def in_swings(self, q: F64, swings: float, most_samples: int) -> Runs | None:
        """Runs of so many of the teeth's own swings, with the load and the teeth of these coordinates. See `runs`."""
        return self.runs(swings * swing_s(natural_values(self.problem.plant.parameters, q)), most_samples)

    @cached_property
    def _left(self) -> tuple[F64, F64] | None:
        """Times, shape (n,), and what the motor alone leaves before each of them, shape (n + 1,): log(1 + squares over
        the noise), in which one reading that is nothing but wrong counts little."""
        with_load = Runs.of(self.problem, _LENGTH_S)
        if with_load is None:
            return None
        known = effects_by_name()
        effects = tuple(e for e in self.problem.plant.effects if not {TWIST, RATE} & {s.name for s in known[e].states})
        plant = self.problem.plant.with_effects(effects)
        runs = with_load.of_motor(plant)
        q = coordinates_of(plant.parameters, self.motor)
        sigma = first_sigma(runs)
        settled = descended(runs, q, runs.guessed, sigma)
        for _ in range(2):
            sigma = floor(runs, settled, sigma)
            settled = descended(runs, q, settled.states, sigma)
        with np.errstate(over="ignore"):
            squares = np.square(settled.residuals.reshape(runs.measured.shape))
        left = np.log1p(np.nan_to_num(squares, posinf=1e300)).sum(axis=2)
        return runs.rows[:, :, TIME].ravel(), np.concatenate([[0.0], np.cumsum(left)])


def with_all_inertia(values: Mapping[str, float]) -> dict[str, float]:
    """A motor's values with that of the load on its shaft."""
    return {**values, "J": values["J"] + values.get("J_l", 0.0)}


def _informative(left: F64, least: int) -> NDArray[np.int_]:
    """Of runs that leave so much, shape (k,), the numbers of the informative ones, so many at least, in their order."""
    beyond = np.maximum(left - np.quantile(left, _QUIET), 0.0)
    order = np.argsort(-beyond, kind="stable")
    held = np.cumsum(beyond[order])
    count = int(np.searchsorted(held, _MOST_OF_IT * held[-1])) + 1
    return np.sort(order[: max(count, least)])
