"""What the samples of the last seconds say of a supposed change: generalised likelihood ratios (Willsky & Jones, *IEEE
Trans. Autom. Control* 21, 1976).

The filter runs again from a saved state over the samples since, with one parameter unknown and the others as they
were; or with none unknown: a transient (a wrong sample, a knock) after which only the motion is unknown. Within the
section of the supposed change no parameter learns, and after it current, speed and angle are unknown: the change lies
somewhere in the section, and a change time that is a few samples off would otherwise bias the parameters (K by 1.5
standard deviations on average after a step of the load).
"""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass

import numpy as np

from servo_daemon.kalman.ekf import Ekf
from servo_daemon.kalman.measurement import GATE
from servo_daemon.kalman.records import ChannelStatistics
from servo_daemon.samples import F64
from servo_daemon.tracking.noise.levels import Whiteness
from servo_daemon.tracking.noise.watch import WHITE_OUT, judged
from servo_daemon.tracking.plan.parameter_masks import ParameterMasks
from servo_daemon.tracking.samples.filtering import SETTLED_SHARE, SETTLED_STDS, Filtering, Forget

#: In place of a parameter's number. MOMENT: a transient, no parameter has changed; ALL: every one may have changed.
MOMENT, ALL = -1, -2
#: 1 σ by which the parameter in question may have stepped, over its scale: a logarithm (free within 0.15 ..
#: 0.6, tried on three steps and eight starts), a signed parameter (free within 0.5 .. 2). All parameters at once: so
#: much of it (free within 0.2 .. 0.8).
_STEP_STD, _SIGNED_STEP_STD, _OF_ALL = 0.3, 1.0, 0.4
#: Other change times are tried so far from the likeliest one, sections.
_STEPS = (4, 2, 1)
#: Passes at most until the value has settled (free within 2 .. 8).
_PASSES = 4
#: The innovations since are as expected while their mean ν²/s is below this many times its usual value, and their
#: correlation below so many of its standard deviations (see `make calibrate`).
_NIS_MORE, _CHANCE = 3.0, 4.0


@dataclass(frozen=True, slots=True)
class Section:
    """Samples in a row as the filter takes them, within a tick.

    Attributes:
        tick: its number among those that are examined.
        coarse: of the coarse grid, which is searched first.
    """

    pieces: tuple[Forget | F64, ...]
    tick: int
    coarse: bool

    @property
    def samples(self) -> int:
        """How many samples it has."""
        return sum(0 if isinstance(piece, Forget) else len(piece) for piece in self.pieces)


@dataclass(frozen=True, slots=True)
class Trial:
    """A supposed change and what the samples say of it.

    Attributes:
        k: the parameter's number, `MOMENT` or `ALL`.
        section: in which it has happened.
        cost: −2 log p of all samples.
        coordinate, std: of the parameter, with its 1 σ.
        state: the filter's at the end.
        explained: the innovations since agree with the noise levels.
    """

    k: int
    section: int
    cost: float
    coordinate: float
    std: float
    state: F64
    explained: bool


#: Yields after each run of the filter how many samples it took, so that the search can pause there.
Sliced = Generator[int, None, Trial]


@dataclass(frozen=True, slots=True)
class Unchanged:
    """The filter's state and −2 log p so far at a section's begin, without any change."""

    state: F64
    cost: float


class Trials:
    """Trials of changes over one stretch of samples, which may grow.

    Args:
        scales: one unit of each coordinate, shape (n,).
        state: the filter's at the begin.
        whiteness: of the innovations before, by channel.
        slow: a gradual change is looked for: costs are Σ ν²/s with the variances s of the filter without a change.
            Where s follows the parameter (another R passes more or less of the voltage's noise to the current), errors
            of the noise levels add up over seconds to more than a gradual change contributes.

    Attributes:
        sections: what has been filtered.
        cost: −2 log p of all samples without a change.
    """

    def __init__(
        self,
        masks: ParameterMasks,
        ekf: Ekf,
        filtering: Filtering,
        scales: F64,
        state: F64,
        whiteness: dict[str, Whiteness],
        *,
        slow: bool,
    ) -> None:
        self._ekf, self._filtering, self._whiteness, self._slow = ekf, filtering, whiteness, slow
        self._scales, self._logarithmic = scales, masks.logarithmic
        self._step_std: F64 = np.where(self._logarithmic, _STEP_STD, _SIGNED_STEP_STD) * scales
        self._all_var: F64 = np.where(masks.free, np.square(_OF_ALL * self._step_std), 0.0)
        self.sections: list[Section] = []
        self._unchanged = [Unchanged(state, 0.0)]
        self._var: list[list[F64]] = []

    @property
    def cost(self) -> float:
        return self._unchanged[-1].cost

    def extend(self, sections: Sequence[Section]) -> None:
        """Filter more samples without a change."""
        self._ekf.restore(self._unchanged[-1].state)
        for section in sections:
            self.sections.append(section)
            cost = self.cost + self._over(len(self.sections) - 1)
            self._unchanged.append(Unchanged(self._ekf.snapshot(), cost))

    def known_before(self, section: int) -> tuple[F64, F64]:
        """The parameters' coordinates and covariance at a section's begin."""
        return self._ekf.parameters_of(self._unchanged[section].state)

    def likeliest(self, k: int, known: Trial | None) -> Sliced:
        """The likeliest change of parameter k: from the trial that is known, else over the whole coarse grid."""
        if known is not None:
            return (yield from self.settled(known))
        trials = []
        for number, section in enumerate(self.sections):
            if section.coarse:
                trials.append((yield from self.run(k, number, self._coordinate_before(k, number))))
        return (yield from self.settled(min(trials, key=lambda t: t.cost)))

    def settled(self, trial: Trial) -> Sliced:
        """Run again from the value that was found until it no longer moves (iterated filter)."""
        best = trial
        for _ in range(_PASSES):
            again = yield from self.run(trial.k, trial.section, trial.coordinate)
            if not np.isfinite(again.cost):
                break
            moved, trial = abs(again.coordinate - trial.coordinate), again
            if trial.k < 0 or moved < SETTLED_STDS * again.std + SETTLED_SHARE * self._scales[trial.k]:
                return again
            best = min(best, again, key=lambda t: t.cost)
        return best

    def at_another_time(self, trial: Trial) -> Sliced:
        """The same change at a neighbouring time, if that is likelier: a search by smaller and smaller steps."""
        best = trial
        for step in _STEPS:
            for number in (best.section - step, best.section + step):
                if 0 <= number < len(self.sections):
                    other = yield from self.run(trial.k, number, best.coordinate)
                    best = min(best, other, key=lambda t: t.cost)
        return trial if best is trial else (yield from self.settled(best))

    def run(self, k: int, number: int, coordinate: float = 0.0) -> Sliced:
        """A change in section `number`: of parameter k to about this coordinate, of none (`MOMENT`), or of `ALL`."""
        self._ekf.restore(self._unchanged[number].state)
        if k >= 0:
            self._ekf.put_coordinate(k, coordinate)
        cost = self._unchanged[number].cost + self._untaught(number)
        if k != MOMENT:
            self._ekf.widen_parameters(self._opened(k))
        more, explained = self._after(number)
        found, std = (self._ekf.coordinates, self._ekf.coordinate_std) if k >= 0 else (np.zeros(1), np.zeros(1))
        cost = cost + more if self._ekf.is_plausible() else np.inf
        at = max(k, 0)
        trial = Trial(k, number, cost, float(found[at]), float(std[at]), self._ekf.snapshot(), explained)
        yield sum(section.samples for section in self.sections[number:])
        return trial

    def _opened(self, k: int) -> F64:
        if k == ALL:
            return self._all_var
        var = np.zeros(len(self._step_std))
        var[k] = self._step_std[k] ** 2
        return var

    def _coordinate_before(self, k: int, number: int) -> float:
        return float(self.known_before(number)[0][k]) if k >= 0 else 0.0

    def _untaught(self, number: int) -> float:
        """The cost of a section in which no parameter learns, and after which the motion is unknown."""
        constants = self._ekf.constants
        self._ekf.hold()
        cost = self._over(number)
        self._ekf.put_constants(constants)
        self._ekf.forget_motion(self._ekf.x)
        return cost

    def _after(self, number: int) -> tuple[float, bool]:
        """The cost of the sections after this one, and whether their innovations agree with the noise levels."""
        self._ekf.take_statistics()
        begins = tick = self.sections[number].tick
        cost, explained = 0.0, True
        pooled: dict[str, ChannelStatistics] = {}
        for at in range(number + 1, len(self.sections) + 1):
            section = self.sections[at] if at < len(self.sections) else None
            if section is None or section.tick != tick:
                statistics = self._ekf.take_statistics()
                if tick > begins:
                    explained &= not judged(statistics).unexplained
                    pooled = {c: s.joined(pooled[c]) if c in pooled else s for c, s in statistics.items()}
            if section is not None:
                tick = section.tick
                cost += self._over(at)
        return cost, explained and bool(pooled) and all(self._as_usual(c, s) for c, s in pooled.items())

    def _as_usual(self, channel: str, s: ChannelStatistics) -> bool:
        """Innovations that are larger but white still agree: a drive's noise may grow with its current."""
        usual = self._whiteness.get(channel)
        nis = max(1.0, usual.nis if usual is not None else 1.0) * _NIS_MORE
        return s.count < 1 or (s.nis < nis and s.correlation < max(WHITE_OUT, _CHANCE / math.sqrt(s.count)))

    def _over(self, number: int) -> float:
        """The cost of a section's samples: −2 log p; with `slow` see there."""
        first = self._slow and number == len(self._var)
        if first:
            self._var.append([])
        cost, var = 0.0, iter(self._var[number] if self._slow else ())
        for piece in self.sections[number].pieces:
            innovations = self._filtering.run(piece)
            if innovations is None:
                continue
            if first:
                self._var[number].append(innovations.variance)
            s = innovations.variance if first or not self._slow else next(var)
            cost += float(np.sum(np.minimum(np.square(innovations.innovation) / s, GATE**2)))
            if not self._slow:
                cost += float(np.sum(np.log(s)))
        return cost


def sections_of(passed: Sequence[Forget | F64], number: int, parts: int, *, coarse: bool) -> list[Section]:
    """A tick's samples in as few pieces as can be, or in some parts of equal length.

    Args:
        passed: what the filter took in it.
        number: the tick's.
    """
    pieces: list[Forget | F64] = []
    run: list[F64] = []
    for piece in passed:
        if isinstance(piece, Forget):
            pieces += [*_joined(run), piece]
            run = []
        else:
            run.append(piece)
    pieces += _joined(run)
    if parts > 1 and len(pieces) == 1 and not isinstance(pieces[0], Forget) and len(pieces[0]) >= parts:
        return [Section((part,), number, coarse) for part in np.array_split(pieces[0], parts)]
    return [Section(tuple(pieces), number, coarse)]


def _joined(run: Sequence[F64]) -> list[F64]:
    return [np.concatenate(run)] if run else []
