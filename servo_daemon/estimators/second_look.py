"""The filter's first seconds gone over again, where it had to start from little.

An extended Kalman filter takes derivatives at the values it has at the time. Started by a factor beside the truth it
counts what it learns meanwhile as exactly as if they were right: its spread falls to a percent while the values are
still tens of percent off, and then it is slow to believe anything else. So it is begun again with the spread it had at
the start but at the values it has found, over the same samples, until a pass no longer moves them: Gauss–Newton on the
first seconds (the iterated filter-smoother of Jazwinski, *Stochastic Processes and Filtering Theory*, 1970, sec. 8.3,
with all of the samples in one iteration).

What the first samples did not show (an inertia on a motion that hardly accelerates) the filter meets at its guess later
on, and everything else pays for the leap that it makes then: whenever a guessed parameter has leapt, the samples since
the start are gone over once more.
"""

from __future__ import annotations

import numpy as np

from servo_daemon.estimators.base import Gaussian
from servo_daemon.estimators.ekf import Ekf
from servo_daemon.estimators.filtering import Filtering, Fit
from servo_daemon.estimators.parameter_judge import ParameterJudge
from servo_daemon.estimators.roster import Mask, Roster
from servo_daemon.estimators.starter import Start
from servo_daemon.samples import F64

#: Begun with a larger 1 σ than this a parameter's derivatives may be wrong.
_VAGUE_STD = 0.1
#: After so many ticks the first samples are gone over, and after the first when a parameter has moved by so much (a
#: share of one unit) from where the last time has left it; each time in at most so many passes.
_TICKS, _LEAP, _PASSES = (10, 40), 0.1, 8
#: After so many leaps the second time is waited for.
_MOST_LEAPS = 4
#: More samples than these are not gone over: others wait for their turn meanwhile.
_MOST_SAMPLES = 20_000
#: A pass begins with no larger 1 σ: further off a logarithm's derivatives say nothing of where it would have to go.
_WIDEST_STD = 0.2
#: A pass along the instrument fits as well as one without it, if its cost is no larger than by this.
_AS_GOOD = 20.0
#: A parameter of which the samples leave more than this share of it was not seen.
_UNSEEN_SHARE = 0.7
#: A pass that moves nothing by more than these, in standard deviations and as a share of one unit, was the last.
_SETTLED_STDS, _SETTLED_SHARE = 0.5, 0.01
#: Values that a pass moves by less than this are good enough for the instrument to follow.
_FOLLOWS_SHARE = 0.05


class SecondLook:
    """One drive's.

    Attributes:
        pending: the filter started from little, and its first samples have not been gone over yet.
    """

    def __init__(
        self,
        roster: Roster,
        ekf: Ekf,
        filtering: Filtering,
        judge: ParameterJudge,
    ) -> None:
        self._roster, self._ekf, self._filtering = roster, ekf, filtering
        self._judge = judge
        self._start: Start | None = None
        self._left_at: F64 = np.zeros(0)  # coordinates, by the last time
        self._leaps = 0
        self.pending = False

    def begin(self, start: Start, trusted: bool) -> None:
        """A filter starts.

        Args:
            trusted: from a saved state, or from another model's filter.
        """
        vague = not trusted and bool(self._vague(start.parameters).any())
        self._start, self.pending = start if vague else None, vague
        self._leaps = 0
        self._filtering.keep(start.last if vague else None)

    def look(self, tick: int, white: bool) -> bool:
        """Go over the first samples, if it is time to. Returns whether it was: all that was said of the filter's values
        was of others.

        Args:
            tick: number of the running filter's.
            white: the innovations are. Where they are not, the samples hold what no values explain.
        """
        if self._start is None or not (tick in _TICKS or self._has_leapt(tick)):
            return False
        self._leaps += tick not in _TICKS
        start, complete = self._start.parameters, self._filtering.complete and white
        complete = complete and self._filtering.kept <= _MOST_SAMPLES
        self.pending = False
        follows = self._go_over(start, self._judge.walk(self._roster.free)) if complete else None
        self._left_at = self._ekf.coordinates.copy()
        if tick >= _TICKS[-1]:
            self._start = None
            self._filtering.keep(None)
        if follows is None:
            return False
        self._ekf.take_statistics()
        self._judge.begin_anew(follows)
        return True

    def _has_leapt(self, tick: int) -> bool:
        """Whether a guessed parameter that the filter has seen is elsewhere than the derivatives were taken at."""
        if self._start is None or tick < _TICKS[0] or self._leaps == _MOST_LEAPS:
            return False
        start = self._start.parameters
        index = np.array([self._roster.names.index(name) for name in start.names])[self._vague(start)]
        leapt = (np.abs(self._ekf.coordinates - self._left_at) > _LEAP) & (self._ekf.coordinate_std < _VAGUE_STD)
        return bool(leapt[index].any())

    def _go_over(self, start: Gaussian, walk_var_per_s: F64) -> bool | None:
        """Pass over the samples since the start. Returns whether the last pass used the instrument; None: with the best
        values there are still samples that do not fit, so that these are no samples to begin from, and nothing is done.
        """
        published = self._roster.published
        spread = np.diag(np.minimum(start.std, _WIDEST_STD) ** 2)
        self._ekf.set_active(self._roster.free, walk_var_per_s)
        before = best = self._ekf.snapshot()
        best_fit, follows = Fit(np.inf, 0), False
        for begin in (start.mean, *[None] * _PASSES):
            found = self._ekf.coordinates
            self._ekf.use_instrument(follows)
            values = self._values(start, found) if begin is None else begin
            fit = self._filtering.again(Gaussian(start.names, values, spread))
            moved = np.abs(self._ekf.coordinates - found)[published]
            better = self._ekf.is_plausible() and fit.cost < best_fit.cost
            if better:
                best, best_fit = self._ekf.snapshot(), fit
            allowed = _SETTLED_STDS * self._ekf.coordinate_std[published] + _SETTLED_SHARE
            if begin is None and ((follows and (moved < allowed).all()) or not better):
                break
            self._ekf.restore(best)
            follows = bool((moved < allowed + _FOLLOWS_SHARE).all())
        if best_fit.outliers > 0:
            self._ekf.restore(before)
            return None
        if not follows:  # along its own states a filter learns from the colour of its noise: no pass to stay with
            self._ekf.restore(best)
            self._ekf.use_instrument(True)
            fit = self._filtering.again(Gaussian(start.names, self._values(start, self._ekf.coordinates), spread))
            follows = self._ekf.is_plausible() and fit.outliers == 0 and fit.cost < best_fit.cost + _AS_GOOD
            best = self._ekf.snapshot() if follows else best
        self._ekf.restore(best)
        self._widen(start)
        return follows

    def _widen(self, start: Gaussian) -> None:
        """What the samples have not shown is known no better than at the start."""
        index = [self._roster.names.index(name) for name in start.names]
        before = np.zeros(len(self._roster.names))
        before[index] = start.std
        unseen = (before > _WIDEST_STD) & (self._ekf.coordinate_std > _UNSEEN_SHARE * _WIDEST_STD)
        self._ekf.widen_parameters(np.where(unseen, np.square(before), 0.0))

    def _vague(self, start: Gaussian) -> Mask:
        """Of the start's parameters: logarithms that were guessed, shape (parameters of the start,)."""
        logarithmic = self._roster.published & self._roster.logarithmic
        own = np.array([logarithmic[self._roster.names.index(name)] for name in start.names])
        return np.asarray(own & (start.std > _VAGUE_STD))

    def _values(self, start: Gaussian, found: F64) -> F64:
        """Where the next pass begins: what has been found where there was a guess."""
        index = [self._roster.names.index(name) for name in start.names]
        return np.where(self._vague(start), found[index], start.mean)
