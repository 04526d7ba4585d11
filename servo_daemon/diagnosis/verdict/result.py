"""Records of a diagnosis' result."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from servo_daemon.captures import Capture
from servo_daemon.diagnosis.missing.missing import Missing
from servo_daemon.diagnosis.screening.dependence import Dependence
from servo_daemon.diagnosis.search.effort import Unfinished
from servo_daemon.identification.output_error import OutputErrorFit
from servo_daemon.identification.procedure.validate import Validation

#: "none": the baseline explains the data to their noise; "found": at least one effect was named; "unexplained": none
#: was, yet structure remains.
Verdict = Literal["none", "found", "unexplained"]
#: What the names and the gain were judged by: free runs of the simulation; where noise that enters the motor adds up in
#: them to more than the effect makes, predictions of each sample from those before it; or, for a motor that its
#: controller holds where it would not stay by itself, the torque that its measured motion needs.
JudgedBy = Literal["free_runs", "predictions", "balance"]
#: What the gain was measured on: data that neither fit, choice nor veto has seen, or, where a capture is too short for
#: a part of its own for that, the part that decided.
MeasuredOn = Literal["unseen", "choosing"]


@dataclass(frozen=True, slots=True)
class NamedEffect:
    """An effect that the data name.

    Attributes:
        name: of the effect.
        gain: share of the removable held-out error that comes back without it; None: it cannot be told.
        equivalent: names that fitted these data as well in its place, tested.
    """

    name: str
    gain: float | None
    equivalent: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Errors of the part that the gain is measured on: RMS by channel, and normalised over channels."""

    rmse: Mapping[str, float]
    nrmse: float


@dataclass(frozen=True, slots=True)
class CandidateScore:
    """A model that was fitted in the search.

    Attributes:
        name: of the effect added.
        beside: effects that the model had before.
        nrmse: normalised error of the free runs that decide.
        delta_bic: against the model before; negative speaks for the effect.
        taken: whether it was.
    """

    name: str
    beside: tuple[str, ...]
    nrmse: float
    delta_bic: float
    taken: bool


@dataclass(frozen=True, slots=True)
class Spread:
    """A parameter that differs between captures: value and 1 σ for each of them, natural units."""

    name: str
    values: tuple[float, ...]
    stds: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class OwnModel:
    """What the differences mean for a free run over a whole capture: RMS errors by channel with the parameters that
    all captures share, and with the capture's own."""

    capture: str
    shared_rmse: Mapping[str, float]
    own_rmse: Mapping[str, float]


@dataclass(frozen=True)
class Finding:
    """What the balance or predictions have named; fields as in `Diagnosis`.

    Attributes:
        before: None: as the free runs have it.
    """

    judged_by: JudgedBy
    effects: tuple[NamedEffect, ...]
    extended: OutputErrorFit
    baseline_score: HeldOut
    extended_score: HeldOut
    noise_floor: float
    error_removed: float | None
    ci95: tuple[float, float] | None
    candidates: tuple[CandidateScore, ...]
    after: Missing
    before: Missing | None = None
    deviance_gain: float | None = None


@dataclass(frozen=True)
class Diagnosis:
    """The result of a diagnosis.

    Attributes:
        captures: what was diagnosed.
        verdict: see `Verdict`.
        effects: what was added to the baseline, in the order of the search; empty unless found.
        baseline: the configured model (else the linear motor), fitted to the full data.
        extended: with the effects; None unless found.
        baseline_score, extended_score: held-out errors; the second is None unless found.
        noise_floor: normalised error that noise alone would leave; None unless found.
        error_removed, ci95: share of the removable held-out error that the extension removes, with its 95 % interval,
            of which an end may be infinite; None unless found, and where noise leaves as much as the baseline does.
        measured_on: see `MeasuredOn`.
        candidates: all models that were fitted, by round.
        before, after: unmodelled torque and voltage under both models, of the longest capture; the second None unless
            found.
        white: whether the final model and the noise explain the data.
        depends_on: what the remaining unmodelled torque and voltage follow.
        differences: parameters that differ between the captures beyond chance.
        own_models: what that means for each capture; empty where there is one capture.
        validation: scores on captures that were not diagnosed.
        seconds: time taken.
        judged_by: see `JudgedBy`; the held-out errors are of that.
        deviance_gain: by how much −2 log p falls, at least, with what predictions have named; else None.
        unfinished: what there was no time for; None: everything was tried.
    """

    captures: tuple[Capture, ...]
    verdict: Verdict
    effects: tuple[NamedEffect, ...]
    baseline: OutputErrorFit
    extended: OutputErrorFit | None
    baseline_score: HeldOut
    extended_score: HeldOut | None
    noise_floor: float | None
    error_removed: float | None
    ci95: tuple[float, float] | None
    measured_on: MeasuredOn
    candidates: tuple[CandidateScore, ...]
    before: Missing
    after: Missing | None
    white: bool
    depends_on: tuple[Dependence, ...]
    differences: tuple[Spread, ...]
    own_models: tuple[OwnModel, ...]
    validation: tuple[Validation, ...]
    seconds: float
    judged_by: JudgedBy = "free_runs"
    deviance_gain: float | None = None
    unfinished: Unfinished | None = None

    @property
    def final(self) -> OutputErrorFit:
        """The fit of the model that the diagnosis ends with."""
        return self.extended or self.baseline
