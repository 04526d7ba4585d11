"""A recording through the daemon's own pipeline with its default settings, as `Track`: what was published, tick by
tick, and what was said."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.base import DriveInfo
from servo_daemon.config import DriveConfig
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.published.snapshot import Estimate
from servo_daemon.samples import F64, SampleBlock, make_block
from tests.recovery.generator import Motor, Recording

Flags = NDArray[np.bool_]
Said = Mapping[str, float | int | str | None]

NAMES = ("R", "L", "K", "J", "B")
MOTIONS = ("multisine", "prbs", "pick_and_place")
BURN_IN_S = 20.0
#: A Gaussian's 95 % interval, in standard deviations.
Z95 = 1.96
_BLOCK_S = 0.1


@dataclass(frozen=True, slots=True)
class Told:
    """A message of the pipeline; `time_s` is the end of the block (0.1 s) after which it was there."""

    time_s: float
    kind: str
    message: str
    data: Said


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """What the pipeline published, one row a tick (0.1 s).

    Attributes:
        names: of the parameters, the linear motor's first.
        time_s: device time, shape (m,).
        value, std: in the parameters' units, shape (m, parameters); NaN where nothing is published.
        status: as published, shape (m, parameters).
        white: `health.innovation_white` (None: True), shape (m,).
        told: events in their order.
    """

    names: tuple[str, ...]
    time_s: F64
    value: F64
    std: F64
    status: NDArray[np.str_]
    white: Flags
    told: tuple[Told, ...]

    @property
    def tracking(self) -> Flags:
        """Shape (m, parameters)."""
        return np.asarray(self.status == "tracking")


def sampled(truth: Mapping[str, F64], time_s: F64, names: tuple[str, ...], at_s: F64) -> F64:
    """True parameters as they held at given instants, shape (m, names).

    Args:
        truth: parameter -> shape (n,), each value held until the next sample.
        time_s: the samples' instants, shape (n,).
    """
    index = np.clip(np.searchsorted(time_s, at_s + 1e-6, side="right") - 1, 0, len(time_s) - 1)
    return np.column_stack([truth[name][index] for name in names])


def deviations(track: Track, truth: Mapping[str, F64], time_s: F64, names: tuple[str, ...]) -> tuple[F64, F64]:
    """(value − truth)/std while a parameter is `tracking`, else 0, and value − truth; shapes (m, names).

    Args:
        truth, time_s: as for `sampled`.
    """
    at = [track.names.index(name) for name in names]
    error = track.value[:, at] - sampled(truth, time_s, names, track.time_s)
    return np.where(track.tracking[:, at], error / track.std[:, at], 0.0), error


def info_of(recording: Recording) -> DriveInfo:
    """What a driver would know: the encoder's counts."""
    counts = recording.metadata.get("counts_per_rev")
    return DriveInfo("benchmark", counts_per_rev=None if counts is None else float(counts))


def tracked(
    recording: Recording,
    nominal: Mapping[str, float],
    model: tuple[str, ...] = (),
    drift: Mapping[str, str] | None = None,
) -> Track:
    """The recording through a pipeline, in blocks of 0.1 s.

    Args:
        nominal: datasheet values, in SI units.
        model: effects on top of the linear motor.
        drift: in the configuration's words, such as {"R": "5 %/sqrt(min)"}.
    """
    config = DriveConfig(nominal=dict(nominal), model=model, drift=dict(drift or {}))
    pipeline = Pipeline(config, info_of(recording))
    estimates: list[Estimate] = []
    told: list[Told] = []
    edges = np.searchsorted(recording.time_s, np.arange(recording.time_s[0], recording.time_s[-1], _BLOCK_S)[1:])
    for a, b in zip([0, *edges], [*edges, len(recording.time_s)], strict=True):
        if b <= a:
            continue
        estimates += pipeline.process(block_of(recording, a, b))
        told += [Told(float(recording.time_s[b - 1]), *m) for m in pipeline.messages[len(told) :]]
    last = pipeline.finish()
    told += [Told(float(recording.time_s[-1]), *m) for m in pipeline.messages[len(told) :]]
    return _as_track(estimates if last is None else [*estimates, last], tuple(told))


def block_of(recording: Recording, a: int = 0, b: int | None = None) -> SampleBlock:
    """Samples a to b - 1, or to the last; copies, as a block makes its arrays read-only."""
    return make_block(
        recording.time_s[a:b].copy(),
        voltage_V=recording.voltage_V[a:b].copy(),
        current_A=recording.current_A[a:b].copy(),
        position_rad=recording.position_rad[a:b].copy(),
    )


def _as_track(estimates: list[Estimate], told: tuple[Told, ...]) -> Track:
    def numbers(attribute: str) -> F64:
        rows = [[getattr(p, attribute) for p in e.parameters] for e in estimates]
        return np.array(rows, dtype=np.float64)

    return Track(
        names=tuple(p.name for p in estimates[0].parameters),
        time_s=np.array([e.time_s for e in estimates]),
        value=numbers("value"),
        std=numbers("std"),
        status=np.array([[p.status for p in e.parameters] for e in estimates]),
        white=np.array([e.health["innovation_white"] is not False for e in estimates]),
        told=told,
    )


def nominal_of(motor: Motor, factor: float = 1.4) -> dict[str, float]:
    """A datasheet that is wrong by this factor in everything."""
    return {name: factor * float(getattr(motor, name)) for name in NAMES}
