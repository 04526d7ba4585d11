"""Batch re-linearisation: the filter's first seconds filtered again at the values they led to, where it started from
no saved state (iterated EKF).

An extended Kalman filter takes derivatives at the values it has at the time. Started by a factor beside the truth it
counts what it learns meanwhile as exactly as if they were right: its spread falls to a percent while the values are
still tens of percent off, and then it is slow to believe anything else. So it is begun again with the spread it had at
the start but at the values it has found, over the same samples, until a pass no longer moves them: Gauss–Newton on the
first seconds (the iterated filter-smoother of Jazwinski, *Stochastic Processes and Filtering Theory*, 1970, sec. 8.3,
with all of the samples in one iteration).

How large the noise is was a guess as well, and whose it is: each time that of the current's sensor and that of the
voltage are taken as the samples are likeliest with.

What the first samples did not show (an inertia on a motion that hardly accelerates) the filter meets at its guess later
on, and everything else pays for the jump that it makes then: whenever a guessed parameter has jumped, the samples since
the start are filtered once more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from servo_daemon.kalman.ekf import Ekf
from servo_daemon.kalman.gaussian import Gaussian
from servo_daemon.samples import F64
from servo_daemon.tracking.noise.setting import NoiseSetting
from servo_daemon.tracking.noise.watch import WHITE_IN
from servo_daemon.tracking.plan.parameter_masks import Mask, ParameterMasks
from servo_daemon.tracking.samples.filtering import Filtering, Fit
from servo_daemon.tracking.start.starter import Start
from servo_daemon.tracking.validity.validity_gate import ValidityGate

#: Begun with a larger 1 σ than this a parameter's derivatives may be wrong.
_VAGUE_STD = 0.1
#: After so many ticks the first samples are filtered again, and after the first when a parameter has moved by so much
#: (a share of one unit) from where the last time has left it; each time in at most so many passes.
_TICKS, _MOVED, _PASSES = (10, 40), 0.1, 8
#: After so many jumps of a parameter the second time is waited for.
_MOST_MOVES = 4
#: So often noise and values are found in turn, where values have jumped meanwhile.
_TURNS = 2
#: More samples than these are not filtered again: others wait for their turn meanwhile.
_MOST_SAMPLES = 20_000
#: A pass begins with no larger 1 σ: further off a logarithm's derivatives say nothing of where it would have to go.
_WIDEST_STD = 0.2
#: A pass along the instrumental trajectory fits as well as one without it, if its cost is no larger than by this; by
#: the second where one has been no better before.
_AS_GOOD, _TRIED = 20.0, 3.0
#: A parameter of which the samples leave more than this share of it was not seen.
_UNSEEN_SHARE = 0.7
#: A pass that moves nothing by more than these, in standard deviations and as a share of one unit, was the last.
_SETTLED_STDS, _SETTLED_SHARE = 0.5, 0.01
#: Values that a pass moves by less than this are good enough for the instrumental trajectory to follow.
_FOLLOWS_SHARE = 0.05
#: The search for the likeliest variances: first step and accuracy of their logarithms, of −2 log p, and passes.
_NOISE_STEP, _NOISE_EXACT, _NOISE_COST, _NOISE_PASSES = 1.5, 0.3, 3.0, 25
_LEAST_VAR = 1e-18
#: Of fewer samples the values, which are fitted as well, leave too little of the noise.
_FEWEST = 300
#: Innovations are explained below this mean of ν²/s.
_AS_EXPECTED = 1.3


@dataclass(frozen=True, slots=True)
class _Batch:
    """What all passes over one batch of samples share.

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


class BatchRelinearisation:
    """Re-linearises one filter at its first samples, at fixed ticks and whenever a guessed parameter has jumped.

    Attributes:
        pending: the filter started from no saved state, and its first samples have not been re-linearised yet.
    """

    def __init__(
        self,
        masks: ParameterMasks,
        ekf: Ekf,
        filtering: Filtering,
        validity: ValidityGate,
        noise: NoiseSetting,
    ) -> None:
        self._masks, self._ekf, self._filtering = masks, ekf, filtering
        self._validity, self._noise = validity, noise
        self._start: Start | None = None
        self._left_at: F64 = np.zeros(0)  # coordinates, by the last time
        self._moves = 0
        self.pending = False

    def begin(self, start: Start, trusted: bool) -> None:
        """A filter starts.

        Args:
            trusted: from a saved state, or from another model's filter.
        """
        self._start, self.pending = None if trusted else start, not trusted
        self._moves = 0
        self._filtering.keep(None if trusted else start.last)

    def update(self, tick: int, white: bool, period_s: float) -> bool:
        """Filter the first samples again, if it is time to. Returns whether it was: all that was said of the filter's
        values was of others.

        Args:
            tick: number of the running filter's.
            white: the innovations are. Where they are not, the start may have been a wrong one, or the samples hold
                what no values explain: then nothing is done.
            period_s: usual distance of two samples.
        """
        if self._start is None or not (tick in _TICKS or self._has_moved(tick)):
            return False
        self._moves += tick not in _TICKS
        first, usable = self.pending, self._filtering.kept <= _MOST_SAMPLES
        self.pending = False
        start = self._start.parameters
        walk = self._validity.walk(self._masks.free)
        batch = _Batch(start, self._index(start), self._vague(start), walk, period_s)
        follows = self._filter_again(batch, white) if usable else None
        if follows is None and not first:
            self._widen_moved(batch)
        self._left_at = self._ekf.coordinates.copy()
        if tick >= _TICKS[-1]:
            self._start = None
        if follows is None:
            self._validity.resume()
            return False
        self._ekf.take_statistics()
        self._validity.begin_anew(follows)
        return True

    def end(self) -> None:
        """Give up the first samples: the motor has changed since."""
        self._start, self.pending = None, False

    def _has_moved(self, tick: int) -> bool:
        """Whether a guessed parameter that the filter has seen has left the values that the derivatives were taken
        at."""
        if self._start is None or tick < _TICKS[0] or self._moves == _MOST_MOVES:
            return False
        start = self._start.parameters
        index = np.array(self._index(start))[self._vague(start)]
        moved = (np.abs(self._ekf.coordinates - self._left_at) > _MOVED) & (self._ekf.coordinate_std < _VAGUE_STD)
        return bool(moved[index].any())

    def _filter_again(self, batch: _Batch, white: bool) -> bool | None:
        """Pass over the samples since the start. Returns whether the last pass used the instrumental trajectory; None:
        with the best values there are still samples that do not fit, so that these are no samples to begin from, and
        nothing is done.

        Args:
            white: as for `update`.
        """
        before, noise = self._ekf.snapshot(), self._noise.of_current
        if not white:  # noise as found at values that explain nothing would be large enough to explain anything
            self._iterate(batch, guessed=True)
        outliers, follows = 0, False
        for turn in range(_TURNS):
            at = self._ekf.coordinates
            self._learn_noise(batch)
            outliers, follows = self._iterate(batch, guessed=white and turn == 0)
            if (np.abs(self._ekf.coordinates - at)[self._masks.published] < _MOVED).all():
                break
        if outliers > 0 or not (white or self._is_white()):
            self._ekf.restore(before)
            if noise is not None and not white:
                self._noise.put_of_current(*noise)
            return None
        self._widen(batch)
        return follows

    def _is_white(self) -> bool:
        """Whether the last pass left white innovations."""
        channels = self._ekf.take_statistics().values()
        return all(abs(c.correlation) < WHITE_IN and c.nis < _AS_EXPECTED for c in channels)

    def _iterate(self, batch: _Batch, *, guessed: bool) -> tuple[int, bool]:
        """Passes until none moves the values any more. Returns how many outliers the best has left, and whether it was
        along the instrumental trajectory.

        Args:
            guessed: the first begins where the filter did.
        """
        published = self._masks.published
        best, best_fit, follows, best_follows = self._ekf.snapshot(), Fit(np.inf), False, False
        for first in (guessed, *[False] * _PASSES):
            found = self._ekf.coordinates
            fit = self._pass_over(batch, follows, first)
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
            best_follows = self._follow(batch, best_fit.cost + (_TRIED if follows else _AS_GOOD))
        return best_fit.outliers, best_follows

    def _follow(self, batch: _Batch, limit: float) -> bool:
        """Passes along the instrumental trajectory until none moves the values any more. Returns whether they fit, to
        this cost; the values are those of the last that does."""
        best, fits = self._ekf.snapshot(), False
        for _ in range(_PASSES):
            found = self._ekf.coordinates
            fit = self._pass_over(batch, follows=True, guessed=False)
            if not self._ekf.is_plausible() or fit.outliers > 0 or fit.cost > limit:
                break
            best, fits = self._ekf.snapshot(), True
            if (np.abs(self._ekf.coordinates - found) < self._allowed())[self._masks.published].all():
                break
        self._ekf.restore(best)
        return fits

    def _allowed(self) -> F64:
        """By how much the last pass may move each coordinate, shape (n,)."""
        return _SETTLED_STDS * self._ekf.coordinate_std + _SETTLED_SHARE

    def _learn_noise(self, batch: _Batch) -> None:
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
            return self._pass_over(batch, follows=False, guessed=False).cost

        at = np.log(np.maximum(guess, _LEAST_VAR))
        simplex = at + np.array([[0.0, 0.0], [_NOISE_STEP, 0.0], [0.0, -_NOISE_STEP]])
        options = {"initial_simplex": simplex, "xatol": _NOISE_EXACT, "fatol": _NOISE_COST, "maxfev": _NOISE_PASSES}
        likeliest = minimize(cost, at, method="Nelder-Mead", options=options)
        self._noise.put_of_current(*np.exp(likeliest.x).tolist())
        self._ekf.restore(found)

    def _pass_over(self, batch: _Batch, follows: bool, guessed: bool) -> Fit:
        """Once, with the spread of the start.

        Args:
            follows: along the instrumental trajectory.
            guessed: from where the filter started, and not from what it has found.
        """
        masks, found, start = self._masks, self._ekf.coordinates, batch.start
        free = masks.free if follows else masks.free_along_own_states(found, batch.period_s)
        begins = np.where(batch.vague & ~(free[batch.index] & guessed), found[batch.index], start.mean)
        self._ekf.use_instrumental_trajectory(follows)
        self._ekf.set_active(free, batch.walk_var_per_s)
        spread = np.diag(np.minimum(start.std, _WIDEST_STD) ** 2)
        return self._filtering.again(Gaussian(start.names, begins, spread))

    def _widen_moved(self, batch: _Batch) -> None:
        """The samples could not be filtered again. What has jumped did so along derivatives that were taken at other
        values, and is known no better than by as much."""
        moved = np.minimum(np.abs(self._ekf.coordinates - self._left_at), _WIDEST_STD)
        vague = np.zeros(len(moved), dtype=bool)
        vague[batch.index] = batch.vague
        self._ekf.widen_parameters(np.where(vague & (moved > _MOVED), np.square(moved), 0.0))

    def _widen(self, batch: _Batch) -> None:
        """What the samples have not shown is known no better than at the start."""
        before = np.zeros(len(self._masks.names))
        before[batch.index] = batch.start.std
        unseen = (before > _WIDEST_STD) & (self._ekf.coordinate_std > _UNSEEN_SHARE * _WIDEST_STD)
        self._ekf.widen_parameters(np.where(unseen, np.square(before), 0.0))

    def _index(self, start: Gaussian) -> list[int]:
        return [self._masks.names.index(name) for name in start.names]

    def _vague(self, start: Gaussian) -> Mask:
        """Of the start's parameters: logarithms that were guessed, shape (parameters of the start,)."""
        logarithmic = self._masks.published & self._masks.logarithmic
        return np.asarray(logarithmic[self._index(start)] & (start.std > _VAGUE_STD))
