"""What a plan is asked: how well parameters become known, or how far one model stays from another that is fitted to it.

A question turns a block into sums that add up (`statistics.py`), one for each set of values that may be true, and such
sums into a score: larger is better, and one unit is a factor of e (in a standard deviation, or in a distance).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from servo_daemon.experiment.models import Model
from servo_daemon.experiment.statistics import Noise, contrast, distance, fisher, start_state
from servo_daemon.identification.output_error.problem.rollout import free_run
from servo_daemon.samples import F64

#: Largest change of a coordinate when the second model is fitted, in its units.
_LONGEST_STEP = 1.5
#: Weight of what is known before against samples where a distance is told: only against singular sums.
_REGULAR = 1e-6
#: Free runs: samples from, to.
Cuts = Sequence[tuple[int, int]]


class Question(Protocol):
    """What a plan can be asked: sums of a block that add up, and the score that they make."""

    @property
    def truth(self) -> Model:
        """The model that is true, with its draws."""
        ...

    def statistics(self, rows: F64, cuts: Cuts, draw: int) -> F64:
        """Sums over the free runs of a motion that begins at rest, if this draw is true; they add up over motions."""
        ...

    def score(self, sums: Sequence[F64]) -> float:
        """Of one sum for each draw."""
        ...


@dataclass(frozen=True)
class Precision:
    """How well parameters become known: D_s-optimality, mixed half and half with the weakest of them.

    Attributes:
        model: of which.
        noise: of the sensors.
        wanted: names of the parameters that matter.
    """

    model: Model
    noise: Noise
    wanted: tuple[str, ...]

    @property
    def truth(self) -> Model:
        return self.model

    def statistics(self, rows: F64, cuts: Cuts, draw: int) -> F64:
        q = self.model.coordinates(self.model.draws[draw])
        _, states = _run(self.model, q, rows, self.noise)
        parts = [fisher(self.model, q, states[a], rows[a:b], self.noise) for a, b in cuts]
        return np.asarray(np.sum(parts, axis=0))

    def score(self, sums: Sequence[F64]) -> float:
        chosen = [self.model.free.index(n) for n in self.wanted]
        total = 0.0
        for S in sums:
            C = np.linalg.inv(S + np.diag(self.model.prior))[np.ix_(chosen, chosen)]
            volume = 0.5 * np.linalg.slogdet(C)[1] / len(chosen)
            total -= 0.5 * (volume + 0.5 * np.log(np.max(np.diag(C))))
        return float(total / len(sums))

    def std(self, sums: Sequence[F64]) -> dict[str, float]:
        """1 σ of every free parameter in its coordinate (relative, for a logarithm), root mean square over the draws,
        with hardly anything known before."""
        weak = _REGULAR * np.diag(self.model.prior)
        variances = [np.diag(np.linalg.inv(S + weak)) for S in sums]
        std = np.sqrt(np.mean(variances, axis=0)) * self.model.units
        return dict(zip(self.model.free, std.tolist(), strict=True))


@dataclass(frozen=True)
class Separation:
    """How far `truth` stays from `other` when that is fitted to it: T-optimality, in each direction a question.

    A fit moves the other model as far as it can, and somewhere else for every motion. So a plan is judged by the
    nearest of all the places to which fits have led so far: what separates the models at one of them only is no plan.

    Attributes:
        truth, other: the models, of as many draws.
        noise: of the sensors.
        places: coordinates of `other`, shape (np,), for each draw, of each fit so far.
    """

    truth: Model
    other: Model
    noise: Noise
    places: tuple[tuple[F64, ...], ...]

    def statistics(self, rows: F64, cuts: Cuts, draw: int) -> F64:
        """Shape (places, k + 1, k + 1)."""
        q = self.truth.coordinates(self.truth.draws[draw])
        shown, states = _run(self.truth, q, rows, self.noise)
        return np.array([self._contrasts(place[draw], shown, states, rows, cuts) for place in self.places])

    def _contrasts(self, q: F64, shown: F64, states: F64, rows: F64, cuts: Cuts) -> F64:
        begun = _begun(self.truth, states, self.other, q, rows, self.noise)
        parts = [contrast(self.other, q, begun[a], rows[a:b], self.noise, shown[a:b]) for a, b in cuts]
        return np.asarray(np.sum(parts, axis=0))

    def score(self, sums: Sequence[F64]) -> float:
        return float(np.mean([np.log1p(self.distance(S)) for S in sums]))

    def distance(self, total: F64) -> float:
        """T of a sum; 0 where a model cannot be simulated."""
        if not np.isfinite(total).all():
            return 0.0
        return min(distance(S, _REGULAR * self.other.prior)[0] for S in total)

    def now(self, total: F64) -> float:
        """The distance as it is, without moving the other model any further, from the last place."""
        left = float(total[-1, -1, -1])
        return left if np.isfinite(left) else np.inf

    def stepped(self, sums: Sequence[F64]) -> Separation:
        """The last place one Gauss–Newton step nearer to the truth, the others forgotten."""
        fitted = []
        for q, S in zip(self.places[-1], sums, strict=True):
            step = distance(S[-1], self.other.prior)[1] if np.isfinite(S[-1]).all() else np.zeros(len(self.other.free))
            step = step / max(1.0, float(np.abs(step).max()) / _LONGEST_STEP)
            moved = q.copy()
            moved[self.other.columns] += step * self.other.units
            fitted.append(_within_bounds(self.other, moved))
        return replace(self, places=(tuple(fitted),))

    def last(self) -> Separation:
        """With the last place alone."""
        return replace(self, places=self.places[-1:])


def separation(truth: Model, other: Model, noise: Noise) -> Separation:
    """The question before anything was fitted: both models share what they have in common."""
    fitted = []
    for values in truth.draws:
        shared: Mapping[str, float] = {n: values.get(n, v) for n, v in other.draws[0].items()}
        fitted.append(other.coordinates(shared))
    return Separation(truth, other, noise, (tuple(fitted),))


def _run(model: Model, q: F64, rows: F64, noise: Noise) -> tuple[F64, F64]:
    """From rest: what is shown, shape (n, c), and the states, shape (n, nx)."""
    return free_run(model.plant, noise.channels, q, start_state(model), rows)


def _begun(truth: Model, states: F64, other: Model, q: F64, rows: F64, noise: Noise) -> F64:
    """States of the other model to begin free runs from, shape (n, nx): the truth's where it has them, else its own."""
    theirs, mine = truth.plant.state_names, other.plant.state_names
    own = np.zeros((len(rows), len(mine)))
    if set(mine) - set(theirs):
        own = _run(other, q, rows, noise)[1].copy()
    for k, name in enumerate(mine):
        if name in theirs:
            own[:, k] = states[:, theirs.index(name)]
    return own


def _within_bounds(model: Model, q: F64) -> F64:
    low = [np.log(p.lower) if p.transform == "log" else p.lower for p in model.plant.parameters]
    high = [np.log(p.upper) if p.transform == "log" else p.upper for p in model.plant.parameters]
    return np.clip(q, low, high)
