"""Passes of the filter over one batch of samples, until they no longer move its values (`relinearisation.py`).

Everything here stops after every pass, so that whoever asks for it can go on in the next tick. Without the noise that
is learned beside the values `test_noise_that_was_taken_for_another_is_not_information` fails.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass

import numpy as np

from servo_daemon.kalman.ekf import Ekf
from servo_daemon.kalman.gaussian import Gaussian
from servo_daemon.samples import F64
from servo_daemon.tracking.noise.levels import LEAST_VAR
from servo_daemon.tracking.noise.setting import NoiseSetting
from servo_daemon.tracking.noise.watch import WHITE_IN
from servo_daemon.tracking.plan.parameter_masks import Mask, ParameterMasks
from servo_daemon.tracking.restart.simplex import SimplexSearch
from servo_daemon.tracking.samples.filtering import SETTLED_SHARE, SETTLED_STDS, Filtering, Fit

#: Values have jumped that have moved by more than this, a share of one unit; then the derivatives were others'
#: (decision 33).
MOVED = 0.1
#: The values have not settled after so many passes (`test_values_five_times_off_settle` fails with one fewer).
_PASSES = 8
#: So often noise and values are found in turn, where values have jumped meanwhile
#: (`test_noise_is_found_again_at_the_values_that_were_found_with_it` fails with once).
_TURNS = 2
#: A pass begins with no larger 1 σ: further off a logarithm's derivatives say nothing of where it would have to go (a
#: fifth; free within a half and twice: tests/recovery/constants.py).
WIDEST_STD = 0.2
#: A pass along the instrumental trajectory fits as well as one without it, if its cost is no larger than by this; by
#: the second where one has been no better before (free within 10 .. 40 and 1.5 .. 6).
_AS_GOOD, _TRIED = 20.0, 3.0
#: Values that a pass moves by less than this are good enough for the instrumental trajectory to follow (chosen; half
#: and twice move no tracking figure).
_FOLLOWS_SHARE = 0.05
#: The search for the likeliest variances: first step and accuracy of their logarithms, of −2 log p, and passes
#: (decision 34; `test_noises_that_are_off_by_a_factor_of_thirty_are_found` fails with one pass fewer).
_NOISE_STEP, _NOISE_EXACT, _NOISE_COST, _NOISE_PASSES = 1.5, 0.3, 3.0, 25
#: Of fewer samples the values, which are fitted as well, leave too little of the noise (chosen: by so many a variance
#: is known to √(2/300), 8 %).
_FEWEST = 300
#: Innovations are explained below this mean of ν²/s (see `make calibrate`).
_AS_EXPECTED = 1.3


@dataclass(frozen=True, slots=True)
class Batch:
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


class BatchPasses:
    """Passes of one filter over a batch."""

    def __init__(self, masks: ParameterMasks, ekf: Ekf, filtering: Filtering, noise: NoiseSetting) -> None:
        self._masks, self._ekf, self._filtering, self._noise = masks, ekf, filtering, noise

    def filter_again(self, batch: Batch, white: bool) -> Generator[None, None, bool | None]:
        """Pass over the batch, and stop after every pass. Returns whether the last pass used the instrumental
        trajectory; None: with the best values there are still samples that do not fit, so that these are no samples to
        begin from.

        Args:
            white: the innovations are.
        """
        if not white:  # noise as found at values that explain nothing would be large enough to explain anything
            yield from self._iterate(batch, guessed=True)
        outliers, follows = 0, False
        for turn in range(_TURNS):
            at = self._ekf.coordinates
            yield from self._learn_noise(batch)
            outliers, follows = yield from self._iterate(batch, guessed=white and turn == 0)
            if (np.abs(self._ekf.coordinates - at)[self._masks.published] < MOVED).all():
                break
        return None if outliers > 0 or not (white or self._is_white()) else follows

    def _is_white(self) -> bool:
        """Whether the last pass left white innovations."""
        channels = self._ekf.take_statistics().values()
        return all(abs(c.correlation) < WHITE_IN and c.nis < _AS_EXPECTED for c in channels)

    def _iterate(self, batch: Batch, *, guessed: bool) -> Generator[None, None, tuple[int, bool]]:
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
            best_follows = yield from self._follow(batch, best_fit.cost + (_TRIED if follows else _AS_GOOD))
        return best_fit.outliers, best_follows

    def _follow(self, batch: Batch, limit: float) -> Generator[None, None, bool]:
        """Passes along the instrumental trajectory until none moves the values any more. Returns whether they fit, to
        this cost; the values are those of the last that does."""
        best, fits = self._ekf.snapshot(), False
        for _ in range(_PASSES):
            found = self._ekf.coordinates
            fit = self._pass_over(batch, follows=True, guessed=False)
            yield
            if not self._ekf.is_plausible() or fit.outliers > 0 or fit.cost > limit:
                break
            best, fits = self._ekf.snapshot(), True
            if (np.abs(self._ekf.coordinates - found) < self._allowed())[self._masks.published].all():
                break
        self._ekf.restore(best)
        return fits

    def _allowed(self) -> F64:
        """By how much the last pass may move each coordinate, shape (n,)."""
        return SETTLED_STDS * self._ekf.coordinate_std + SETTLED_SHARE

    def _learn_noise(self, batch: Batch) -> Iterator[None]:
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

        at = np.log(np.maximum(guess, LEAST_VAR))
        simplex = at + np.array([[0.0, 0.0], [_NOISE_STEP, 0.0], [0.0, -_NOISE_STEP]])
        likeliest = SimplexSearch(cost, simplex, exact=_NOISE_EXACT, cost_exact=_NOISE_COST, most=_NOISE_PASSES)
        yield from likeliest.steps()
        self._noise.put_of_current(*np.exp(likeliest.best).tolist())
        self._ekf.restore(found)

    def _pass_over(self, batch: Batch, follows: bool, guessed: bool) -> Fit:
        """Once, with the spread of the start.

        Args:
            follows: along the instrumental trajectory.
            guessed: from where the filter started, and not from what it has found.
        """
        found, start = self._ekf.coordinates, batch.start
        free = self.allow(batch, follows)
        begins = np.where(batch.vague & ~(free[batch.index] & guessed), found[batch.index], start.mean)
        spread = np.diag(np.minimum(start.std, WIDEST_STD) ** 2)
        return self._filtering.again(Gaussian(start.names, begins, spread))

    def allow(self, batch: Batch, follows: bool) -> Mask:
        """Tell the filter which parameters may move, along the instrumental trajectory or not; shape (n,)."""
        masks = self._masks
        free = masks.free if follows else masks.free_along_own_states(self._ekf.coordinates, batch.period_s)
        self._ekf.use_instrumental_trajectory(follows)
        self._ekf.set_active(free, batch.walk_var_per_s)
        return free
