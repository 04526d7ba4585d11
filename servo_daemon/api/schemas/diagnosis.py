"""What the routes of diagnosis and model take and answer: requests are held to it, answers described."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag

from servo_daemon.published.diagnosis_state import DiagnosisStatus, Trigger

_TIME = "2026-11-21T12:45:21.103Z"


def _example(**document: Any) -> ConfigDict:
    return ConfigDict(extra="forbid", allow_inf_nan=False, json_schema_extra={"examples": [document]})


class _Document(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


#: JSON's true and false are no numbers.
Number = Annotated[float, Field(strict=True)]


def _kind(given: object) -> str:
    """Which member of a union a value is meant as: so a mistake brings one complaint, and not one of each member."""
    if isinstance(given, str):
        return "<text>"
    return "<document>" if isinstance(given, Mapping | BaseModel) else "<number>"


TaggedNumber = Annotated[Number, Tag("<number>")]
TaggedText = Annotated[str, Tag("<text>")]


class StartValueDocument(_Document):
    """Where a parameter begins."""

    value: Annotated[TaggedNumber | TaggedText, Discriminator(_kind)] = Field(
        description="In the parameter's unit; a choice (`channel`) by its name."
    )
    std: Number | None = Field(None, ge=0, description="1 σ in the parameter's unit; null: not known.")


StartValue = Annotated[
    TaggedNumber | TaggedText | Annotated[StartValueDocument, Tag("<document>")], Discriminator(_kind)
]


class ModelRequestDocument(_Document):
    """The model that a drive is to have."""

    model_config = _example(effects=["coulomb_friction"], parameters={"Tc": {"value": 0.0125, "std": 0.0004}})

    effects: list[str] = Field(max_length=64, description="All effects on top of the linear motor; `[]`: none.")
    parameters: dict[str, StartValue] = Field(
        default={},
        max_length=200,
        description="Where parameters begin, value or value and std. The others keep what is known of them; those of "
        "an effect that the last diagnosis found begin where it found them; new ones are found in the data.",
    )


class ModelDocument(_Document):
    """The model that a drive has now, or will have."""

    model_config = _example(drive="axis1", model=["coulomb_friction"], time=_TIME, done=True)

    drive: str
    model: list[str]
    time: str | None = Field(description="Of the first estimate with it, UTC; null: there is none yet.")
    done: bool = Field(description="False (status 202): it waits for samples; an event `model_changed` will tell.")


class FoundParameterDocument(BaseModel):
    """One parameter of an effect."""

    model_config = ConfigDict(extra="allow")

    value: float | str | None
    std: float | None = None
    unit: str | None = None


class FoundEffectDocument(BaseModel):
    """A cause that the data hold and the model lacks."""

    model_config = ConfigDict(extra="allow")

    name: str
    cause: str | None = Field(None, description="The physical cause, one sentence.")
    equation: str | None = Field(None, description="LaTeX.")
    parameters: dict[str, FoundParameterDocument]
    gain: float | None = Field(None, description="Share of the removable error that comes back without it.")
    equivalent: list[list[str]] = Field(default=[], description="Effects that fit these data as well.")


class GainDocument(BaseModel):
    """What the extension removes of the baseline's error."""

    model_config = ConfigDict(extra="allow")

    error_removed: float | None = Field(
        description="(b² − e²)/(b² − n²): below 0 where the extension is worse, above 1 where less is left than noise "
        "should leave; null where noise leaves as much as the baseline does."
    )
    ci95: tuple[float | None, float | None] | None = Field(description="95 % interval; an end of null: open.")
    measured_on: Literal["unseen", "choosing"] | None = Field(
        None,
        description="`unseen`: data that neither fit, choice nor veto has seen; `choosing`: the part that decided, "
        "where a capture is too short for another.",
    )


class ResultDocument(BaseModel):
    """What a diagnosis says, as `servo-daemon diagnose` writes it."""

    model_config = ConfigDict(extra="allow")

    schema_: int = Field(alias="schema")
    verdict: Literal["none", "found", "unexplained"]
    effects: list[FoundEffectDocument]
    gain: GainDocument | None = Field(None, description="Of the effects together; null unless found.")
    remaining: dict[str, Any] | None = Field(None, description="What is left, and what it follows.")


class AllowedDocument(_Document):
    """Whether something can be done now."""

    allowed: bool
    reason: str | None = Field(description="Why not, in words.")


class AdoptionDocument(AllowedDocument):
    """Whether what was found can become the model now, by `POST /drives/{d}/model`."""

    effects: list[str] | None = Field(description="The model that the drive would have; null: nothing was found.")


class DiagnosisDocument(_Document):
    """The last diagnosis of a drive: what its model lacks."""

    model_config = _example(
        drive="axis1",
        status="running",
        trigger="mismatch",
        model=[],
        started=_TIME,
        finished=None,
        samples=60000,
        span_s=59.999,
        progress=0.35,
        step="round 1: fitting coulomb_friction",
        reason=None,
        result=None,
        report=None,
        adoption={"allowed": False, "reason": None, "effects": None},
        request={"allowed": False, "reason": "a diagnosis of this drive is running"},
    )

    drive: str
    status: DiagnosisStatus
    trigger: Trigger | None = Field(description="Who wanted it: a request, or the watch over the innovations.")
    model: list[str] | None = Field(description="The drive's when it began: what is doubted.")
    started: str | None
    finished: str | None
    samples: int = Field(description="Of the recording.")
    span_s: float = Field(description="Of the recording, s.")
    progress: float | None = Field(description="0 … 1.")
    step: str | None = Field(description="What it does at the moment.")
    reason: str | None = Field(description="Why it failed, in words.")
    result: ResultDocument | None
    report: str | None = Field(description="Where the report is.")
    adoption: AdoptionDocument
    request: AllowedDocument = Field(description="Whether `POST` would begin a diagnosis now.")
