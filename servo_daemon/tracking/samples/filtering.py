"""Runs the filter over samples as they come: gaps, restarts of the device, and which samples were outliers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servo_daemon.conditioning.filled import LINE_VAR, filled
from servo_daemon.conditioning.gaps import breaks, gaps, is_whole
from servo_daemon.conditioning.layout import Layout, Marked, Mask, channel
from servo_daemon.kalman.ekf import Ekf
from servo_daemon.kalman.gaussian import Gaussian
from servo_daemon.kalman.measurement import GATE
from servo_daemon.kalman.records import Innovations
from servo_daemon.samples import F64, SampleBlock
from servo_daemon.tracking.samples.signal_scales import SignalScales

#: No more samples than these are gone over again: a pass over them takes 20 ms of a tick's 100.
MOST_SAMPLES = 20_000
#: In a tick at most so many steps of the filter go over samples again, which takes 40 ms of its 100; the rest of it in
#: the next ones. At 1 kHz a first re-linearisation takes one tick, the second three. (With 40,000 the second is taken
#: over later, and a start under friction claims a K that is 4.3 standard deviations off: docs/performance.md.)
STEPS_A_TICK = 60_000
#: A pass over them that moves no value by more than these, in standard deviations and as a share of one unit, was the
#: last (free within a half and twice: tests/recovery/constants.py).
SETTLED_STDS, SETTLED_SHARE = 0.5, 0.01


@dataclass(frozen=True, slots=True)
class Fit:
    """How badly samples fit: minus twice the logarithm of the innovations' likelihood, those of outliers as at the
    gate; how many outliers there are, and samples."""

    cost: float = 0.0
    outliers: int = 0
    samples: int = 0

    def with_more(self, i: Innovations) -> Fit:
        """With those of another run of samples."""
        cost = np.inf
        if i.possible:
            square = np.minimum(np.square(i.innovation) / i.variance, GATE**2)
            cost = self.cost + float(np.sum(square + np.log(i.variance)))
        return Fit(cost, self.outliers + int(np.count_nonzero(i.gated)), self.samples + len(i.innovation))


@dataclass(frozen=True, slots=True)
class Forget:
    """Samples are missing before these: the motion is unknown, or everything is."""

    part: SampleBlock
    everything: bool


class Filtering:
    """Lays out samples for one filter and runs it over them; keeps them while they may be needed again.

    Attributes:
        layout: how samples are laid out.
        own: how badly the samples fitted as they came, while they are kept and since this was last set.
    """

    def __init__(self, ekf: Ekf, signal_scales: SignalScales) -> None:
        self._ekf, self._signal_scales = ekf, signal_scales
        self.layout = Layout(ekf.plant.drive, ekf.channels)
        self._before: SampleBlock | None = None  # the last samples
        self._kept: list[tuple[SampleBlock, float | None, float | None]] | None = None
        self._kept_from: tuple[SampleBlock, Marked] | None = None
        self._laid_out: tuple[float, list[Forget | F64]] | None = None  # the kept ones, as a batch
        self._since: list[Forget | F64] = []  # what the filter took since then
        self.own = Fit()
        self._passed: list[Forget | F64] = []  # what the filter took since it was last asked for
        self._gated: list[F64] = []  # of each run of samples since they were last asked for; (n, channels)

    def take(self, block: SampleBlock, last_s: float | None, period_s: float | None) -> None:
        """Filter samples, in order.

        Args:
            last_s: time of the sample before them.
            period_s: usual distance of two samples.
        """
        if not self._ekf.started:
            self.layout.rows(block, 0.0)
            self._before = block
            return
        if self._kept is not None:
            self._kept.append((block, last_s, period_s))
        for piece in self._pieces(block, last_s, period_s):
            self._passed.append(piece)
            if self._laid_out is not None:
                self._since.append(piece)
            innovations = self.run(piece, again=False)
            if innovations is not None:
                self._gated.append(innovations.gated)
                if self._kept is not None:
                    self.own = self.own.with_more(innovations)

    def run(self, piece: Forget | F64, *, again: bool = True) -> Innovations | None:
        """The filter over samples as they are laid out, or what it forgets between some.

        Args:
            again: they have been taken before.
        """
        if isinstance(piece, Forget):
            self._forget(piece)
            return None
        return self._ekf.update(piece, again=again)

    def take_passed(self) -> list[Forget | F64]:
        """What the filter took since the last call."""
        taken, self._passed = self._passed, []
        return taken

    def _pieces(self, block: SampleBlock, last_s: float | None, period_s: float | None) -> Iterator[Forget | F64]:
        """Samples as the filter takes them, and what it forgets in between."""
        before, self._before = self._before, block
        if is_whole(block, last_s, period_s):
            yield self._rows(block)
            return
        cuts = breaks(block, last_s)
        holes = gaps(block, last_s, period_s)
        if not cuts and not holes:
            yield self._rows(block)
            return
        edges = sorted({*cuts, *(k for k, short in holes.items() if not short)})
        for a, b in zip([0, *edges], [*edges, len(block)], strict=True):
            if b <= a:
                continue
            part = block.slice(a, b)
            if a in edges:
                self.layout.resume(float(part.time_s[0]))  # no prediction up to this sample
                yield Forget(part, everything=a in cuts)
            short = [k - a for k, is_short in holes.items() if is_short and a <= k < b and k not in cuts]
            if short and period_s is not None:
                yield self._rows(*filled(part, before.end if a == 0 and before is not None else None, short, period_s))
            else:
                yield self._rows(part)

    def _rows(self, part: SampleBlock, new: Mask | None = None) -> F64:
        """The part as the filter's rows. `new`: which samples were filled in, shape (n,)."""
        scales = self._signal_scales
        line_var = LINE_VAR * scales.input_step_square
        spikes = scales.spike_limit, scales.current_spike_limit
        return self.layout.rows(part, scales.input_square, new, line_var, *spikes)

    def _forget(self, at: Forget) -> None:
        forget = self._ekf.forget_state if at.everything else self._ekf.forget_motion
        forget(self.first_state(at.part))

    @property
    def kept(self) -> int:
        """How many samples are kept."""
        return 0 if self._kept is None else sum(len(block) for block, _, _ in self._kept)

    def keep(self, last: SampleBlock | None) -> None:
        """A filter starts: from now on samples are kept, so that they can be filtered `again`.

        Args:
            last: the last sample before them; None: no samples are kept, nor those that were.
        """
        self._kept = None if last is None else []
        self._kept_from = None if last is None else (last, self.layout.mark())
        self._laid_out, self._since = None, []

    def begin_batch(self) -> None:
        """What is kept by now is filtered `again` from here on, however much is added meanwhile."""
        self._laid_out, self._since = self._lay_out(), []

    def catch_up(self) -> None:
        """Give the filter, which is through the batch, the samples that have come since."""
        for piece in self._since:
            self.run(piece)

    def again(self, parameters: Gaussian) -> Fit:
        """Start the filter from these parameters and give it the samples of the batch."""
        fit = Fit()
        for innovations in self._over_kept(parameters):
            fit = fit.with_more(innovations)
        return fit

    def predictions(self, parameters: Gaussian, *, up_to_now: bool) -> Innovations:
        """What the filter says of the batch with these parameters, known exactly; in one piece.

        Args:
            up_to_now: and of those that have come since, after which the filter can go on.
        """
        runs = list(self._over_kept(parameters, held=not up_to_now))
        if up_to_now:
            runs += [innovations for piece in self._since if (innovations := self.run(piece)) is not None]
        return Innovations(
            np.concatenate([r.innovation for r in runs]),
            np.concatenate([r.variance for r in runs]),
            np.concatenate([r.gated for r in runs]),
        )

    def _over_kept(self, parameters: Gaussian, *, held: bool = False) -> Iterator[Innovations]:
        """The filter, started from these parameters, over the samples of the batch.

        Args:
            held: they are known exactly.
        """
        assert self._kept_from is not None and self._laid_out is not None
        last, _ = self._kept_from
        held_input, pieces = self._laid_out
        self._ekf.start(parameters, held_input=held_input)
        self._ekf.forget_state(self.first_state(last))
        for piece in pieces:
            if held and not isinstance(piece, Forget):
                yield self._ekf.predict_held(piece)
            elif (innovations := self.run(piece)) is not None:
                yield innovations

    def _lay_out(self) -> tuple[float, list[Forget | F64]]:
        """The input before the samples that were kept, and these in as few pieces as can be: a drive sends ten at a
        time, and many passes go over them."""
        assert self._kept is not None and self._kept_from is not None
        last, marked = self._kept_from
        self.layout.back_to(marked)
        held_input, before, self._before = self.layout.last_input, self._before, last
        out: list[Forget | F64] = []
        run: list[F64] = []
        for piece in (piece for samples in self._kept for piece in self._pieces(*samples)):
            if isinstance(piece, Forget):
                out += [np.concatenate(run), piece] if run else [piece]
                run = []
            else:
                run.append(piece)
        self._before = before
        return held_input, [*out, np.concatenate(run)] if run else out

    def first_state(self, block: SampleBlock) -> F64:
        """Plant states at the first sample of a block: what is measured; the last known where that is no measurement
        (looking further would make the result depend on where blocks end); the model's start for the rest."""
        x = np.array([s.initial for s in self._ekf.plant.states])
        first = block.slice(0, 1)
        for k, state in enumerate(self._ekf.plant.states):
            if state.name in self._ekf.channels:
                values, valid = channel(first, state.name)
                x[k] = values[0] if valid is None or valid[0] else self._ekf.x[k]
        return x

    def take_outliers(self) -> NDArray[np.bool_] | None:
        """Which of the samples since the last call were gated in some channel; None: none was."""
        taken, self._gated = self._gated, []
        if not any(np.count_nonzero(gated) for gated in taken):
            return None
        return np.asarray(np.logical_or.reduce(np.concatenate(taken), axis=1))

    def forget_outliers(self) -> None:
        """Forget which samples were gated: a filter begins."""
        self._gated = []
