"""From recordings to a `Problem`: which signals drive and which answer, where to cut, what is free."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from servo_daemon.conditioning.layout import INVALID_BIT
from servo_daemon.errors import BadInputError
from servo_daemon.identification.output_error.problem.inputs import STRAIGHT, input_rows
from servo_daemon.identification.output_error.problem.problem import Problem, Segment
from servo_daemon.identification.output_error.problem.still import has_held_shaft, moves
from servo_daemon.kalman.gaussian import to_coordinate
from servo_daemon.numerics import sample_period
from servo_daemon.plant.build import PlantModel, build_plant
from servo_daemon.plant.core import Drive
from servo_daemon.samples import F64, SampleBlock

#: Constant offsets of sensors and load: every recording has its own.
OFFSETS = ("TL", "i0", "v0")
#: A recording is cut where more than this many usual periods, and more than `_LONG_GAP_S`, passed without a sample:
#: what the input did meanwhile is not known.
_LONG_GAP_PERIODS, _LONG_GAP_S = 10.0, 0.1
#: Fewest samples in a segment: each brings three unknown initial values along.
FEWEST_SAMPLES = 10
#: A speed below this share of its size is none; and what is left of the current's size at a standstill.
_STANDS, _NO_CURRENT = 0.05, 1e-6
#: Samples over which the speed at the beginning of a segment is guessed.
SLOPE_SAMPLES = 15


@dataclass(frozen=True, slots=True)
class Recording:
    """A capture as the fit takes it, n samples.

    Attributes:
        name: for messages.
        block: its samples.
        seen: shape (n,): where its measurements are fitted; None: everywhere. The input is known all the time.
    """

    name: str
    block: SampleBlock
    seen: NDArray[np.bool_] | None = None

    @property
    def seen_block(self) -> SampleBlock:
        """The samples that may be looked at."""
        return self.block if self.seen is None else self.block.select(self.seen)


def choose_signals(channels: Sequence[str]) -> tuple[Drive, tuple[str, ...]]:
    """The input and the channels that answer it. A position tells more than a speed derived from it.

    Raises:
        BadInputError: no pair of an input and a response.
    """
    motion = tuple(c for c in ("position_rad", "velocity_rad_s") if c in channels)[:1]
    if "voltage_V" in channels and (motion or "current_A" in channels):
        return "voltage", (*(c for c in ("current_A",) if c in channels), *motion)
    for drive, name in (("current", "current_A"), ("torque", "torque_Nm")):
        if name in channels and motion:
            return drive, motion  # type: ignore[return-value]
    raise BadInputError(f"no pair of an input and a response among: {', '.join(channels) or 'nothing'}")


def without_dead_current(recordings: Sequence[Recording]) -> tuple[Recording, ...]:
    """Without a current that never changes in any of them, where the shaft moves under a known voltage: a sensor that
    is not there."""
    blocks = [r.block for r in recordings]
    dead = all(b.voltage_V is not None and b.current_A is not None and not moves(b.current_A) for b in blocks)
    if dead and any(moves(b.position_rad) or moves(b.velocity_rad_s) for b in blocks):
        return tuple(replace(r, block=replace(r.block, current_A=None)) for r in recordings)
    return tuple(recordings)


def common_channels(recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Channels that all recordings carry."""
    first, *others = (r.block.channels for r in recordings)
    return tuple(c for c in first if all(c in other for other in others))


def make_problem(
    recordings: Sequence[Recording],
    effects: tuple[str, ...],
    fixed: Mapping[str, float],
    *,
    segment_s: float | None = None,
    input_share: float = STRAIGHT,
) -> Problem:
    """The fit of a motor with these effects to these recordings.

    Args:
        fixed: parameters held at a value, natural units.
        segment_s: cut recordings into pieces of about this length, each with an initial state of its own.
        input_share: where between two samples of a current or torque its mean over the step lies, see `input_error.py`.

    Raises:
        BadInputError: no usable signals, too few samples, or a fixed parameter that the model does not have.
    """
    drive, measured = choose_signals(common_channels(recordings))
    plant = build_plant(effects, drive).for_runs_of(
        max(sample_period(r.block.time_s) for r in recordings),
        mean_current="current_A" in measured and all(r.block.current_mean for r in recordings),
    )
    table = {p.name: p for p in plant.parameters}
    for name, value in fixed.items():
        if name in table and not (isfinite(value) and table[name].lower <= value <= table[name].upper):
            raise BadInputError(f"{name} = {value:g} is outside {table[name].lower:g} .. {table[name].upper:g}")
    held = drive == "voltage" and "current_A" in measured
    blocked = frozenset(k for k, r in enumerate(recordings) if held and has_held_shaft(r.block))
    if len(blocked) == len(recordings):
        measured = ("current_A",)
    segments = [s for k, r in enumerate(recordings) for s in _segments(k, r, plant, measured, (segment_s, input_share))]
    segments = [_of_the_winding(s, measured) if s.recording in blocked else s for s in segments]
    if not segments:
        raise BadInputError(f"too few samples: a stretch of at least {FEWEST_SAMPLES} without a long gap is needed")
    names = [n for n in plant.parameter_names if n not in fixed]
    local = tuple(n for n in names if n in OFFSETS) if len(recordings) > 1 else ()
    free = tuple(n for n in names if n not in local)
    given = {name: to_coordinate(table[name], value) for name, value in fixed.items() if name in table}
    return Problem(plant, measured, tuple(segments), free, local, given, len(recordings), blocked=blocked)


def carrying(problem: Problem, recordings: Sequence[Recording]) -> Problem:
    """The same with derivatives by differences, and with effects' own states (a winding's heat, a shaft's twist) going
    on from segment to segment: a state that each of them could choose would follow any noise, and hides the parameters
    of what is slow."""
    firsts = [next((s for s in problem.segments if s.recording == k), None) for k in range(len(recordings))]
    whole = tuple(
        (np.array([s.initial for s in problem.plant.states]) if first is None else first.x0, rows)
        for first, rows in zip(firsts, (input_rows(r.block, problem.plant.drive) for r in recordings), strict=True)
    )
    return replace(problem, exact=False, whole=whole)


def _segments(
    recording: int,
    of: Recording,
    plant: PlantModel,
    measured: tuple[str, ...],
    cutting: tuple[float | None, float],
) -> list[Segment]:
    segment_s, share, block = *cutting, of.block
    time = block.time_s - block.time_s[0]
    values = np.stack([_channel(block, name) for name in measured], axis=1)
    valid = np.isfinite(values) & np.stack([_is_measured(block, name) for name in measured], axis=1)
    if of.seen is not None:
        valid &= of.seen[:, None]
    scale = state_scale(of.seen_block, plant)
    rows = input_rows(block, plant.drive, share)
    out = []
    for begin, end in _cuts(time, segment_s):
        if end - begin >= FEWEST_SAMPLES and (of.seen is None or of.seen[begin:end].any()):
            x0 = _initial_state(block, plant, begin, end)
            part, fitted = values[begin:end], valid[begin:end].copy()
            if plant.mean_current:  # of the interval before the run
                fitted[0, measured.index("current_A")] = False
            out.append(Segment(recording, rows[begin:end].copy(), part, fitted, x0, scale, begin))
    return out


def _of_the_winding(segment: Segment, measured: tuple[str, ...]) -> Segment:
    """A held shaft's segment: its motion is known and tells nothing else."""
    return replace(segment, valid=segment.valid & np.array([c == "current_A" for c in measured]))


def _is_measured(block: SampleBlock, name: str) -> NDArray[np.bool_]:
    """Shape (n,)."""
    bit = int(INVALID_BIT.get(name, 0))
    return np.asarray((block.quality & bit) == 0)


def _channel(block: SampleBlock, name: str) -> F64:
    values: F64 = getattr(block, name)
    return values


def _cuts(time: F64, segment_s: float | None) -> list[tuple[int, int]]:
    distance = np.diff(time)
    gap = max(_LONG_GAP_PERIODS * float(np.median(distance)), _LONG_GAP_S)
    edges = [0, *(np.flatnonzero(distance > gap) + 1).tolist(), len(time)]
    cuts = []
    for begin, end in pairwise(edges):
        pieces = 1
        if segment_s is not None and end - begin > 1:
            pieces = max(1, round(min(float(time[end - 1] - time[begin]) / segment_s, end - begin)))
        inner = np.linspace(begin, end, pieces + 1).astype(int)
        cuts += list(pairwise(inner.tolist()))
    return cuts


def _initial_state(block: SampleBlock, plant: PlantModel, begin: int, end: int) -> F64:
    """A guess from the first samples: current and angle as measured, speed from the slope of the angle."""
    x0 = np.array([s.initial for s in plant.states])
    names = plant.state_names
    few = slice(begin, min(end, begin + SLOPE_SAMPLES))
    if "current_A" in names and block.current_A is not None:
        x0[names.index("current_A")] = block.current_A[begin]
    if block.position_rad is not None:
        slope, first = np.polyfit(block.time_s[few] - block.time_s[begin], block.position_rad[few], 1)
        x0[names.index("position_rad")], x0[names.index("velocity_rad_s")] = first, slope
    elif block.velocity_rad_s is not None:
        x0[names.index("velocity_rad_s")] = np.mean(block.velocity_rad_s[few])
    return x0


def state_scale(block: SampleBlock, plant: PlantModel) -> F64:
    """How large each state is over a recording, shape (nx,): for priors and for units, not for results."""
    scale = np.array([s.scale for s in plant.states])
    sizes = {"current_A": current_size(block), "velocity_rad_s": speed_size(block)}
    if block.position_rad is not None:
        sizes["position_rad"] = float(np.ptp(block.position_rad)) or 1.0
    if _is_step_from_rest(block):
        sizes["current_A"] *= _NO_CURRENT
    for name, size in sizes.items():
        if name in plant.state_names and size > 0:
            scale[plant.state_names.index(name)] = size
    return scale


def _is_step_from_rest(block: SampleBlock) -> bool:
    """One voltage all the time, and a shaft that stands at the first sample: what stands without a voltage has no
    current, and a winding that could have any would answer as slowly or fast as it likes."""
    v, speed = block.voltage_V, block.velocity_rad_s
    if v is None or speed is None or block.current_A is not None or moves(v):
        return False
    return bool(abs(speed[0]) < _STANDS * size_of(speed))


def size_of(values: F64) -> float:
    """The 95th percentile of the modulus: not moved by a few wild samples."""
    return float(np.percentile(np.abs(values), 95.0))


def current_size(block: SampleBlock) -> float:
    """A: as measured; without a sensor what the voltage drives through 1 Ω."""
    if block.current_A is not None:
        return size_of(block.current_A)
    return size_of(block.voltage_V) if block.voltage_V is not None else 1.0


def speed_size(block: SampleBlock) -> float:
    """rad/s: as measured, or from differences of the angle over 20 samples."""
    if block.velocity_rad_s is not None and block.position_rad is None:
        return size_of(block.velocity_rad_s)
    if block.position_rad is None:
        return 0.0
    reach = min(20, len(block) - 1)
    return size_of(
        (block.position_rad[reach:] - block.position_rad[:-reach]) / (block.time_s[reach:] - block.time_s[:-reach])
    )


def acceleration_size(block: SampleBlock) -> float:
    """rad/s²: from differences of the speed over 20 samples."""
    reach = min(20, (len(block) - 1) // 2)
    if reach < 1 or (block.position_rad is None and block.velocity_rad_s is None):
        return 0.0
    t = block.time_s
    if block.position_rad is None:
        assert block.velocity_rad_s is not None
        speed, at = block.velocity_rad_s, t
    else:
        speed = (block.position_rad[reach:] - block.position_rad[:-reach]) / (t[reach:] - t[:-reach])
        at = t[reach:]
    return size_of((speed[reach:] - speed[:-reach]) / (at[reach:] - at[:-reach]))
