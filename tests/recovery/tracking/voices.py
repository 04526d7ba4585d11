"""What the regression, the filter and the daemon itself say of the same samples, tick by tick.

`follow.tracked` keeps what is published; here the estimators beside it are kept as well.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drivers.base import DriveInfo
from servo_daemon.config import DriveConfig
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.published.snapshot import Estimate
from servo_daemon.samples import F64, SampleBlock
from tests.recovery.generator import Recording
from tests.recovery.tracking.follow import Flags, Told, block_of

VOICES = ("rls", "ekf", "published")
_BLOCK_S = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Heard:
    """One row a tick (0.1 s).

    Attributes:
        names: parameters, the linear motor's first, then J_d where J_m is nominal.
        time_s: device time, shape (m,).
        value, std: voice -> shape (m, names), in the parameters' units; NaN where nothing is said.
        status: as published, shape (m, names).
        white: `health.innovation_white` (None: True), shape (m,).
        told: events in their order.
    """

    names: tuple[str, ...]
    time_s: F64
    value: Mapping[str, F64]
    std: Mapping[str, F64]
    status: NDArray[np.str_]
    white: Flags
    told: tuple[Told, ...]

    @property
    def tracking(self) -> Flags:
        """Shape (m, names)."""
        return np.asarray(self.status == "tracking")

    @property
    def steps(self) -> tuple[Told, ...]:
        """Events that name a step of a parameter."""
        return tuple(t for t in self.told if "jump" in t.kind or "step" in t.kind)


@dataclass(slots=True)
class Listener:
    """Feeds a pipeline and keeps what it says."""

    pipeline: Pipeline
    estimates: list[Estimate] = field(default_factory=list)
    told: list[Told] = field(default_factory=list)

    def take(self, block: SampleBlock) -> None:
        """Samples in their order."""
        self.estimates += self.pipeline.process(block)
        self.told += [Told(float(block.time_s[-1]), *m) for m in self.pipeline.messages]
        self.pipeline.messages.clear()

    def heard(self) -> Heard:
        """So far; the tick that is not complete is left out."""
        names = tuple(p.name for p in self.estimates[0].parameters)
        said = {voice: np.array([_of(e, voice, names) for e in self.estimates]) for voice in VOICES}
        return Heard(
            names=names,
            time_s=np.array([e.time_s for e in self.estimates]),
            value={voice: numbers[:, 0] for voice, numbers in said.items()},
            std={voice: numbers[:, 1] for voice, numbers in said.items()},
            status=np.array([[p.status for p in e.parameters] for e in self.estimates]),
            white=np.array([e.health["innovation_white"] is not False for e in self.estimates]),
            told=tuple(self.told),
        )


def _of(estimate: Estimate, voice: str, names: tuple[str, ...]) -> list[list[float]]:
    """Values and standard deviations of one voice; NaN where there is none."""
    if voice == "published":
        said = {p.name: (p.value, p.std) for p in estimate.parameters}
    else:
        view = estimate.estimators.get(voice)
        said = {} if view is None else dict(view.parameters)
    pairs = [said.get(name, (None, None)) for name in names]
    return [[np.nan if pair[k] is None else float(pair[k]) for pair in pairs] for k in (0, 1)]  # type: ignore[arg-type]


def listened(config: DriveConfig, info: DriveInfo, blocks: Iterable[SampleBlock]) -> Heard:
    """The blocks through a pipeline."""
    listener = Listener(Pipeline(config, info))
    for block in blocks:
        listener.take(block)
    return listener.heard()


def blocks_of(recording: Recording) -> Iterable[SampleBlock]:
    """A recording of the independent generator in blocks of 0.1 s, so that events have a time."""
    edges = np.searchsorted(recording.time_s, np.arange(recording.time_s[0], recording.time_s[-1], _BLOCK_S)[1:])
    for a, b in zip([0, *edges], [*edges, len(recording.time_s)], strict=True):
        if b > a:
            yield block_of(recording, int(a), int(b))
