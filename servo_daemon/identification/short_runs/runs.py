"""Free runs of one length over a recording, all simulated at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from servo_daemon.identification.output_error.problem.problem import MOTOR_STATES, Problem, Segment
from servo_daemon.identification.output_error.problem.rollout import TIME, free_runs
from servo_daemon.identification.output_error.problem.setup import SLOPE_SAMPLES
from servo_daemon.plant.build import PlantModel
from servo_daemon.samples import F64

#: States of a load's own, see `plant.effects.base.TWIST`.
RATE, TWIST = "twist_rate_rad_s", "twist_rad"
#: Differences: of a motor's state as a share of its size, of the twist of the gap, of its rate of the load's speeds.
_OF_MOTOR, _OF_GAP, _OF_RATE = 1e-6, 1e-4, 1e-3
#: The fastest that a load moves against its motor, as a share of the motor's speeds (a tenth is usual).
_FASTEST = 0.3
#: Runs, in times of the teeth's own swing (2π/ω): so short that a load meets its teeth about once, for what the teeth
#: are like; so long that it crosses the gap, for how wide that is. Never fewer samples.
SHORT, LONG, FEWEST = 4.0, 16.0, 30
#: Samples that are searched in the end, and those to begin with.
MOST_SAMPLES, FEW_SAMPLES = 12_000, 5_000


def swing_s(values: Mapping[str, float]) -> float:
    """Time of a swing of the load on its teeth, both free, s.

    Args:
        values: natural units.
    """
    mu = values["J"] * values["J_l"] / (values["J"] + values["J_l"])
    return 2.0 * np.pi * float(np.sqrt(mu / values["k_s"]))


def of_states(plant: PlantModel, scale: F64, q: F64, shares: tuple[float, float, float]) -> F64:
    """Shares of what the states are large against, shape (nx,).

    Args:
        scale: shape (nx,), size of each state.
        q: shape (np,) or longer, the plant's coordinates.
        shares: of a motor's state its size, of a load's twist the gap, of its rate the fastest.
    """
    out = shares[0] * scale
    if TWIST in plant.state_names:
        out[plant.state_names.index(TWIST)] = shares[1] * float(np.exp(q[plant.parameter_names.index("gap")]))
        out[plant.state_names.index(RATE)] = shares[2] * fastest_rad_s(plant, scale)
    return np.asarray(out)


def fastest_rad_s(plant: PlantModel, scale: F64) -> float:
    """The fastest that a load moves against the motor; `scale` as for `of_states`."""
    return _FASTEST * float(scale[plant.state_names.index("velocity_rad_s")])


def can_be_searched(problem: Problem) -> bool:
    """Whether there is a gap, in one recording, and no state but motor's and load's (what is slow goes on from run to
    run)."""
    names = problem.plant.state_names
    return (
        "gap" in problem.plant.parameter_names
        and set(names) <= {*MOTOR_STATES, RATE, TWIST}
        and (problem.recordings == 1)
    )


def can_be_fitted(problem: Problem) -> bool:
    """Whether the load can be searched for and the gap is to be found, too."""
    return "gap" in problem.free and can_be_searched(problem)


@dataclass(frozen=True)
class Runs:
    """k free runs of n samples each, c channels.

    Attributes:
        plant: with a load behind a spring or a gap, and no other states than the motor's.
        channels: measured ones.
        rows: shape (k, n, 3), see `rollout`.
        measured: shape (k, n, c).
        valid: the same.
        guessed: shape (k, nx), initial states with the load at rest against the motor.
        scale: shape (nx,), size of each state.
    """

    plant: PlantModel
    channels: tuple[str, ...]
    rows: F64
    measured: F64
    valid: NDArray[np.bool_]
    guessed: F64
    scale: F64

    @classmethod
    def of(cls, problem: Problem, length_s: float) -> Runs | None:
        """A problem's segments cut into runs of this length; None: there are none, or the model has states that runs so
        short do not show.
        """
        if not can_be_searched(problem):
            return None
        n = max(round(length_s / problem.sample_period_s), FEWEST)
        cuts = [(s, b) for s in problem.segments for b in range(0, len(s.rows) - n + 1, n)]
        cuts = [(s, b) for s, b in cuts if s.valid[b : b + n].any(axis=0).all()]
        return cls._cut(problem, cuts, n) if cuts else None

    @classmethod
    def over(cls, problem: Problem) -> Runs:
        """Each of a problem's segments one run, as long as the shortest."""
        return cls._cut(problem, [(s, 0) for s in problem.segments], min(len(s.rows) for s in problem.segments))

    @classmethod
    def _cut(cls, problem: Problem, cuts: Sequence[tuple[Segment, int]], n: int) -> Runs:
        return cls(
            problem.plant,
            problem.channels,
            np.stack([s.rows[b : b + n] for s, b in cuts]),
            np.stack([np.nan_to_num(s.measured[b : b + n]) for s, b in cuts]),
            np.stack([s.valid[b : b + n] for s, b in cuts]),
            np.stack([_guess(problem, s, b) for s, b in cuts]),
            problem.segments[0].x0_scale,
        )

    def some(self, most_samples: int) -> Runs:
        """Evenly chosen ones of them with no more samples than that."""
        if self.measured.shape[0] * self.measured.shape[1] <= most_samples:
            return self
        count = max(most_samples // self.measured.shape[1], 1)
        return self.only(np.linspace(0, len(self.rows) - 1, count).astype(int))

    def only(self, chosen: NDArray[np.int_] | NDArray[np.bool_]) -> Runs:
        """The chosen ones of these runs."""
        return replace(
            self,
            rows=self.rows[chosen],
            measured=self.measured[chosen],
            valid=self.valid[chosen],
            guessed=self.guessed[chosen],
        )

    def of_motor(self, plant: PlantModel) -> Runs:
        """The same with a plant that has no state of the load's own."""
        return replace(
            self, plant=plant, guessed=self.guessed[:, self.motor_states], scale=self.scale[self.motor_states]
        )

    @cached_property
    def counts(self) -> F64:
        """Valid values of each run, shape (k,)."""
        return np.asarray(self.valid.sum(axis=(1, 2)), dtype=np.float64)

    @cached_property
    def load_states(self) -> tuple[int, int]:
        """Which states are the twist and its rate."""
        names = self.plant.state_names
        return names.index(TWIST), names.index(RATE)

    @cached_property
    def motor_states(self) -> list[int]:
        """Indices of the states that are the motor's."""
        return [k for k in range(len(self.plant.states)) if k not in self.load_states]

    def residuals(self, q: F64, states: F64, sigma: F64) -> F64:
        """Measured minus simulated over σ, shape (k, n·c); 0 where not valid.

        Args:
            q: shape (np,), the plant's parameters in coordinates.
            states: shape (k, nx).
            sigma: shape (c,).
        """
        with np.errstate(over="ignore", invalid="ignore"):
            shown = free_runs(self.plant, self.channels, q, states, self.rows)
            out = np.where(self.valid, (self.measured - shown) / sigma, 0.0)
        return out.reshape(len(states), out.shape[1] * out.shape[2])

    def by_states(self, q: F64, states: F64, sigma: F64, here: F64, which: Sequence[int] | None = None) -> F64:
        """Derivatives of what is shown over σ by the initial states, shape (k, n·c, len(which)).

        Args:
            here: `residuals` there.
            which: of the states; None: all.
        """
        which = range(states.shape[1]) if which is None else which
        steps = of_states(self.plant, self.scale, q, (_OF_MOTOR, _OF_GAP, _OF_RATE))
        out = np.empty((*here.shape, len(which)))
        for column, k in enumerate(which):
            ahead = states.copy()
            ahead[:, k] += steps[k]
            out[:, :, column] = (here - self.residuals(q, ahead, sigma)) / steps[k]
        return out

    def by_parameters(self, q: F64, states: F64, sigma: F64, here: F64, columns: Sequence[int], step: float) -> F64:
        """The same by parameters' coordinates, shape (k, n·c, len(columns))."""
        out = np.empty((*here.shape, len(columns)))
        for column, k in enumerate(columns):
            ahead = q.copy()
            ahead[k] += step
            out[:, :, column] = (here - self.residuals(ahead, states, sigma)) / step
        return out

    def gap_rad(self, q: F64) -> float:
        """The gap at these coordinates."""
        return float(np.exp(q[self.plant.parameter_names.index("gap")]))

    @cached_property
    def fastest_rad_s(self) -> float:
        """The fastest that a load moves against the motor."""
        return fastest_rad_s(self.plant, self.scale)


def _guess(problem: Problem, segment: Segment, begin: int) -> F64:
    """Current and angle as measured, speed from the slope, the load with the motor."""
    names, x0 = problem.plant.state_names, np.array([s.initial for s in problem.plant.states])
    few = slice(begin, begin + SLOPE_SAMPLES)
    for c, name in enumerate(problem.channels):
        good = segment.valid[few, c]
        values, t = segment.measured[few, c][good], segment.rows[few, TIME][good]
        if name not in names or not len(values):
            continue
        x0[names.index(name)] = values[0]
        if name == "position_rad" and len(values) > 1:
            slope, first = np.polyfit(t - segment.rows[begin, TIME], values, 1)
            x0[names.index("velocity_rad_s")], x0[names.index("position_rad")] = slope, first
    return x0
