"""The shaft's balance of whole captures as rows of a regression: the torque that the measured motion needs.

    K i = J dω/dt + B ω + τ_effects(θ, ω)         (a torque, where that is the input, in the place of K i)

Nothing is simulated: position and speed are the measured ones, filtered as for inverse-dynamic identification.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from servo_daemon.diagnosis.missing.noise_levels import alive, resolution
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.identification.inverse_dynamics.filter import Filter, FilterChoice, choose, rests
from servo_daemon.identification.inverse_dynamics.shaft import kinematics, speed_noise
from servo_daemon.identification.inverse_dynamics.signals import FEWEST, EvenStretch, even_stretch, pieces
from servo_daemon.identification.output_error.problem.problem import Segment
from servo_daemon.identification.output_error.problem.rollout import TIME
from servo_daemon.numerics import sample_period
from servo_daemon.plant.columns.screening import Motion
from servo_daemon.samples import F64

#: Below so many standard deviations of its own noise a speed is rest (a Gaussian is beyond four once in 16,000 times).
_REST_SIGMA = 4.0
#: Instants of each interval that the motion's formulas are taken at where the effort is its mean: of a wave of which it
#: passes 2 rad, the mean is then right to 1 % (0.25 / sin 0.25 = 1.01).
_INSTANTS = 4
#: A row in no free run of the split.
NOWHERE = -1


@dataclass(frozen=True)
class BalanceRows:
    """The balance of captures, n samples (or intervals, where the effort is a mean over each) and w rows.

    Attributes:
        motion: of all stretches one after the other, shapes (n · instants,); `u` and `i` are the measured effort.
        factor: torque by effort: K, or 1 where the input is a torque.
        torque: shape (w,), factor times the effort, filtered, N·m.
        unread: shape (w,), N·m: by so much the effort may be off where its reading stands: half a step of it, in every
            one of these rows alike and the same whenever the shaft comes to rest in that place.
        run: shape (w,), number of the free run of the split that a row is in, or `NOWHERE`.
        part: shape (w,), the part of the split, or `NOWHERE`.
        filter: what smooths and decimates.
        lengths: samples of each stretch.
        instants: of the motion for each sample.
    """

    motion: Motion
    factor: float
    torque: F64
    unread: F64
    run: NDArray[np.int64]
    part: NDArray[np.int64]
    filter: Filter
    lengths: tuple[int, ...]
    instants: int

    @cached_property
    def rest(self) -> F64:
        """Share of each row in which the shaft rests, shape (w,)."""
        return np.clip(self.filtered(self.motion.rest.astype(np.float64)), 0.0, 1.0)

    @property
    def effort(self) -> F64:
        """Current or torque as measured, shape (n,)."""
        return self.motion.u[:: self.instants]

    def filtered(self, column: F64) -> F64:
        """A column of the motion, shape (n · instants,), as rows, shape (w,)."""
        means = column.reshape(-1, self.instants).mean(axis=1)
        parts = np.split(means, np.cumsum(self.lengths)[:-1])
        return np.concatenate([self.filter.decimate(p[:, None])[:, 0] for p in parts])

    def at(self, *parts: int) -> NDArray[np.bool_]:
        """Which rows are in these parts of the split, shape (w,)."""
        return np.asarray(np.isin(self.part, parts))


def balance_rows(data: Data, effects: tuple[str, ...], p: Mapping[str, float]) -> BalanceRows | None:
    """The balance of all recordings of a drive whose current or torque is measured.

    Args:
        data: recordings and their split.
        effects: of the model that the split was made for.
        p: its parameters, natural units.

    Returns:
        None where no piece of the captures is long enough to be differentiated, or where the position is not measured.
    """
    pieces_of = _pieces(data)
    if not pieces_of:
        return None
    efforts, motions = [x.stretch.effort for x in pieces_of], [x.stretch.motion for x in pieces_of]
    f = choose(FilterChoice(), pieces_of[0].stretch.rate_Hz, motions, efforts, 2)
    kept = [x for x in pieces_of if len(x.stretch.effort) >= f.shortest]
    if not kept:
        return None
    stretches = [x.stretch for x in kept]
    factor = p.get("K", 1.0)
    segments = data.problem(effects, {}).segments
    begins = [r.block.time_s[0] for r in data.recordings]
    times = [f.pick(_instants(s, s.time_s, 1)) for s in stretches]
    run = np.concatenate([_runs(segments, x.owner, t - begins[x.owner]) for x, t in zip(kept, times, strict=True)])
    instants = _INSTANTS if stretches[0].by_intervals else 1
    return BalanceRows(
        motion=_motion(stretches, f, {**p, "K": factor}, instants),
        factor=factor,
        torque=factor * np.concatenate([f.decimate(s.effort[:, None])[:, 0] for s in stretches]),
        unread=factor * np.concatenate([np.maximum(f.decimate(x.unread[:, None])[:, 0], 0.0) for x in kept]),
        run=run,
        part=np.where(run == NOWHERE, NOWHERE, data.split.part[run]),
        filter=f,
        lengths=tuple(len(s.effort) for s in stretches),
        instants=instants,
    )


@dataclass(frozen=True, slots=True)
class _Piece:
    """An uninterrupted part of a recording, its number, and `BalanceRows.unread` of its readings in their unit."""

    stretch: EvenStretch
    owner: int
    unread: F64


def _pieces(data: Data) -> list[_Piece]:
    """Pieces of the recordings on even grids."""
    out: list[_Piece] = []
    for number, recording in enumerate(data.recordings):
        block = recording.block
        if (block.torque_Nm is None and block.current_A is None) or block.position_rad is None:
            return []
        period = sample_period(block.time_s)
        for piece in (p for p in pieces(block) if len(p) >= FEWEST):
            effort = piece.torque_Nm if piece.torque_Nm is not None else piece.current_A
            assert effort is not None
            if piece.current_mean and piece.torque_Nm is None:  # each over the interval that ends at its sample
                effort = effort[1:]
            unread = np.where(alive(effort), 0.0, 0.5 * resolution(effort))
            stretch = even_stretch(piece, effort, period)
            out.append(_Piece(stretch, number, even_stretch(piece, unread, period).effort))
    return out


def _runs(segments: Sequence[Segment], recording: int, time: F64) -> NDArray[np.int64]:
    """Numbers of the free runs in which instants of a recording, s since its first sample, are; shape (w,)."""
    out = np.full(len(time), NOWHERE, dtype=np.int64)
    for k, segment in enumerate(segments):
        if segment.recording == recording:
            out[(time >= segment.rows[0, TIME]) & (time <= segment.rows[-1, TIME])] = k
    return out


def _motion(stretches: Sequence[EvenStretch], f: Filter, p: Mapping[str, float], instants: int) -> Motion:
    """Filtered position, speed and acceleration as the formulas of the screening take them."""
    moved = [kinematics(s, f) for s in stretches]

    def every(series: Iterable[F64 | None]) -> F64:
        pairs = zip(stretches, series, strict=True)
        return np.concatenate([_instants(s, x, instants) for s, x in pairs if x is not None])

    still = [
        rests(_instants(s, m.speed, instants), _REST_SIGMA * speed_noise(s, f), max(3, f.decimation) * instants)
        for s, m in zip(stretches, moved, strict=True)
    ]
    effort = np.concatenate([np.repeat(s.effort, instants) for s in stretches])
    time = every(s.time_s for s in stretches)
    rate = np.concatenate([np.gradient(s.effort) for s in stretches]) * f.rate_Hz
    return Motion(
        p=p,
        t=time,
        h=np.full(len(time), 1.0 / (f.rate_Hz * instants)),
        u=effort,
        i=effort,
        omega=every(m.speed for m in moved),
        theta=every(m.position for m in moved),
        i_rate=np.repeat(rate, instants),
        omega_rate=every(m.acceleration for m in moved),
        at_sample={},
        rest=np.concatenate(still),
    )


def _instants(s: EvenStretch, series: F64, instants: int) -> F64:
    """A series of samples; where the effort is that of the intervals, at so many instants spread over each."""
    from scipy.interpolate import CubicSpline

    if not s.by_intervals:
        return series
    at = np.arange(len(series) - 1)[:, None] + (np.arange(instants) + 0.5) / instants
    return np.asarray(CubicSpline(np.arange(len(series)), series)(at.ravel()))
