"""The shaft's balance in integral form, for motions that rest: no filter smears a rest's unknown friction into a slide.

Multiplied by φ(t) = s³(1 − s)³ over a window that lies wholly within a slide, and integrated by parts (Shinbrot 1957):

    ∫φ κu = J ∫φ'' θ − B ∫φ' θ + Tc sgn(ω) ∫φ + …

Nothing is differentiated and no grid is needed: jittered instants and lost samples enter as they are, with the signals
between the samples by a local cubic (Akima, *J. ACM* 17, 1970).

A shaft slides where it goes on by more than the sensor's resolution, before and after: one threshold for the capture.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.polynomial import polynomial as poly
from numpy.typing import NDArray

from servo_daemon.identification.inverse_dynamics.filter import Filter
from servo_daemon.identification.inverse_dynamics.shaft import Kinematics, shaft_columns
from servo_daemon.identification.inverse_dynamics.signals import measured
from servo_daemon.identification.inverse_dynamics.solve import MakeRows
from servo_daemon.numerics import sample_period, white_noise_var
from servo_daemon.samples import F64, SampleBlock

#: φ and its derivatives on 0..1.
_PHI = poly.polypow([0.0, 1.0, -1.0], 3)
_DERIVATIVES = (_PHI, poly.polyder(_PHI), poly.polyder(_PHI, 2))
#: Gauss points of every interval, on −1..1, and their weights: exact for φ'' times a cubic.
_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(4)
#: To go on means by more than so many steps of the sensor (a resting encoder flickers by one), over the time in which
#: it goes so many at the speeds that are usual in motion.
_STEPS, _USUAL_STEPS = 2.5, 25.0
#: ... which are those of this share of the samples, the fastest.
_FASTEST = 90.0
_LONGEST_LOOK = 200
#: The step of a sensor that shows no step: so many standard deviations of its noise.
_NOISE_STEPS = 4.0
#: Fewer different values than this share of the samples: the sensor has steps.
_HAS_STEPS = 0.7
#: A slide goes on over a gap of so many usual periods.
_BRIDGED = 5.0
#: Windows: parts of a usual slide that are tried, samples that one must have, and the share (power) of its second
#: derivative that may be the sensor's noise: by so much J comes out too small.
_PARTS, _LEAST_SAMPLES, _NOISE_SHARE = (1 / 4, 1 / 3, 1 / 2, 2 / 3, 1.0), 8, 1e-3
#: Windows follow each other by this part of their length.
_HOP = 0.5


#: Parts between invalid samples that are shorter are left out.
_FEWEST = 10
#: The integral form is used where the shaft rests or turns round in more than this share of the samples, or where gaps
#: leave less than this share of them for a filter.
_MUCH_REST, _MOST_CUT = 0.5, 0.9


@dataclass(frozen=True, slots=True)
class Slide:
    """Samples from `begin` up to `end` (one beyond the last) that slide in the direction ±1."""

    begin: int
    end: int
    direction: int


def sensor_step(position: F64) -> float:
    """The step of a position's sensor, or what its noise amounts to."""
    different = np.unique(position)
    if 2 < len(different) < _HAS_STEPS * len(position):
        return float(np.percentile(np.diff(different), 10.0))
    return _NOISE_STEPS * float(np.sqrt(white_noise_var(position)))


def slides(block: SampleBlock, step: float) -> list[Slide]:
    """Where the shaft slides for certain.

    Args:
        step: of the position's sensor.
    """
    x, t = block.position_rad, block.time_s
    assert x is not None
    usual = float(np.percentile(np.abs(np.diff(x)), _FASTEST))
    if usual <= 0.0:
        return []
    m = int(np.clip(np.ceil(_USUAL_STEPS * step / usual), 1, min(_LONGEST_LOOK, max(1, len(x) // 4))))
    ahead = np.zeros(len(x))
    ahead[:-m] = x[m:] - x[:-m]
    behind = np.concatenate([np.zeros(m), ahead[:-m]])
    sure = np.minimum(np.abs(ahead), np.abs(behind)) > _STEPS * step
    sign = np.where(sure & (np.sign(ahead) == np.sign(behind)), np.sign(ahead), 0.0)
    broken = np.diff(t) > _BRIDGED * sample_period(t)
    edges = np.flatnonzero((np.diff(sign) != 0.0) | broken) + 1
    parts = np.concatenate([[0], edges, [len(x)]])
    return [
        Slide(int(a), int(b), int(sign[a])) for a, b in pairwise(parts) if sign[a] != 0.0 and b - a >= _LEAST_SAMPLES
    ]


@dataclass(frozen=True, slots=True)
class Moves:
    """Blocks with the slides in each; `step` of the position's sensor."""

    blocks: tuple[SampleBlock, ...]
    slides: tuple[tuple[Slide, ...], ...]
    step: float

    @property
    def samples(self) -> int:
        """How many samples slide."""
        return sum(s.end - s.begin for of in self.slides for s in of)

    def note(self, samples: int) -> str:
        """How many of so many samples are not used."""
        return (
            f"{samples - self.samples} of {samples} samples are not used for the shaft: it rests there, or turns round "
            f"(slower than the sensor's step of {self.step:.2g} shows); what slides is taken in integral form"
        )


def moves_of(blocks: Sequence[SampleBlock], filtered: int) -> Moves | None:
    """Where the shaft slides, for the integral form; None where it rests too little for that.

    Args:
        filtered: samples that a filter could take.
    """
    parts = [part for block in blocks for part in measured(block) if len(part) >= _FEWEST]
    positions = [part.position_rad for part in parts if part.position_rad is not None]
    if not parts or len(positions) < len(parts):
        return None
    step, samples = max(map(sensor_step, positions)), sum(map(len, parts))
    moves = Moves(tuple(parts), tuple(tuple(slides(part, step)) for part in parts), step)
    rests = moves.samples < (1.0 - _MUCH_REST) * samples
    return moves if moves.samples and (rests or filtered < _MOST_CUT * samples) else None


@dataclass(frozen=True, slots=True)
class SlidingPiece:
    """A capture with its slides and the effort of its samples, shape (n,), or intervals, shape (n − 1,)."""

    block: SampleBlock
    slides: Sequence[Slide]
    effort: F64


@dataclass(frozen=True, slots=True)
class _Window:
    piece: SlidingPiece
    direction: int
    start_s: float


def window_length(pieces: Sequence[SlidingPiece], step: float) -> float:
    """s: the shortest window whose second derivative is hardly the sensor's noise."""
    lasting = [float(p.block.time_s[s.end - 1] - p.block.time_s[s.begin]) for p in pieces for s in p.slides]
    usual = float(np.median(lasting))
    period = float(np.median(np.concatenate([np.diff(p.block.time_s) for p in pieces])))
    lengths = [part * usual for part in _PARTS if part * usual >= _LEAST_SAMPLES * period] or [usual]
    variance = step**2 / 12.0
    for length in lengths:
        columns = np.array([_integrals(w, length, (2,), ())[0][0] for w in _windows(pieces, length)])
        squares = poly.polyval(1.0, poly.polyint(poly.polymul(_DERIVATIVES[2], _DERIVATIVES[2])))
        noise = variance * period * float(squares) / length**3
        if len(columns) and noise < _NOISE_SHARE * float(np.mean(columns**2)):
            return length
    return lengths[-1]


def rows_in_windows(
    moves: Moves, make_effort: Callable[[SampleBlock], F64], effects: Sequence[str], rate_Hz: float
) -> tuple[MakeRows, Filter]:
    """The rows' maker for `solve_shaft`, and its windows as a filter, for the report: φ lets pass what is slower.

    Args:
        make_effort: torque or current of a block, at its samples, shape (n,), or of its intervals, shape (n − 1,).
        rate_Hz: of the samples.
    """
    pieces = [SlidingPiece(b, s, make_effort(b)) for b, s in zip(moves.blocks, moves.slides, strict=True) if s]
    length = window_length(pieces, moves.step)
    decimation = max(1, round(_HOP * length * rate_Hz))
    shown = Filter(rate_Hz, 1.0 / length, min(2.0 / length, rate_Hz / 2), decimation, 8, (0, 0))
    return partial(integral_rows, pieces, length, effects), shown


def integral_rows(
    pieces: Sequence[SlidingPiece],
    length: float,
    effects: Sequence[str],
    gravity: tuple[float | None, float | None],
) -> tuple[list[str], F64, F64]:
    """Rows of all windows, as `idim_shaft.rows`; every one divided by ∫φ.

    Args:
        length: of the windows, s.
        gravity: (phi, Tg), see `shaft_columns`.
    """
    scale = length * float(poly.polyval(1.0, poly.polyint(_PHI)))
    names: list[str] = []
    table, times = [], []
    for window in _windows(pieces, length):
        (by_inertia, by_speed), others = _integrals(window, length, (2, 1), effects, gravity)
        columns = {**others, "J": by_inertia}
        if "B_neg" in columns:
            columns["B" if window.direction > 0 else "B_neg"] = -by_speed
        else:
            columns["B"] = -by_speed
        names = list(columns)
        table.append(np.array(list(columns.values())) / scale)
        times.append(window.start_s + length / 2)
    return names, np.array(table), np.array(times)


def _windows(pieces: Sequence[SlidingPiece], length: float) -> list[_Window]:
    out = []
    for piece in pieces:
        t = piece.block.time_s
        for s in piece.slides:
            room = float(t[s.end - 1] - t[s.begin]) - length
            if room >= -1e-9 * length:
                count = 1 + int(max(room, 0.0) / (_HOP * length))
                hop = max(room, 0.0) / max(count - 1, 1)
                out += [_Window(piece, s.direction, float(t[s.begin]) + k * hop) for k in range(count)]
    return out


def _integrals(
    window: _Window,
    length: float,
    orders: tuple[int, ...],
    effects: Sequence[str],
    gravity: tuple[float | None, float | None] = (None, None),
) -> tuple[list[float], dict[str, float]]:
    """∫ of the derivatives of φ with θ, and ∫φ of the model's other columns and of the effort."""
    from scipy.interpolate import Akima1DInterpolator

    t = window.piece.block.time_s
    first = max(int(np.searchsorted(t, window.start_s, side="right")) - 3, 0)
    last = min(int(np.searchsorted(t, window.start_s + length, side="left")) + 3, len(t))
    near, position = t[first:last], window.piece.block.position_rad
    assert position is not None
    at, weights = _gauss_points(near, window.start_s, window.start_s + length)
    s = (at - window.start_s) / length
    origin = float(position[first])
    angle = Akima1DInterpolator(near, position[first:last] - origin)(at)
    derived = [float(np.sum(weights * _phi(s, k, length) * angle)) for k in orders]
    by_phi = weights * _phi(s, 0, length)
    motion = Kinematics(angle + origin, np.full(len(at), float(window.direction)), np.zeros(len(at)))
    columns = shaft_columns(effects, motion, *gravity)
    columns |= {"effort": _effort_at(window.piece, at, first, last), "one": np.ones(len(at))}
    others = {name: float(np.sum(by_phi * c)) for name, c in columns.items()}
    return derived, others | {name: 0.0 for name in ("J", "B", "B_neg") if name in others}


def _phi(s: F64, order: int, length: float) -> F64:
    return np.asarray(poly.polyval(s, _DERIVATIVES[order]) / length**order)


def _gauss_points(t: F64, begin: float, end: float) -> tuple[F64, F64]:
    """Points and weights of the intervals of t, shape (n,), within begin .. end."""
    edges = np.concatenate([[begin], t[(t > begin) & (t < end)], [end]])
    half, middle = np.diff(edges) / 2, (edges[1:] + edges[:-1]) / 2
    return (middle[:, None] + half[:, None] * _POINTS).ravel(), (half[:, None] * _WEIGHTS).ravel()


def _effort_at(piece: SlidingPiece, at: F64, first: int, last: int) -> F64:
    """Of samples: straight between them; of intervals: as it is in each."""
    t = piece.block.time_s
    if len(piece.effort) == len(t):
        return np.interp(at, t[first:last], piece.effort[first:last])
    which: NDArray[np.intp] = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(piece.effort) - 1)
    return np.asarray(piece.effort[which])
