"""Which parameter stepped, when and by how much: generalised likelihood ratios over the last seconds (Willsky & Jones,
*IEEE Trans. Autom. Control* 21, 1976).

A filter that has been sure of its parameters for long does not follow one of them that steps: it shares out what it sees
among all of them, and is sure of that as well. So the samples of the last seconds are kept. When they are no longer as
they should be, each parameter in turn is supposed to have stepped, alone, at each of some moments: from what the filter
knew at that moment it runs over the samples since with that one parameter unknown and all others as they were. What is
likeliest by far, and leaves innovations as the noise has them, has happened, and the filter goes on from there: the other
parameters have never been told anything else.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servo_daemon.estimators.ekf import Ekf
from servo_daemon.estimators.ekf_records import ChannelStatistics
from servo_daemon.estimators.filtering import Filtering, Forget
from servo_daemon.estimators.parameter_judge import ParameterJudge
from servo_daemon.estimators.roster import Roster
from servo_daemon.estimators.watch import InnovationWatch, WatchMark, judged
from servo_daemon.samples import F64

#: So many ticks are kept, and no more samples than these.
_TICKS, _SAMPLES = 31, 20_000
#: A change that is seen as one came at most so many ticks before; one that only shows in where the filter has gone.
_BACK_SUDDEN, _BACK_SLOW = 10, 30
#: First it is looked for so many ticks before it was seen, and then around where it is likeliest by these steps.
_COARSE, _STEPS = (0, 2, 5, 10, 20, 30), (4, 2, 1)
#: In the tick in which it was seen and the one before it is looked for in so many parts of them.
_PARTS = 5
#: It is looked for at these ticks after it was seen; the last time is the last.
_LOOKS = (3, 6, 10, 13, 16, 20, 25, 30)
#: Not accepted before so many ticks after it.
_CONFIRM = 10
#: After one that was not found no other is looked for, ticks.
_REST = 50
#: 1 σ by which the parameter in question may have stepped, over its scale: a logarithm, a signed parameter.
_STEP_STD, _SIGNED_STEP_STD = 0.3, 1.0
#: Twice the logarithm of the likelihood ratio to no change; to the next likeliest parameter; and what a change of all
#: parameters may be likelier by.
_CHANGED, _MARGIN, _OF_ALL = 60.0, 20.0, 30.0
#: Passes until none moves the value by more than this (standard deviations, share of the scale).
_PASSES, _SETTLED_STDS, _SETTLED_SHARE = 4, 0.5, 0.01
#: The filter's estimate has moved by more of its own standard deviations than its information allows, and by this share
#: of the scale.
_MOVED_STDS, _MOVED_SHARE = 6.0, 0.01
#: Of a variance this much is believed to be no better known than that.
_CERTAIN = 0.1
#: Innovations over all ticks since are white below this correlation, and below this mean of ν²/s over what it usually is;
#: standard deviations that chance may make.
_WHITE, _NIS_MORE, _CHANCE = 0.25, 3.0, 4.0
#: All parameters at once, 1 σ over the scale.
_ALL_STD = 0.13
#: ν²/s at which an outlier counts.
_OUTLIER_SQUARE = 25.0

_ALL = -1


@dataclass(frozen=True, slots=True)
class _Section:
    """Samples in a row as the filter takes them, within a tick.

    Attributes:
        tick: its number among those that are examined.
        coarse: a change is looked for at its begin first.
    """

    pieces: tuple[Forget | F64, ...]
    tick: int
    coarse: bool


@dataclass(frozen=True, slots=True)
class _Tick:
    """One that has passed: the filter's state at its begin, what it was told and what was known of the noise then, its
    samples, when it ended."""

    state: F64
    constants: F64
    noise: WatchMark
    pieces: tuple[Forget | F64, ...]
    end_s: float

    @property
    def samples(self) -> int:
        return sum(0 if isinstance(p, Forget) else len(p) for p in self.pieces)


@dataclass(frozen=True, slots=True)
class _Trial:
    """A supposed change and what the samples say of it: −2 log p of all of them, the parameter's coordinate and its
    1 σ, the filter's state at the end, and whether the innovations after it are as the noise has them."""

    k: int
    section: int
    cost: float
    coordinate: float
    std: float
    state: F64
    explained: bool


@dataclass(frozen=True, slots=True)
class Found:
    """A parameter that has stepped.

    Attributes:
        k: its number.
        before_s: the last moment at which all was as before, s of device time.
        mean, covariance: what was known then, (n,) and (n, n).
        state: the filter's now.
    """

    k: int
    before_s: float
    mean: F64
    covariance: F64
    state: F64


class JumpSearch:
    """One drive's.

    Attributes:
        running: a change is being looked for.
        promising: one has been found that explains the samples, and is not certain yet; or nothing is known yet of what
            was seen.
    """

    def __init__(
        self, roster: Roster, ekf: Ekf, filtering: Filtering, judge: ParameterJudge, watch: InnovationWatch
    ) -> None:
        self._roster, self._ekf, self._filtering = roster, ekf, filtering
        self._judge, self._watch = judge, watch
        self.clear()

    def clear(self) -> None:
        """What was kept is of another filter."""
        self._ticks: list[_Tick] = []
        self._begins: tuple[F64, F64, WatchMark] | None = None
        self._rest = 0
        self._end()

    def _end(self) -> None:
        self.running = self.promising = False
        self._slow, self._age = False, 0
        self._sections: list[_Section] = []
        self._best: dict[int, _Trial] = {}
        self._var: list[list[F64]] = []

    def mark(self) -> None:
        """A tick begins, and the filter is as it is."""
        self._begins = self._ekf.snapshot(), self._ekf.constants, self._watch.mark()

    def take(self, end_s: float) -> None:
        """A tick has ended.

        Args:
            end_s: of device time.
        """
        pieces = self._filtering.take_passed()
        if self._begins is None:
            return
        self._ticks.append(_Tick(*self._begins, tuple(pieces), end_s))
        if not self.running:
            while len(self._ticks) > _TICKS or sum(t.samples for t in self._ticks) > _SAMPLES:
                del self._ticks[0]

    def look(self, unexplained: bool, may_begin: bool) -> Found | None:
        """After each tick.

        Args:
            unexplained: its innovations are beyond what the noise explains.
            may_begin: a change may be looked for at all.
        """
        if not self.running:
            self._rest = max(self._rest - 1, 0)
            if not may_begin or self._rest or len(self._ticks) < 2:
                return None
            if unexplained:
                self._begin(_BACK_SUDDEN, _PARTS)
            elif self._has_moved():
                self._begin(_BACK_SLOW, 1)
                self._slow, self._age = True, _CONFIRM - 1
            else:
                return None
            self.promising = unexplained
        else:
            self._sections += _sections(self._ticks[-1], self._sections[-1].tick + 1, 1, coarse=False)
        self._age += 1
        if self._age not in _LOOKS:
            return None
        before = self._ekf.snapshot(), self._ekf.constants
        self._ekf.put_constants(self._ticks[0].constants)
        found = self._examine()
        self._ekf.restore(before[0])
        self._ekf.put_constants(before[1])
        too_many = sum(t.samples for t in self._ticks) > _SAMPLES
        if found is not None or self._age == _LOOKS[-1] or too_many:
            self._end()
            self._rest = _REST
            if found is not None:  # from here on another motor is seen
                self._watch.back_to(self._ticks[0].noise)
                self._ticks, self._rest = [], 0
        return found

    def _begin(self, back: int, parts: int) -> None:
        self._end()
        self._ticks = self._ticks[-back - 1 :]
        last = len(self._ticks) - 1
        for number, tick in enumerate(self._ticks):
            fine = parts if number >= last - 1 else 1
            coarse = fine > 1 or (last - number) in _COARSE
            self._sections += _sections(tick, number, fine, coarse)
        self.running = bool(self._sections)

    def _has_moved(self) -> bool:
        """Whether the filter has gone further than what it has learned allows: an estimate's change has the variance by
        which it has become better known, and what the process noise adds."""
        now, scales = self._ekf.coordinates, self._judge.excitation.scales
        var = np.square(self._ekf.coordinate_std)
        known = self._roster.published & self._judge.qualification.qualified
        walk = self._judge.walk(self._roster.free)
        for back in (_BACK_SUDDEN, _BACK_SLOW):
            if len(self._ticks) <= back:
                break
            then = self._ticks[-back]
            mean, covariance = self._ekf.parameters_of(then.state)
            before = covariance.diagonal()
            added = walk * (self._ticks[-1].end_s - then.end_s)
            allowed = np.maximum(before + added - var, 0.0) + _CERTAIN * before
            moved = np.abs(now - mean)
            if np.any(known & (moved > _MOVED_STDS * np.sqrt(allowed)) & (moved > _MOVED_SHARE * scales)):
                return True
        return False

    # -- over the samples ------------------------------------------------------------------------------------

    def _examine(self) -> Found | None:
        nulls, null_cost = self._without_change()
        free = [int(k) for k in np.flatnonzero(self._roster.free)]
        for k in free:
            self._best[k] = self._improved(k, nulls)
        ranked = sorted(self._best.values(), key=lambda t: t.cost)
        for trial in ranked[:2]:
            self._best[trial.k] = self._elsewhere(trial, nulls)
        ranked = sorted(self._best.values(), key=lambda t: t.cost)
        best = ranked[0]
        self.promising = best.explained and null_cost - best.cost > _CHANGED
        after = self._sections[-1].tick - self._sections[best.section].tick
        if not self.promising or after < _CONFIRM or (len(ranked) > 1 and ranked[1].cost - best.cost < _MARGIN):
            return None
        everything = self._run(_ALL, best.section, 0.0, nulls)
        if best.cost - everything.cost > _OF_ALL:
            return None
        tick = self._sections[best.section].tick
        mean, covariance = self._ekf.parameters_of(nulls[best.section][0])
        before_s = self._ticks[tick - 1].end_s if tick > 0 else self._ticks[0].end_s
        return Found(best.k, before_s, mean, covariance, best.state)

    def _without_change(self) -> tuple[dict[int, tuple[F64, float]], float]:
        """The filter's state and −2 log p so far at each section's begin, and −2 log p of all."""
        self._ekf.restore(self._ticks[0].state)
        nulls: dict[int, tuple[F64, float]] = {}
        cost = 0.0
        self._var = []
        for number, section in enumerate(self._sections):
            nulls[number] = self._ekf.snapshot(), cost
            cost += self._over(number)
        return nulls, cost

    def _improved(self, k: int, nulls: dict[int, tuple[F64, float]]) -> _Trial:
        """The likeliest change of parameter k: where it was likeliest the last time, or looked for everywhere."""
        known = self._best.get(k)
        if known is None:
            coarse = [number for number, section in enumerate(self._sections) if section.coarse]
            trials = [self._run(k, number, self._coordinate(k, nulls[number][0]), nulls) for number in coarse]
            known = min(trials, key=lambda t: t.cost)
        return self._settled(known, nulls)

    def _settled(self, trial: _Trial, nulls: dict[int, tuple[F64, float]]) -> _Trial:
        """Begun again at the value that was found, until that is where it ends."""
        scale = self._judge.excitation.scales[trial.k]
        best = trial
        for _ in range(_PASSES):
            again = self._run(trial.k, trial.section, trial.coordinate, nulls)
            moved = abs(again.coordinate - trial.coordinate)
            if not np.isfinite(again.cost):
                break
            trial = again
            if moved < _SETTLED_STDS * again.std + _SETTLED_SHARE * scale:
                return again
            best = min(best, again, key=lambda t: t.cost)
        return best

    def _elsewhere(self, trial: _Trial, nulls: dict[int, tuple[F64, float]]) -> _Trial:
        """The same change at another moment, if it is likelier then: by smaller and smaller steps."""
        best = trial
        for step in _STEPS:
            for number in (best.section - step, best.section + step):
                if number in nulls:
                    best = min(best, self._run(trial.k, number, best.coordinate, nulls), key=lambda t: t.cost)
        return trial if best is trial else self._settled(best, nulls)

    def _run(self, k: int, number: int, coordinate: float, nulls: dict[int, tuple[F64, float]]) -> _Trial:
        """From a section on with parameter k (or all) unknown."""
        state, cost = nulls[number]
        self._ekf.restore(state)
        step_std = np.where(self._roster.logarithmic, _STEP_STD, _SIGNED_STEP_STD) * self._judge.excitation.scales
        if k == _ALL:
            self._ekf.widen_parameters(np.where(self._roster.free, np.square(_ALL_STD / _STEP_STD * step_std), 0.0))
        else:
            self._ekf.open_parameter(k, coordinate, float(step_std[k]) ** 2)
        self._ekf.take_statistics()
        begins, tick = self._sections[number].tick, self._sections[number].tick
        explained = True
        pooled: dict[str, ChannelStatistics] = {}
        for at in range(number, len(self._sections) + 1):
            section = self._sections[at] if at < len(self._sections) else None
            if section is None or section.tick != tick:
                statistics = self._ekf.take_statistics()
                if tick > begins:
                    explained &= not judged(statistics).unexplained
                    pooled = {c: s.joined(pooled[c]) if c in pooled else s for c, s in statistics.items()}
            if section is not None:
                tick = section.tick
                cost += self._over(at)
        explained &= bool(pooled) and all(self._as_usual(c, s) for c, s in pooled.items())
        cost = cost if self._ekf.is_plausible() else np.inf
        found, std = self._ekf.coordinates, self._ekf.coordinate_std
        return _Trial(k, number, cost, float(found[k]), float(std[k]), self._ekf.snapshot(), explained)

    def _as_usual(self, channel: str, s: ChannelStatistics) -> bool:
        """Larger innovations that are white are noise that has grown, as that of a drive does with its current."""
        usual = self._ticks[0].noise.whiteness.get(channel)
        nis = max(1.0, usual.nis if usual is not None else 1.0) * _NIS_MORE
        return s.count < 1 or (s.nis < nis and s.correlation < max(_WHITE, _CHANCE / math.sqrt(s.count)))

    def _coordinate(self, k: int, state: F64) -> float:
        return float(self._ekf.parameters_of(state)[0][k])

    def _over(self, number: int) -> float:
        """What a section's samples cost.

        −2 log p, where something sudden was seen. Where nothing was, but the filter has gone on and on, Σ ν²/s with the
        variances s of the filter without a change: with an R that is another one there should be more noise of the
        voltage in the current or less, but whose that noise is the filter does not know for certain, and in seconds of
        samples that adds up to more than the slow change itself.
        """
        first = self._slow and number == len(self._var)
        if first:
            self._var.append([])
        cost, var = 0.0, iter(self._var[number] if self._slow else ())
        for piece in self._sections[number].pieces:
            innovations = self._filtering.run(piece)
            if innovations is None:
                continue
            if first:
                self._var[number].append(innovations.variance)
            s = innovations.variance if first or not self._slow else next(var)
            cost += float(np.sum(np.minimum(np.square(innovations.innovation) / s, _OUTLIER_SQUARE)))
            if not self._slow:
                cost += float(np.sum(np.log(s)))
        return cost


def _sections(tick: _Tick, number: int, parts: int, coarse: bool) -> list[_Section]:
    """A tick's samples in as few pieces as can be, or in some parts of equal length."""
    pieces: list[Forget | F64] = []
    run: list[F64] = []
    for piece in tick.pieces:
        if isinstance(piece, Forget):
            pieces += [*_joined(run), piece]
            run = []
        else:
            run.append(piece)
    pieces += _joined(run)
    if parts > 1 and len(pieces) == 1 and not isinstance(pieces[0], Forget) and len(pieces[0]) >= parts:
        return [_Section((part,), number, coarse) for part in np.array_split(pieces[0], parts)]
    return [_Section(tuple(pieces), number, coarse)]


def _joined(run: Sequence[F64]) -> list[F64]:
    return [np.concatenate(run)] if run else []
