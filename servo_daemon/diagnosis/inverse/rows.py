"""The shaft's balance of whole captures as rows of a regression: the torque that the measured motion needs.

    K i = J dω/dt + B ω + τ_effects(θ, ω)         (a torque, where that is the input, in the place of K i)

Nothing is simulated: position and speed are the measured ones, filtered as for inverse-dynamic identification.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.identification.inverse_dynamics.filter import Filter, FilterChoice, choose, rests
from servo_daemon.identification.inverse_dynamics.shaft import kinematics, speed_noise
from servo_daemon.identification.inverse_dynamics.signals import EvenStretch, even_stretch, pieces
from servo_daemon.identification.output_error.problem.problem import Segment
from servo_daemon.identification.output_error.problem.rollout import TIME
from servo_daemon.numerics import sample_period
from servo_daemon.plant.columns.screening import Motion
from servo_daemon.samples import F64

#: Shorter pieces between gaps are left out; see also `Filter.shortest`.
_FEWEST = 50
#: Below so many standard deviations of its own noise a speed is rest.
_REST_SIGMA = 4.0
#: A row in no free run of the split.
NOWHERE = -1


@dataclass(frozen=True)
class BalanceRows:
    """The balance of captures, n samples and w rows.

    Attributes:
        motion: of all stretches one after the other, shapes (n,); `u` and `i` are the measured effort.
        factor: torque by effort: K, or 1 where the input is a torque.
        torque: shape (w,), factor times the effort, filtered, N·m.
        run: shape (w,), number of the free run of the split that a row is in, or `NOWHERE`.
        part: shape (w,), the part of the split, or `NOWHERE`.
        filter: what smooths and decimates.
        lengths: samples of each stretch.
    """

    motion: Motion
    factor: float
    torque: F64
    run: NDArray[np.int64]
    part: NDArray[np.int64]
    filter: Filter
    lengths: tuple[int, ...]

    def filtered(self, column: F64) -> F64:
        """A column of samples, shape (n,), as rows, shape (w,)."""
        parts = np.split(column, np.cumsum(self.lengths)[:-1])
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
    stretches, owner = _stretches(data)
    if not stretches:
        return None
    efforts = [s.effort for s in stretches]
    f = choose(FilterChoice(), stretches[0].rate_Hz, [s.motion for s in stretches], efforts, 2)
    kept = [(s, k) for s, k in zip(stretches, owner, strict=True) if len(s.effort) >= f.shortest]
    if not kept:
        return None
    factor = p.get("K", 1.0)
    segments = data.problem(effects, {}).segments
    begins = [r.block.time_s[0] for r in data.recordings]
    run = np.concatenate([_runs(segments, k, f.pick(s.time_s) - begins[k]) for s, k in kept])
    return BalanceRows(
        motion=_motion([s for s, _ in kept], f, {**p, "K": factor}),
        factor=factor,
        torque=factor * np.concatenate([f.decimate(s.effort[:, None])[:, 0] for s, _ in kept]),
        run=run,
        part=np.where(run == NOWHERE, NOWHERE, data.split.part[run]),
        filter=f,
        lengths=tuple(len(s.effort) for s, _ in kept),
    )


def _stretches(data: Data) -> tuple[list[EvenStretch], list[int]]:
    """Pieces of the recordings on even grids, and the recording that each is of."""
    out: list[EvenStretch] = []
    owner: list[int] = []
    for number, recording in enumerate(data.recordings):
        block = recording.block
        effort = block.torque_Nm if block.torque_Nm is not None else block.current_A
        if effort is None or block.position_rad is None:
            return [], []
        period = sample_period(block.time_s)
        for piece in (p for p in pieces(block) if len(p) >= _FEWEST):
            measured = piece.torque_Nm if piece.torque_Nm is not None else piece.current_A
            assert measured is not None
            out.append(even_stretch(piece, measured, period))
            owner.append(number)
    return out, owner


def _runs(segments: Sequence[Segment], recording: int, time: F64) -> NDArray[np.int64]:
    """Numbers of the free runs in which instants of a recording, s since its first sample, are; shape (w,)."""
    out = np.full(len(time), NOWHERE, dtype=np.int64)
    for k, segment in enumerate(segments):
        if segment.recording == recording:
            out[(time >= segment.rows[0, TIME]) & (time <= segment.rows[-1, TIME])] = k
    return out


def _motion(stretches: Sequence[EvenStretch], f: Filter, p: Mapping[str, float]) -> Motion:
    """Filtered position, speed and acceleration as the formulas of the screening take them."""
    moved = [kinematics(s, f) for s in stretches]
    effort = np.concatenate([s.effort for s in stretches])
    time = np.concatenate([s.time_s for s in stretches])
    omega = np.concatenate([m.speed for m in moved])
    theta = np.concatenate([m.position for m in moved if m.position is not None])
    still = [
        rests(m.speed, _REST_SIGMA * speed_noise(s, f), max(3, f.decimation))
        for s, m in zip(stretches, moved, strict=True)
    ]
    return Motion(
        p=p,
        t=time,
        h=np.full(len(time), 1.0 / f.rate_Hz),
        u=effort,
        i=effort,
        omega=omega,
        theta=theta,
        i_rate=np.gradient(effort) * f.rate_Hz,
        omega_rate=np.concatenate([m.acceleration for m in moved]),
        at_sample={},
        rest=np.concatenate(still),
    )
