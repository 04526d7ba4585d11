"""The filter's first seconds gone over again, where no saved state vouches for them.

An extended Kalman filter takes derivatives at the values it has at the time. Started by a factor beside the truth it
counts what it learns meanwhile as exactly as if they were right: its spread falls to a percent while the values are
still tens of percent off, and then it is slow to believe anything else. So it is begun again with the spread it had at
the start but at the values it has found, over the same samples, until a pass no longer moves them: Gauss–Newton on the
first seconds (the iterated filter-smoother of Jazwinski, *Stochastic Processes and Filtering Theory*, 1970, sec. 8.3,
with all of the samples in one iteration).

How large the noise is was a guess as well, and whose it is: each time that of the current's sensor and that of the
voltage are taken as the samples are likeliest with.

What the first samples did not show (an inertia on a motion that hardly accelerates) the filter meets at its guess later
on, and everything else pays for the leap that it makes then: whenever a guessed parameter has leapt, the samples since
the start are gone over once more.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass

import numpy as np

from servo_daemon.kalman.ekf import Ekf
from servo_daemon.kalman.gaussian import Gaussian
from servo_daemon.samples import F64
from servo_daemon.tracking.noise.setting import NoiseSetting
from servo_daemon.tracking.noise.watch import WHITE_IN, WatchMark
from servo_daemon.tracking.plan.roster import Mask, Roster
from servo_daemon.tracking.restart.simplex import SimplexSearch
from servo_daemon.tracking.samples.filtering import Filtering, Fit
from servo_daemon.tracking.start.starter import Start
from servo_daemon.tracking.validity.parameter_judge import ParameterJudge

#: Begun with a larger 1 σ than this a parameter's derivatives may be wrong.
_VAGUE_STD = 0.1
#: After so many ticks the first samples are gone over, and after the first when a parameter has moved by so much (a
#: share of one unit) from where the last time has left it; each time in at most so many passes.
_TICKS, _LEAP, _PASSES = (10, 40), 0.1, 8
#: After so many leaps the second time is waited for.
_MOST_LEAPS = 4
#: So often noise and values are found in turn, where values have leapt meanwhile.
_TURNS = 2
#: More samples than these are not gone over.
_MOST_SAMPLES = 20_000
#: In a tick at most so many steps of the filter go over samples again, which takes 50 ms of its 100; the rest of it in
#: the next ones. At 1 kHz the first time takes one tick, the second three.
STEPS_A_TICK = 60_000
#: A pass begins with no larger 1 σ: further off a logarithm's derivatives say nothing of where it would have to go.
_WIDEST_STD = 0.2
#: A pass along the instrument fits as well as one without it, if its cost is no larger than by this; by the second
#: where one has been no better before.
_AS_GOOD, _TRIED = 20.0, 3.0
#: A parameter of which the samples leave more than this share of it was not seen.
_UNSEEN_SHARE = 0.7
#: A pass that moves nothing by more than these, in standard deviations and as a share of one unit, was the last.
_SETTLED_STDS, _SETTLED_SHARE = 0.5, 0.01
#: Values that a pass moves by less than this are good enough for the instrument to follow.
_FOLLOWS_SHARE = 0.05
#: The search for the likeliest variances: first step and accuracy of their logarithms, of −2 log p, and passes.
_NOISE_STEP, _NOISE_EXACT, _NOISE_COST, _NOISE_PASSES = 1.5, 0.3, 3.0, 25
_LEAST_VAR = 1e-18
#: Of fewer samples the values, which are fitted as well, leave too little of the noise.
_FEWEST = 300
#: Innovations are explained below this mean of ν²/s.
_AS_EXPECTED = 1.3


@dataclass(frozen=True, slots=True)
class _Look:
    """What all passes of one time share.

    Attributes:
        start: of the filter.
        index: of the start's parameters among the filter's.
        vague: which of these are logarithms that were guessed.
        walk_var_per_s: process noise of each coordinate, 1/s.
        period_s: usual distance of two samples.
    """

    start: Gaussian
    index: list[int]
    vague: Mask
    walk_var_per_s: F64
    period_s: float


@dataclass(frozen=True, slots=True)
class _Filter:
    """Where filter and noise are."""

    state: F64
    constants: F64
    noise: WatchMark


@dataclass(slots=True)
class _UnderWay:
    """A look under way.

    Attributes:
        look: what its passes share.
        last: of the start's looks.
        doubt: 1 σ that the balances left open before, (n,).
        white: the innovations were when it began.
        passes: a tick's.
        work: what is left of it, a pass at a time.
        at: where it has left filter and noise.
    """

    look: _Look
    last: bool
    white: bool
    passes: int
    work: Generator[None, None, bool | None]
    at: _Filter
    doubt: F64


class SecondLook:
    """One drive's. What it takes is spread over as many ticks as it needs (`STEPS_A_TICK`), in which the filter goes on
    as it was; what is found is taken over with the samples that have come meanwhile.

    Attributes:
        pending: the filter started from no saved state, and its first samples have not been gone over yet.
    """

    def __init__(
        self,
        roster: Roster,
        ekf: Ekf,
        filtering: Filtering,
        judge: ParameterJudge,
        noise: NoiseSetting,
    ) -> None:
        self._roster, self._ekf, self._filtering = roster, ekf, filtering
        self._judge, self._noise = judge, noise
        self._start: Start | None = None
        self._left_at: F64 = np.zeros(0)  # coordinates, by the last time
        self._leaps = 0
        self._under_way: _UnderWay | None = None
        self._due = False
        self.pending = False

    @property
    def is_open(self) -> bool:
        """The first samples are yet to be gone over, or are so now."""
        return self.pending or self._under_way is not None

    def begin(self, start: Start, trusted: bool) -> None:
        """A filter starts.

        Args:
            trusted: from a saved state, or from another model's filter.
        """
        self._start, self.pending = None if trusted else start, not trusted
        self._leaps, self._under_way, self._due = 0, None, False
        self._filtering.keep(None if trusted else start.last)

    def look(self, tick: int, white: bool, period_s: float) -> bool:
        """Go over the first samples, if it is time to. Returns whether it is done: all that was said of the filter's
        values was of others.

        Args:
            tick: number of the running filter's.
            white: the innovations are. Where they are not, the start may have been a wrong one, or the samples hold
                what no values explain: then nothing is done.
            period_s: usual distance of two samples.
        """
        if self._start is None:
            return False
        self._due |= tick in _TICKS
        if self._under_way is None:
            if not self._due and not self._has_leapt(tick):
                return False
            self._leaps += not self._due
            self._due = False
            self._under_way = self._begun(self._start.parameters, tick, white, period_s)
        return self._go_on(self._under_way)

    def end(self) -> None:
        """The motor is another one than in its first samples."""
        self._start, self.pending = None, False
        self._under_way, self._due = None, False

    def _begun(self, start: Gaussian, tick: int, white: bool, period_s: float) -> _UnderWay:
        walk = self._judge.walk(self._roster.free)
        look = _Look(start, self._index(start), self._vague(start), walk, period_s)
        samples = self._filtering.kept
        usable = samples <= _MOST_SAMPLES
        if usable:
            self._filtering.begin_look()
        work = self._go_over(look, white) if usable else _nothing()
        passes = max(1, STEPS_A_TICK // max(samples, 1))
        doubt = self._judge.mismatch.std
        now = _UnderWay(look, tick >= _TICKS[-1], white and usable, passes, work, self._here(), doubt)
        if not self.pending:
            self._doubt_leaps(look)
        return now

    def _go_on(self, now: _UnderWay) -> bool:
        """A tick's share of the passes. Returns whether they are done, and the filter goes on from their result."""
        filter_ = self._here()
        self._put(now.at)
        try:
            for _ in range(now.passes):
                next(now.work)
        except StopIteration as done:
            return self._done(now, filter_, done.value)
        now.at = self._here()
        self._put(filter_)
        return False

    def _done(self, now: _UnderWay, filter_: _Filter, follows: bool | None) -> bool:
        """
        Args:
            filter_: as it was meanwhile.
            follows: as `_go_over` returns it.
        """
        first, self.pending, self._under_way = self.pending, False, None
        noise = self._noise.of_current
        if follows is None:
            self._put(filter_)
        else:
            self._allow(now.look, follows)
            self._filtering.catch_up()
            self._noise.watch_back_to(filter_.noise)
        if noise is not None and (follows is not None or now.white):
            self._noise.put_of_current(*noise)
        if follows is not None:
            self._widen(now.look)
            if not first:
                moved = np.abs(self._ekf.coordinates - self._ekf.parameters_of(filter_.state)[0])
                self._judge.doubt(np.maximum(now.doubt, moved))
        elif not first:
            self._judge.doubt(now.doubt)
        self._left_at = self._ekf.coordinates.copy()
        if now.last:
            self._start = None
        if follows is None:
            return False
        self._ekf.take_statistics()
        self._judge.begin_anew(follows)
        return True

    def _here(self) -> _Filter:
        return _Filter(self._ekf.snapshot(), self._ekf.constants, self._noise.mark())

    def _put(self, there: _Filter) -> None:
        self._ekf.restore(there.state)
        self._ekf.put_constants(there.constants)
        self._noise.watch_back_to(there.noise)

    def _has_leapt(self, tick: int) -> bool:
        """Whether a guessed parameter that the filter has seen is elsewhere than the derivatives were taken at."""
        if self._start is None or tick < _TICKS[0] or self._leaps == _MOST_LEAPS:
            return False
        start = self._start.parameters
        index = np.array(self._index(start))[self._vague(start)]
        leapt = (np.abs(self._ekf.coordinates - self._left_at) > _LEAP) & (self._ekf.coordinate_std < _VAGUE_STD)
        return bool(leapt[index].any())

    def _go_over(self, look: _Look, white: bool) -> Generator[None, None, bool | None]:
        """Pass over the samples since the start, and stop after every pass. Returns whether the last pass used the
        instrument; None: with the best values there are still samples that do not fit, so that these are no samples to
        begin from, and nothing is done.

        Args:
            white: as for `look`.
        """
        if not white:  # noise as found at values that explain nothing would be large enough to explain anything
            yield from self._iterate(look, guessed=True)
        outliers, follows = 0, False
        for turn in range(_TURNS):
            at = self._ekf.coordinates
            yield from self._learn_noise(look)
            outliers, follows = yield from self._iterate(look, guessed=white and turn == 0)
            if (np.abs(self._ekf.coordinates - at)[self._roster.published] < _LEAP).all():
                break
        return None if outliers > 0 or not (white or self._is_white()) else follows

    def _is_white(self) -> bool:
        """Whether the last pass left white innovations."""
        channels = self._ekf.take_statistics().values()
        return all(abs(c.correlation) < WHITE_IN and c.nis < _AS_EXPECTED for c in channels)

    def _iterate(self, look: _Look, *, guessed: bool) -> Generator[None, None, tuple[int, bool]]:
        """Passes until none moves the values any more. Returns how many outliers the best has left, and whether it was
        along the instrument.

        Args:
            guessed: the first begins where the filter did.
        """
        published = self._roster.published
        best, best_fit, follows, best_follows = self._ekf.snapshot(), Fit(np.inf), False, False
        for first in (guessed, *[False] * _PASSES):
            found = self._ekf.coordinates
            fit = self._pass_over(look, follows, first)
            yield
            moved = np.abs(self._ekf.coordinates - found)[published]
            better = self._ekf.is_plausible() and fit.cost < best_fit.cost
            if better:
                best, best_fit, best_follows = self._ekf.snapshot(), fit, follows
            allowed = self._allowed()[published]
            if not first and ((follows and (moved < allowed).all()) or not better):
                break
            self._ekf.restore(best)
            follows = bool((moved < allowed + _FOLLOWS_SHARE).all())
        self._ekf.restore(best)
        if not best_follows and best_fit.outliers == 0:
            # Along its own states a filter learns from the colour of its noise, and fits a little better by it.
            best_follows = yield from self._follow(look, best_fit.cost + (_TRIED if follows else _AS_GOOD))
        return best_fit.outliers, best_follows

    def _follow(self, look: _Look, limit: float) -> Generator[None, None, bool]:
        """Passes along the instrument until none moves the values any more. Returns whether they fit, to this cost; the
        values are those of the last that does."""
        best, fits = self._ekf.snapshot(), False
        for _ in range(_PASSES):
            found = self._ekf.coordinates
            fit = self._pass_over(look, follows=True, guessed=False)
            yield
            if not self._ekf.is_plausible() or fit.outliers > 0 or fit.cost > limit:
                break
            best, fits = self._ekf.snapshot(), True
            if (np.abs(self._ekf.coordinates - found) < self._allowed())[self._roster.published].all():
                break
        self._ekf.restore(best)
        return fits

    def _allowed(self) -> F64:
        """By how much the last pass may move each coordinate, shape (n,)."""
        return _SETTLED_STDS * self._ekf.coordinate_std + _SETTLED_SHARE

    def _learn_noise(self, look: _Look) -> Iterator[None]:
        """Noise of the current's sensor and of the voltage as the samples are likeliest with, at the values that were
        found. Where the winding is faster than the sampling both are white in the current, and only the one moves the
        shaft: likelihood knows (by 280 of −2 log p within 1.5 s of an RE 40), correlations of innovations learn it
        within a minute."""
        guess = self._noise.of_current
        if guess is None or self._filtering.kept < _FEWEST:
            return
        found = self._ekf.snapshot()

        def cost(log_var: F64) -> float:
            self._ekf.restore(found)
            self._noise.put_of_current(*np.exp(log_var).tolist())
            return self._pass_over(look, follows=False, guessed=False).cost

        at = np.log(np.maximum(guess, _LEAST_VAR))
        simplex = at + np.array([[0.0, 0.0], [_NOISE_STEP, 0.0], [0.0, -_NOISE_STEP]])
        likeliest = SimplexSearch(cost, simplex, exact=_NOISE_EXACT, cost_exact=_NOISE_COST, most=_NOISE_PASSES)
        yield from likeliest.steps()
        self._noise.put_of_current(*np.exp(likeliest.best).tolist())
        self._ekf.restore(found)

    def _pass_over(self, look: _Look, follows: bool, guessed: bool) -> Fit:
        """Once, with the spread of the start.

        Args:
            follows: along the instrument.
            guessed: from where the filter started, and not from what it has found.
        """
        found, start = self._ekf.coordinates, look.start
        free = self._allow(look, follows)
        begins = np.where(look.vague & ~(free[look.index] & guessed), found[look.index], start.mean)
        spread = np.diag(np.minimum(start.std, _WIDEST_STD) ** 2)
        return self._filtering.again(Gaussian(start.names, begins, spread))

    def _allow(self, look: _Look, follows: bool) -> Mask:
        """Tell the filter what it may estimate, with the instrument or without; shape (n,)."""
        roster = self._roster
        free = roster.free if follows else roster.free_without_instrument(self._ekf.coordinates, look.period_s)
        self._ekf.use_instrument(follows)
        self._ekf.set_active(free, look.walk_var_per_s)
        return free

    def _doubt_leaps(self, look: _Look) -> None:
        """Until the samples have been gone over, and if they cannot be: what has leapt has leapt along derivatives that
        were taken elsewhere, and is known no better than by as much. Until then everything else pays for it."""
        leap = np.minimum(np.abs(self._ekf.coordinates - self._left_at), _WIDEST_STD)
        vague = np.zeros(len(leap), dtype=bool)
        vague[look.index] = look.vague
        leap = np.where(vague & (leap > _LEAP), leap, 0.0)
        self._ekf.widen_parameters(np.square(leap))
        if leap.any():
            self._judge.doubt(np.maximum(self._judge.mismatch.std, leap.max()))

    def _widen(self, look: _Look) -> None:
        """What the samples have not shown is known no better than at the start."""
        before = np.zeros(len(self._roster.names))
        before[look.index] = look.start.std
        unseen = (before > _WIDEST_STD) & (self._ekf.coordinate_std > _UNSEEN_SHARE * _WIDEST_STD)
        self._ekf.widen_parameters(np.where(unseen, np.square(before), 0.0))

    def _index(self, start: Gaussian) -> list[int]:
        return [self._roster.names.index(name) for name in start.names]

    def _vague(self, start: Gaussian) -> Mask:
        """Of the start's parameters: logarithms that were guessed, shape (parameters of the start,)."""
        logarithmic = self._roster.published & self._roster.logarithmic
        return np.asarray(logarithmic[self._index(start)] & (start.std > _VAGUE_STD))


def _nothing() -> Generator[None, None, None]:
    """Too many samples to go over."""
    yield from ()
