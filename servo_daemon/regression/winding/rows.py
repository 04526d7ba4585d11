"""The winding's balance as rows of a regression, where the voltage is a measurement.

A drive under field-oriented control changes its voltage thousands of times between two samples. What it reports is the
voltage of one instant or a mean, and so is its current; nothing needs to be known of what happened in between:

    v = R i + K ω + L di/dt                   of one instant
    v̄ = R ī + K Δθ/T + L Δi/T                 of means over an interval T, exactly

Rows are added up under a smooth weight over windows, which keeps them exact and averages what is noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from servo_daemon.numerics import sample_period
from servo_daemon.samples import F64, GAP_FACTOR, SampleBlock
from servo_daemon.signal_meaning import SignalMeaning

#: Samples on either side from which a derivative is taken: 5 points are exact to h⁴, 3 points to h².
FINE, COARSE = 2, 1
#: Instants tell of what happens between them as long as the current bends by less than this share of itself: on the
#: plant of tests/recovery/foc the inertia is right to 3 % below, and up to 8 % off above.
RESOLVED = 0.1


@dataclass(frozen=True, slots=True)
class Rows:
    """One equation a row, n of them.

    Attributes:
        voltage, current, speed, current_rate: shape (n,), of the row's instant or interval.
        voltage_rate: shape (n,), V/s: what a voltage of another moment would be off by.
        other_speed, other_rate: the same by a coarser derivative: what the two differ by is what sampling hides.
        bend: shape (n,), A/s: how much more the current changes in the interval after the row's instant than about it.
            A drive whose commands come in step with its samples shows the voltage of that change, or of the one before.
        time_s, step_s: shape (n,), the instant (or the interval's end) and the usual distance of rows.
        skew_s: so far apart may be the moments of a row's voltage and current.
        whole: shape (n,): nothing is missing before it.
    """

    time_s: F64
    step_s: float
    voltage: F64
    current: F64
    speed: F64
    current_rate: F64
    other_speed: F64
    other_rate: F64
    voltage_rate: F64
    bend: F64
    whole: NDArray[np.bool_]
    skew_s: float


def winding_rows(block: SampleBlock, meaning: SignalMeaning, *, by_position: bool = True) -> Rows | None:
    """Rows of a block's samples; None where it has no voltage, current or motion, or fewer than five samples.

    Args:
        block: in a DC motor's units.
        meaning: of its voltage and current.
        by_position: the speed is taken from the position where there is one; False: from the speed channel.
    """
    v, i, theta, omega = block.voltage_V, block.current_A, block.position_rad, block.velocity_rad_s
    if theta is not None and omega is not None:
        theta, omega = (theta, None) if by_position else (None, omega)
    if v is None or i is None or (theta is None and omega is None) or len(block) < 2 * FINE + 1:
        return None
    t = block.time_s
    whole = _whole(block)
    if meaning.of_means:
        return _of_means(t, v, i, theta, omega, whole, meaning)
    if meaning.current == "mean":  # of the two intervals beside the instant
        i = np.append(0.5 * (i[:-1] + i[1:]), i[-1])
    fine, coarse = _Rates(t, FINE), _Rates(t, COARSE)
    if theta is not None:
        speed, other = fine.of(theta), coarse.of(theta)
    else:
        assert omega is not None
        speed = other = omega
    whole = whole & np.roll(whole, -1) & np.roll(whole, -2) & np.roll(whole, 1)
    parts = (v, i, speed, fine.of(i), other, coarse.of(i), fine.of(v), _bend(t, i))
    return _rows(t, parts, whole, sample_period(t), meaning.control_period_s)


def _bend(t: F64, i: F64) -> F64:
    slopes = np.diff(i) / np.diff(t)
    return np.concatenate([[0.0], 0.5 * np.diff(slopes), [0.0]])


def _whole(block: SampleBlock) -> NDArray[np.bool_]:
    """Shape (n,): the sample is good and none is missing between it and the one before."""
    steps = np.diff(block.time_s)
    good: NDArray[np.bool_] = block.quality == 0
    out = good.copy()
    out[0] = False
    out[1:] &= good[:-1] & (steps <= GAP_FACTOR * np.median(steps))
    return out


def _of_means(
    t: F64, v: F64, i: F64, theta: F64 | None, omega: F64 | None, whole: NDArray[np.bool_], meaning: SignalMeaning
) -> Rows:
    step, fine = np.diff(t), _Rates(t, FINE)
    if theta is not None:
        speed = other = np.diff(theta) / step
    else:
        assert omega is not None  # Euler–Maclaurin, its second term with differences
        other = 0.5 * (omega[1:] + omega[:-1])
        speed = other - step / 12.0 * np.diff(fine.of(omega))
    if meaning.current == "mean":
        middle = t - 0.5 * np.append(step[:1], step)
        current, rate, coarse = i[1:], _Rates(middle, FINE).of(i)[1:], _Rates(middle, COARSE).of(i)[1:]
    else:
        current = 0.5 * (i[1:] + i[:-1]) - step / 12.0 * np.diff(fine.of(i))
        rate = coarse = np.diff(i) / step
    v_mean = v[:-1] if meaning.voltage == "held" else v[1:]  # a held one acts from its sample on
    parts = (v_mean, current, speed, rate, other, coarse, fine.of(v)[1:], np.zeros(len(step)))
    ahead = whole & np.roll(whole, -1) & np.roll(whole, -2)
    return _rows(t[1:], parts, ahead[1:], float(np.median(step)), meaning.control_period_s)


def _rows(t: F64, parts: tuple[F64, ...], whole: NDArray[np.bool_], step_s: float, skew_s: float) -> Rows:
    """Without the ends, whose derivatives are of their neighbours; parts in the order of `Rows`. Where a part is no
    number (a sample that was not measured reaches into its neighbours' derivatives) the row is none either."""
    known = np.isfinite(parts).all(axis=0)
    whole, parts = whole & known, tuple(np.where(known, p, 0.0) for p in parts)
    cut = slice(FINE, len(t) - FINE)
    v, i, speed, rate, other_speed, other_rate, v_rate, bend = (p[cut] for p in parts)
    return Rows(t[cut], step_s, v, i, speed, rate, other_speed, other_rate, v_rate, bend, whole[cut], skew_s)


class _Rates:
    """d/dt at every sample by the polynomial through `reach` samples on either side, of any distances; at the ends that
    of the nearest sample which has so many."""

    def __init__(self, t: F64, reach: int) -> None:
        self._reach, self._width = reach, 2 * reach + 1
        self._usual = sample_period(t)
        d = (sliding_window_view(t, self._width) - t[reach : len(t) - reach, None]) / self._usual
        V = np.swapaxes(d[:, :, None] ** np.arange(self._width), 1, 2)
        unit = np.zeros((len(d), self._width, 1))
        unit[:, 1] = 1.0
        self._weights = np.linalg.solve(V, unit)[:, :, 0]

    def of(self, x: F64) -> F64:
        """Values of a column, shape (n,)."""
        inner = np.einsum("nw,nw->n", self._weights, sliding_window_view(x, self._width)) / self._usual
        return np.concatenate([np.full(self._reach, inner[0]), inner, np.full(self._reach, inner[-1])])


def unresolved(parts: Sequence[Rows]) -> float:
    """What of the current a line between samples two apart does not follow, as a share of its size (rms): how far what
    happens between samples is unknown."""
    left, size, n = 0.0, 0.0, 0
    for rows in parts:
        bend = 0.25 * (rows.current[2:] - 2.0 * rows.current[1:-1] + rows.current[:-2])[rows.whole[1:-1]]
        left, size, n = left + float(bend @ bend), size + float(rows.current @ rows.current), n + len(bend)
    return math.sqrt(left / size) if size > 0.0 and n else 0.0


def joined(parts: Sequence[Rows]) -> Rows:
    """Rows that follow on each other; at least one part."""
    one = ("step_s", "skew_s")
    arrays = {f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Rows) if f.name not in one}
    step_s, skew_s = float(np.median([p.step_s for p in parts])), max(p.skew_s for p in parts)
    return Rows(step_s=step_s, skew_s=skew_s, **arrays)


@dataclass(frozen=True, slots=True)
class Sums:
    """Rows added up under a smooth weight over w windows.

    Attributes:
        X, other: shape (w, 3): current, current's rate, speed; and by the coarser derivatives.
        y, y_rate: shape (w,): voltage, and its rate.
        bend: shape (w,): of the current.
        last: shape (w,), the last row of each window.
    """

    X: F64
    other: F64
    y: F64
    y_rate: F64
    bend: F64
    last: NDArray[np.intp]


def added_up(rows: Rows, length: int) -> Sums:
    """Windows of `length` rows that overlap by half, none over a gap; possibly none."""
    phi = np.hanning(length + 2)[1:-1] if length > 1 else np.ones(1)
    phi /= phi.sum()
    parts = (rows.current, rows.current_rate, rows.speed, rows.other_rate, rows.other_speed)
    signals = np.stack([*parts, rows.voltage, rows.voltage_rate, rows.bend], axis=1)
    first = np.arange(0, len(signals) - length + 1, max(1, length // 2), dtype=np.intp)
    if len(first):
        lost = np.concatenate([[0], np.cumsum(~rows.whole)])
        first = first[lost[first + length] == lost[first]]
    sums = np.empty((0, 8))
    if len(first):
        sums = sliding_window_view(signals, length, axis=0)[first] @ phi
    return Sums(sums[:, :3], sums[:, [0, 3, 4]], sums[:, 5], sums[:, 6], sums[:, 7], first + length - 1)
