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
the start are filtered once more (without that `test_after_a_constant_speed_a_datasheet_five_times_off_is_overcome`
fails).
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np

from servo_daemon.kalman.ekf import Ekf
from servo_daemon.kalman.gaussian import Gaussian
from servo_daemon.samples import F64
from servo_daemon.tracking.noise.setting import NoiseSetting
from servo_daemon.tracking.noise.watch import WatchMark
from servo_daemon.tracking.plan.parameter_masks import Mask, ParameterMasks
from servo_daemon.tracking.restart.batch_passes import MOVED, WIDEST_STD, Batch, BatchPasses
from servo_daemon.tracking.samples.filtering import MOST_SAMPLES, STEPS_A_TICK, Filtering
from servo_daemon.tracking.start.starter import Start
from servo_daemon.tracking.validity.validity_gate import ValidityGate

#: Begun with a larger 1 σ than this a parameter's derivatives may be wrong (free within a half and twice:
#: tests/recovery/constants.py).
_VAGUE_STD = 0.1
#: From this tick on the filter has found its values, or is suspected of having diverged (decision 33: 4 s).
FOUND_TICK = 40
#: After so many ticks (decision 33) the first samples are filtered again, and after the first when a parameter has
#: moved by `MOVED` from where the last time has left it.
_TICKS = 10, FOUND_TICK
#: … and no sooner than after so many samples, as 200 Hz has them by then: of fewer, at 50 and 100 Hz, R, L and J stayed
#: 5 to 12 σ off in a sixth of the runs (`test_few_samples_a_second_are_no_reason_to_be_sure`).
_FEWEST_SAMPLES = 200, 800
#: After so many jumps of a parameter the second time is waited for (free within 2 .. 8).
_MOST_MOVES = 4
#: A parameter of which the samples leave more than this share of it was not seen (free within 0.5 .. 0.9).
_UNSEEN_SHARE = 0.7


@dataclass(frozen=True, slots=True)
class _Filter:
    """Where filter and noise are."""

    state: F64
    constants: F64
    noise: WatchMark


@dataclass(slots=True)
class _UnderWay:
    """A batch that is being filtered again.

    Attributes:
        batch: what its passes share.
        last: of the start's.
        white: the innovations were when it began.
        passes: a tick's.
        work: what is left of it, a pass at a time.
        at: where it has left filter and noise.
        doubt: 1 σ that the balances left open before, (n,).
    """

    batch: Batch
    last: bool
    white: bool
    passes: int
    work: Generator[None, None, bool | None]
    at: _Filter
    doubt: F64


class BatchRelinearisation:
    """Re-linearises one filter at its first samples, at fixed ticks and whenever a guessed parameter has jumped.

    That is spread over as many ticks as it needs (`STEPS_A_TICK`), in which the filter goes on as it was; what is found
    is taken over with the samples that have come meanwhile.

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
        self._passes = BatchPasses(masks, ekf, filtering, noise)
        self._start: Start | None = None
        self._left_at: F64 = np.zeros(0)  # coordinates, by the last time
        self._moves = self._times = 0
        self._under_way: _UnderWay | None = None
        self._due = False
        self.pending = False

    @property
    def is_open(self) -> bool:
        """The first samples are yet to be re-linearised, or are so now: they must be kept."""
        return self.pending or self._due or self._under_way is not None

    @property
    def is_over(self) -> bool:
        """The first samples are not needed any more."""
        return self._start is None

    def begin(self, start: Start, trusted: bool) -> None:
        """A filter starts.

        Args:
            trusted: from a saved state, or from another model's filter.
        """
        self._start, self.pending = None if trusted else start, not trusted
        self._moves, self._times, self._under_way, self._due = 0, 0, None, False
        self._filtering.keep(None if trusted else start.last)

    def update(self, tick: int, white: bool, period_s: float) -> bool:
        """Filter the first samples again, if it is time to. Returns whether that is done: all that was said of the
        filter's values was of others.

        Args:
            tick: number of the running filter's.
            white: the innovations are. Where they are not, the start may have been a wrong one, or the samples hold
                what no values explain: then nothing is done.
            period_s: usual distance of two samples.
        """
        if self._start is None:
            return False
        self._due |= self._is_time(tick)
        if self._under_way is None:
            if not self._due and not self._has_moved():
                return False
            self._moves += not self._due
            self._times += self._due
            self._due = False
            self._under_way = self._begun(self._start.parameters, white, period_s)
        return self._go_on(self._under_way)

    def end(self) -> None:
        """Give up the first samples: the motor has changed since."""
        self._start, self.pending = None, False
        self._under_way, self._due = None, False

    def _begun(self, start: Gaussian, white: bool, period_s: float) -> _UnderWay:
        walk = self._validity.walk(self._masks.free)
        batch = Batch(start, self._index(start), self._vague(start), walk, period_s)
        samples = self._filtering.kept
        usable = samples <= MOST_SAMPLES
        if usable:
            self._filtering.begin_batch()
        work = self._passes.filter_again(batch, white) if usable else _nothing()
        passes = max(1, STEPS_A_TICK // max(samples, 1))
        doubt = self._validity.mismatch.std
        now = _UnderWay(batch, self._times == len(_TICKS), white and usable, passes, work, self._here(), doubt)
        if not self.pending:
            self._widen_moved(batch)
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
        """Take over what was found. Returns whether something was.

        Args:
            filter_: as it was meanwhile.
            follows: as `BatchPasses.filter_again` returns it.
        """
        first, self.pending, self._under_way = self.pending, False, None
        noise = self._noise.of_current
        if follows is None:
            self._put(filter_)
        else:
            self._passes.allow(now.batch, follows)
            self._filtering.catch_up()
            self._noise.watch_back_to(filter_.noise)
        if noise is not None and (follows is not None or now.white):
            self._noise.put_of_current(*noise)
        if follows is not None:
            self._widen(now.batch)
        if not first:
            moved = np.abs(self._ekf.coordinates - self._ekf.parameters_of(filter_.state)[0])
            self._validity.doubt(np.maximum(now.doubt, moved))
        self._left_at = self._ekf.coordinates.copy()
        if now.last:
            self._start = None
        if follows is None:
            return False
        self._ekf.take_statistics()
        self._validity.begin_anew(follows)
        return True

    def _here(self) -> _Filter:
        return _Filter(self._ekf.snapshot(), self._ekf.constants, self._noise.mark())

    def _put(self, there: _Filter) -> None:
        self._ekf.restore(there.state)
        self._ekf.put_constants(there.constants)
        self._noise.watch_back_to(there.noise)

    def _is_time(self, tick: int) -> bool:
        """For the first or the second of the times that are set."""
        if self._times == len(_TICKS):
            return False
        return tick >= _TICKS[self._times] and self._filtering.kept >= _FEWEST_SAMPLES[self._times]

    def _has_moved(self) -> bool:
        """Whether a guessed parameter that the filter has seen has left the values that the derivatives were taken
        at."""
        if self._start is None or not self._times or self._moves == _MOST_MOVES:
            return False
        start = self._start.parameters
        index = np.array(self._index(start))[self._vague(start)]
        moved = (np.abs(self._ekf.coordinates - self._left_at) > MOVED) & (self._ekf.coordinate_std < _VAGUE_STD)
        return bool(moved[index].any())

    def _widen_moved(self, batch: Batch) -> None:
        """Until the samples have been filtered again, and if they cannot be: what has jumped did so along derivatives
        that were taken at other values, and is known no better than by as much. Until then all the rest pays for it.
        (`test_what_has_jumped_and_cannot_be_relinearised_is_widened` fails without it, and without the doubt.)"""
        moved = np.minimum(np.abs(self._ekf.coordinates - self._left_at), WIDEST_STD)
        vague = np.zeros(len(moved), dtype=bool)
        vague[batch.index] = batch.vague
        moved = np.where(vague & (moved > MOVED), moved, 0.0)
        self._ekf.widen_parameters(np.square(moved))
        self._validity.doubt(np.maximum(self._validity.mismatch.std, moved.max()))

    def _widen(self, batch: Batch) -> None:
        """What the samples have not shown is known no better than at the start."""
        before = np.zeros(len(self._masks.names))
        before[batch.index] = batch.start.std
        unseen = (before > WIDEST_STD) & (self._ekf.coordinate_std > _UNSEEN_SHARE * WIDEST_STD)
        self._ekf.widen_parameters(np.where(unseen, np.square(before), 0.0))

    def _index(self, start: Gaussian) -> list[int]:
        return [self._masks.names.index(name) for name in start.names]

    def _vague(self, start: Gaussian) -> Mask:
        """Of the start's parameters: logarithms that were guessed, shape (parameters of the start,)."""
        logarithmic = self._masks.published & self._masks.logarithmic
        return np.asarray(logarithmic[self._index(start)] & (start.std > _VAGUE_STD))


def _nothing() -> Generator[None, None, None]:
    """Too many samples to filter again."""
    yield from ()
