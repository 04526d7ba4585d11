"""The whole diagnosis of captures: baseline, verdict, extended model, what it gains, what is left."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from servo_daemon.captures import Capture
from servo_daemon.diagnosis.compare import error_removed
from servo_daemon.diagnosis.dependence import Dependence, dependences
from servo_daemon.diagnosis.missing import Missing, missing_inputs
from servo_daemon.diagnosis.noise_floor import noise_floor_nrmse
from servo_daemon.diagnosis.select import Selection, refit, select
from servo_daemon.errors import NumericalError
from servo_daemon.estimators.output_error import FitOptions, OutputErrorFit, Recording, fit_output_error
from servo_daemon.identification.validate import Validation, natural_values, validated
from servo_daemon.samples import SampleBlock

Verdict = str  # "none" | "found" | "unexplained"


@dataclass(frozen=True)
class Diagnosis:
    """What was found.

    Attributes:
        verdict: "none": the baseline explains the data to their noise; "found": at least one effect; "unexplained".
        effects: names of what was added to the baseline.
        baseline, extended: fits to everything; `extended` is None unless found.
        selection: the search; None where nothing was missing.
        floor: normalised error that noise alone leaves.
        removed: share of the removable held-out error that the extension removes, and its 95 % interval.
        before, after: missing torque and voltage under both models, of the longest capture.
        depends_on: what is left follows this.
        validation: scores on other captures.
    """

    captures: tuple[Capture, ...]
    verdict: Verdict
    effects: tuple[str, ...]
    baseline: OutputErrorFit
    extended: OutputErrorFit | None
    selection: Selection | None
    floor: float | None
    removed: tuple[float, tuple[float, float]] | None
    before: Missing
    after: Missing | None
    depends_on: tuple[Dependence, ...]
    validation: tuple[Validation, ...]

    @property
    def final(self) -> OutputErrorFit:
        """The fit of the model that the diagnosis ends with."""
        return self.extended or self.baseline


def diagnose(
    captures: Sequence[Capture],
    *,
    baseline: tuple[str, ...] = (),
    nominal: Mapping[str, float] | None = None,
    fixed: Mapping[str, float] | None = None,
    validation: Sequence[Capture] = (),
    adapt: float | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Diagnosis:
    """Find what the simulation of these captures lacks.

    Args:
        baseline: effects of the model that is doubted.
        nominal: start values, natural units.
        fixed: held in every model.
        validation, adapt: as for `identify`.
        progress: told what is being done.

    Raises:
        BadInputError: captures that cannot be used.
        NumericalError: the baseline cannot be simulated over them.
    """
    fixed = dict(fixed or {})
    recordings = [Recording(str(c.path), c.block()) for c in captures]
    progress("fitting the baseline")
    fit = fit_output_error(recordings, baseline, FitOptions(nominal=dict(nominal or {}), fixed=fixed))
    block, number = _longest(recordings)
    before = missing_inputs(fit, block, recording=number)
    selection: Selection | None = None
    extended, after, floor, removed = None, None, None, None
    if not fit.white:
        selection = select(recordings, baseline, natural_values(fit), fixed, progress)
        if selection.effects:
            progress("fitting the extended model to everything")
            extended = refit(recordings, selection.chosen, fixed)
            after = missing_inputs(extended, block, recording=number)
            floor = noise_floor_nrmse(extended, selection)
            removed = error_removed(selection.base, selection.chosen, floor)
    final, left = extended or fit, after or before
    depends = () if final.white else dependences(final, left)
    if extended is not None:
        verdict = "found"
    else:
        verdict = "unexplained" if depends else "none"
    scores = tuple(validated(c, fit, extended, adapt) for c in validation)
    effects = selection.effects if selection is not None and extended is not None else ()
    return Diagnosis(
        tuple(captures), verdict, effects, fit, extended, selection, floor, removed, before, after, depends, scores
    )


def _longest(recordings: Sequence[Recording]) -> tuple[SampleBlock, int]:
    number = int(np.argmax([len(r.block) for r in recordings]))
    if not len(recordings[number].block):
        raise NumericalError("no samples")
    return recordings[number].block, number
