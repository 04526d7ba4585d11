"""A drive's diagnosis as the API sees it: immutable records, replaced as a whole."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

DiagnosisStatus = Literal["idle", "running", "done", "failed"]
Trigger = Literal["request", "mismatch"]


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """The last diagnosis, or that there has been none.

    Attributes:
        trigger: who wanted it; None: idle.
        model: the drive's when it began: what is doubted.
        started, finished: UTC, seconds since the epoch.
        samples, span_s: of the recording, s of device time.
        progress: 0 … 1; `step`: what it does at the moment, in words.
        reason: why it failed, in words.
        result: `diagnosis.json`, without NaN; only when done.
        report: the HTML file, if there is one.
    """

    status: DiagnosisStatus = "idle"
    trigger: Trigger | None = None
    model: tuple[str, ...] | None = None
    started: float | None = None
    finished: float | None = None
    samples: int = 0
    span_s: float = 0.0
    progress: float | None = None
    step: str | None = None
    reason: str | None = None
    result: Mapping[str, Any] | None = None
    report: Path | None = None

    @property
    def verdict(self) -> str | None:
        return None if self.result is None else str(self.result["verdict"])

    @property
    def unfinished(self) -> bool:
        """Whether there was no time for everything."""
        return self.result is not None and self.result.get("unfinished") is not None

    @property
    def effects(self) -> tuple[str, ...]:
        """The effects that were found."""
        return () if self.result is None else tuple(e["name"] for e in self.result["effects"])


@dataclass(frozen=True, slots=True)
class Adoption:
    """Whether what was found can be adopted now.

    Attributes:
        effects: the model that the drive would have; None: nothing was found.
        reason: why not, in words.
    """

    allowed: bool
    effects: tuple[str, ...] | None = None
    reason: str | None = None


@dataclass(frozen=True, slots=True)
class DiagnosisView:
    """All there is to see.

    Attributes:
        allowed, reason: whether one may be begun by request now, and why not.
        counts: how many diagnoses have ended in which verdict, or "failed", since the start of the daemon.
    """

    diagnosis: Diagnosis
    adoption: Adoption
    allowed: bool
    reason: str | None
    counts: Mapping[str, int] = field(default_factory=dict)
