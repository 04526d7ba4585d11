"""One identification: the model asked for, the baseline beside it, and their scores on other captures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from servo_daemon.captures import Capture, in_canonical_order
from servo_daemon.identification.output_error import FitOptions, OutputErrorFit, Recording, fit_output_error
from servo_daemon.identification.procedure.drift import Drift, drift_of
from servo_daemon.identification.procedure.play import fit_with_play
from servo_daemon.identification.procedure.validate import Validation, validated


@dataclass(frozen=True, slots=True)
class IdentifyOptions:
    """What is asked for.

    Attributes:
        effects: of the model that is fitted.
        baseline: effects of the model it is compared with on the validation captures (the config's).
        fit: how.
        adapt: see `validated`; None: not.
    """

    effects: tuple[str, ...] = ()
    baseline: tuple[str, ...] = ()
    fit: FitOptions = field(default_factory=FitOptions)
    adapt: float | None = None


@dataclass(frozen=True, slots=True)
class Identification:
    """The fit, and how it does elsewhere.

    Attributes:
        captures: what was fitted.
        fit: the model asked for.
        baseline: the model without the added effects; None where none were added or nothing is validated.
        validation: one for each validation capture.
        drift: where the fit's free run was biased by what adds up over time; None where it was not.
    """

    captures: tuple[Capture, ...]
    fit: OutputErrorFit
    baseline: OutputErrorFit | None
    validation: tuple[Validation, ...]
    drift: Drift | None = None


def identify(captures: Sequence[Capture], validation: Sequence[Capture], options: IdentifyOptions) -> Identification:
    """Fit to the captures, score on the others.

    Raises:
        BadInputError: captures that cannot be used together or at all.
        NumericalError: the model cannot be simulated over them.
    """
    captures = in_canonical_order(captures)
    recordings = [Recording(str(c.path), c.block()) for c in captures]
    fit = None
    if "backlash" in options.effects:
        fit = fit_with_play(recordings, options.effects, options.fit)
    fit = fit or fit_output_error(recordings, options.effects, options.fit)
    baseline = None
    if validation and set(options.effects) != set(options.baseline):
        baseline = fit_output_error(recordings, options.baseline, options.fit)
    extended = None if baseline is None else fit
    scores = [validated(c, baseline or fit, extended, recordings, options.adapt) for c in validation]
    return Identification(captures, fit, baseline, tuple(scores), drift_of(fit, recordings, options.fit))
