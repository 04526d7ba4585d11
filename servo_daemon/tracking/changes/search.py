"""Which parameter stepped, when and by how much.

A filter that has been sure of its parameters for long does not follow one of them that steps: it shares out what it
sees among all of them, and is sure of that as well. So the samples of the last seconds are kept. When they are no
longer as they should be, each parameter in turn is supposed to have stepped, alone, in each of some moments
(`jump_trials`). What is likeliest by far, and leaves innovations as the noise has them, has happened, and the filter
goes on from there: the other parameters have never been told anything else. Where something that has passed by, with no
parameter changed, is as likely, none has.
"""

from __future__ import annotations

import math
from collections.abc import Generator
from dataclasses import dataclass, replace

import numpy as np

from servo_daemon.kalman.ekf import Ekf
from servo_daemon.samples import F64
from servo_daemon.tracking.changes.trials import ALL, MOMENT, Section, Trial, Trials, sections_of
from servo_daemon.tracking.noise.watch import InnovationWatch, WatchMark
from servo_daemon.tracking.plan.parameter_masks import ParameterMasks
from servo_daemon.tracking.samples.filtering import MOST_SAMPLES, STEPS_A_TICK, Filtering, Forget
from servo_daemon.tracking.validity.validity_gate import ValidityGate

#: In a tick at most so many steps of the filter go over samples again, half of what a re-linearisation
#: takes (`restart/relinearisation`), which it may meet; the rest of a look in the next ones.
_STEPS_A_TICK = STEPS_A_TICK // 2
#: A change that is seen as one came at most so many ticks before; one that only shows in where the filter has gone
#: (decision 41).
_BACK_SUDDEN, _BACK_SLOW = 10, 30
#: So many ticks are kept, and no more than `MOST_SAMPLES`.
_TICKS = _BACK_SLOW + 1
#: First it is looked for so many ticks before it was seen, and then around where it is likeliest (free: every second of
#: them; all from 0 to 30 change one answer of `tests.identity`, by less than 0.01 σ).
_COARSE = (0, 2, 5, 10, 20, 30)
#: In the tick in which it was seen and the one before it is looked for in so many parts of them (2 .. 10 change one
#: answer of `tests.identity`, by less than 0.01 σ).
_PARTS = 5
#: It is looked for at these ticks after it was seen; the last time is the last (decision 41: 255 of 280 steps are
#: named within 2 s).
_LOOKS = (3, 6, 10, 13, 16, 20, 25, 30)
#: Not accepted before so many ticks after it (with 20 three of three steps are named after 2 s or never; 5 names them,
#: too, tried on the same three).
_CONFIRM = 10
#: After one that was not found no other is looked for, ticks (free within 25 .. 100).
_REST = 50
#: Twice the logarithm of the likelihood ratio to no change, and to one that has only passed by; to the next likeliest
#: parameter; and what a change of all parameters may be likelier by, also as a share of the first: where one parameter
#: has stepped by a third, all of them together explain up to 1.3 % more of tens of thousands, because the others were
#: not exactly what they were taken for (4 of 20 steps of K and 4 of 10 of a load, `published` and `witness` of
#: `benchmarks.tracking`).
_CHANGED, _MARGIN, _OF_ALL, _OF_ALL_SHARE = 60.0, 20.0, 30.0, 0.05
#: A parameter has stepped by this many standard deviations of what was known of it before and after (see `make
#: calibrate`).
_STEPPED_STDS = 6.0
#: The filter's estimate has moved by more of its own standard deviations than its information allows, and by this share
#: of the scale (see `make calibrate`).
_MOVED_STDS, _MOVED_SHARE = 6.0, 0.01
#: Whether it has is asked every so many ticks (free within 2 .. 6, tried on three steps and eight starts).
_LOOKED_AT_EVERY = 3
#: Of a variance this much is believed to be no better known than that (free within 0.05 .. 0.2, tried likewise).
_CERTAIN = 0.1


@dataclass(frozen=True, slots=True)
class _Tick:
    """One that has passed: the filter's state at its begin, what it was told and what was known of the noise then, its
    samples, when it ended."""

    state: F64
    constants: F64
    noise: WatchMark
    pieces: tuple[Forget | F64, ...]
    samples: int
    end_s: float


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
    """Searches the last ticks of one filter for a step of a parameter, a part of the search a tick.

    Attributes:
        promising: a change has been found that explains the samples, and is not certain yet; or nothing is known yet of
            what was seen.
    """

    def __init__(
        self, masks: ParameterMasks, ekf: Ekf, filtering: Filtering, validity: ValidityGate, watch: InnovationWatch
    ) -> None:
        self._masks, self._ekf, self._filtering = masks, ekf, filtering
        self._validity, self._watch = validity, watch
        self.clear()

    @property
    def running(self) -> bool:
        """Whether a change is being searched for."""
        return self._trials is not None

    def clear(self) -> None:
        """Forget what was kept: it is of another filter."""
        self._filtering.take_passed()
        self._count = self._looked_at = 0
        self._keep([])
        self._begins: tuple[F64, F64, WatchMark] | None = None
        self._rest = 0
        self._end()

    def _end(self) -> None:
        self.promising = False
        self._age = 0
        self._trials: Trials | None = None
        self._new: list[Section] = []  # not filtered yet
        self._best: dict[int, Trial] = {}
        self._due = False
        self._work: Generator[int, None, tuple[Found | None, bool]] | None = None  # what is left of a look

    def _keep(self, ticks: list[_Tick]) -> None:
        """Of those that were kept these, and how many samples they have."""
        self._ticks, self._samples = ticks, sum([t.samples for t in ticks])

    def mark(self) -> None:
        """Keep the filter's state at the beginning of a tick."""
        self._begins = self._ekf.snapshot(), self._ekf.constants, self._watch.mark()

    def take(self, end_s: float) -> None:
        """Take the samples of a tick that has ended.

        Args:
            end_s: of device time.
        """
        pieces = self._filtering.take_passed()
        if self._begins is None:
            return
        self._count += 1
        samples = sum([0 if isinstance(p, Forget) else len(p) for p in pieces])
        self._samples += samples
        self._ticks.append(_Tick(*self._begins, tuple(pieces), samples, end_s))
        if not self.running:
            while len(self._ticks) > _TICKS or self._samples > MOST_SAMPLES:
                self._samples -= self._ticks.pop(0).samples

    def look(self, unexplained: bool, may_begin: bool) -> Found | None:
        """Go on with the search after a tick.

        Args:
            unexplained: its innovations are beyond what the noise explains.
            may_begin: a change may be looked for at all.
        """
        looks = self._count // _LOOKED_AT_EVERY != self._looked_at
        self._looked_at = self._count // _LOOKED_AT_EVERY
        if self._trials is None:
            self._rest = max(self._rest - 1, 0)
            if not may_begin or self._rest or len(self._ticks) < 2:
                return None
            if not unexplained and not (looks and self._has_moved()):
                return None
            self._trials = self._begin(slow=not unexplained)
        else:
            self._new += sections_of(self._ticks[-1].pieces, len(self._ticks) - 1, 1, coarse=False)
        self._age += 1
        self._due |= self._age in _LOOKS
        if self._work is None:
            if not self._due:
                return None
            self._due, self._work = False, self._look(self._trials)
        return self._go_on(self._work)

    def _begin(self, *, slow: bool) -> Trials:
        self._end()
        self._keep(self._ticks[-(_BACK_SLOW if slow else _BACK_SUDDEN) - 1 :])
        last = len(self._ticks) - 1
        for number, tick in enumerate(self._ticks):
            fine = _PARTS if number >= last - 1 and not slow else 1
            self._new += sections_of(tick.pieces, number, fine, coarse=fine > 1 or (last - number) in _COARSE)
        self.promising, self._age = not slow, _CONFIRM - 1 if slow else 0
        begin = self._ticks[0]
        scales, whiteness = self._validity.excitation.scales, begin.noise.whiteness
        return Trials(self._masks, self._ekf, self._filtering, scales, begin.state, dict(whiteness), slow=slow)

    def _go_on(self, work: Generator[int, None, tuple[Found | None, bool]]) -> Found | None:
        """A tick's share of a look over the samples, and back to where the filter was."""
        before, done, steps = (self._ekf.snapshot(), self._ekf.constants), None, 0
        self._ekf.put_constants(self._ticks[0].constants)
        try:
            while steps < _STEPS_A_TICK:
                steps += next(work)
        except StopIteration as stopped:
            done = stopped.value
            if done[0] is not None:
                done = self._caught_up(done[0]), False
        self._ekf.restore(before[0])
        self._ekf.put_constants(before[1])
        return None if done is None else self._conclude(*done)

    def _caught_up(self, found: Found) -> Found:
        """With the samples that have come since the look began."""
        self._ekf.restore(found.state)
        for section in self._new:
            for piece in section.pieces:
                self._filtering.run(piece)
        return replace(found, state=self._ekf.snapshot())

    def _conclude(self, found: Found | None, passed_by: bool) -> Found | None:
        """What follows from a look."""
        self._work = None
        too_many = self._samples > MOST_SAMPLES
        if found is not None or passed_by:  # from here on another motor is seen, or the same one
            if found is not None:
                self._watch.back_to(self._ticks[0].noise)
            self._end()
            self._keep([])
        elif (self._age >= _LOOKS[-1] and not self._due) or too_many or self._is_hopeless():
            self._end()
            self._rest = _REST
        return found

    def _has_moved(self) -> bool:
        """Whether the filter has gone further than what it has learned allows: an estimate's change has the variance by
        which it has become better known, and what the process noise adds."""
        now, scales = self._ekf.coordinates, self._validity.excitation.scales
        var = np.square(self._ekf.coordinate_std)
        known = self._masks.published & self._validity.qualification.qualified
        walk = self._validity.walk(self._masks.free)
        for back in (_BACK_SUDDEN, _BACK_SLOW):
            if len(self._ticks) <= back:
                break
            then = self._ticks[-back]
            mean, before = self._ekf.moments_of(then.state)
            added = walk * (self._ticks[-1].end_s - then.end_s)
            allowed = np.maximum(before + added - var, 0.0) + _CERTAIN * before
            moved = np.abs(now - mean)
            if np.any(known & (moved > _MOVED_STDS * np.sqrt(allowed)) & (moved > _MOVED_SHARE * scales)):
                return True
        return False

    def _look(self, trials: Trials) -> Generator[int, None, tuple[Found | None, bool]]:
        """What has stepped, if it is certain; and whether something has only passed by."""
        new, self._new = self._new, []
        trials.extend(new)
        yield sum(section.samples for section in new)
        for k in (MOMENT, *map(int, np.flatnonzero(self._masks.free))):
            self._best[k] = yield from trials.likeliest(k, self._best.get(k))
        ranked = self._ranked()
        for trial in (self._best[MOMENT], *ranked[:2]):
            self._best[trial.k] = yield from trials.at_another_time(trial)
        ranked, moment = self._ranked(), self._best[MOMENT]
        best = ranked[0]
        if moment.explained and moment.cost - best.cost < _CHANGED:
            return None, True
        gained = min(trials.cost, moment.cost) - best.cost
        self.promising = best.explained and gained > _CHANGED and self._has_stepped(trials, best)
        after = trials.sections[-1].tick - trials.sections[best.section].tick
        if not self.promising or after < _CONFIRM or (len(ranked) > 1 and ranked[1].cost - best.cost < _MARGIN):
            return None, False
        of_all = yield from trials.run(ALL, best.section)
        if best.cost - of_all.cost > max(_OF_ALL, _OF_ALL_SHARE * gained):
            return None, False
        tick = trials.sections[best.section].tick
        mean, covariance = trials.known_before(best.section)
        return Found(best.k, self._ticks[max(tick - 1, 0)].end_s, mean, covariance, best.state), False

    def _is_hopeless(self) -> bool:
        """Whether no parameter is likelier to have stepped than something to have passed by, whatever that was."""
        return self._age >= _CONFIRM and self._best[MOMENT].cost - self._ranked()[0].cost < _CHANGED

    def _ranked(self) -> list[Trial]:
        """Of each parameter the likeliest change, the likeliest parameter first."""
        return sorted((t for t in self._best.values() if t.k >= 0), key=lambda t: t.cost)

    @staticmethod
    def _has_stepped(trials: Trials, best: Trial) -> bool:
        """Whether the parameter is another one than it was, and not only free to follow what has passed by."""
        mean, covariance = trials.known_before(best.section)
        moved = abs(best.coordinate - float(mean[best.k]))
        return moved > _STEPPED_STDS * math.sqrt(float(covariance[best.k, best.k]) + best.std**2)
