"""What the documents about kept diagnoses and models look like; see `estimates.py`."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from servo_daemon.api.schemas.estimates import TIME_EXAMPLE, Closed, example
from servo_daemon.published.diagnosis_state import Trigger

_REASON = "In words, why none are kept; null: they are."


class ShortDiagnosisDocument(Closed):
    """One diagnosis in short."""

    id: int
    time: str = Field(description="When it was done, UTC.")
    trigger: Trigger | None
    model: list[str] | None = Field(description="The drive's then: what was doubted.")
    verdict: str | None
    effects: list[str] = Field(description="What was found.")
    url: str


class DiagnosesDocument(Closed):
    """The diagnoses of a drive, oldest first."""

    model_config = example(
        drive="axis1",
        diagnoses=[
            {
                "id": 4,
                "time": TIME_EXAMPLE,
                "trigger": "mismatch",
                "model": [],
                "verdict": "found",
                "effects": ["coulomb_friction"],
                "url": "/api/v1/drives/axis1/diagnoses/4",
            }
        ],
        reason=None,
    )

    drive: str
    diagnoses: list[ShortDiagnosisDocument]
    reason: str | None = Field(description=_REASON)


class KeptDiagnosisDocument(Closed):
    """One diagnosis whole."""

    drive: str
    id: int
    time: str = Field(description="When it was done, UTC.")
    trigger: Trigger | None
    model: list[str] | None
    result: dict[str, Any] = Field(description="The document that `servo-daemon diagnose` writes, diagnosis.json.")


class KeptModelDocument(Closed):
    """A model that a drive was given."""

    time: str = Field(description="UTC.")
    effects: list[str]
    before: list[str] = Field(description="Its model until then.")


class ModelsDocument(Closed):
    """The models that a drive was given, oldest first."""

    model_config = example(
        drive="axis1",
        models=[{"time": TIME_EXAMPLE, "effects": ["coulomb_friction"], "before": []}],
        reason=None,
    )

    drive: str
    models: list[KeptModelDocument]
    reason: str | None = Field(description=_REASON)
