"""What `fit` finds, as a value: for the command itself and for others that fit many captures."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from typing import Any

from servo_daemon.commands.fit.document import fit_document
from servo_daemon.commands.fit.idim import idim_document
from servo_daemon.commands.fit.inputs import Inputs, check_validation, gather
from servo_daemon.commands.fit.notes import drift_note, result_notes
from servo_daemon.commands.shared import common
from servo_daemon.errors import BadInputError
from servo_daemon.identification import Identification, IdentifyOptions, identify
from servo_daemon.identification.output_error import FitOptions
from servo_daemon.identification.output_error.problem.setup import FEWEST_SAMPLES


@dataclass(frozen=True, slots=True)
class Fitted:
    """The document, and what it was made of; None: inverse dynamics, which has no more than its document."""

    document: dict[str, Any]
    result: Identification | None


def fitted(arguments: argparse.Namespace) -> Fitted:
    """Read, fit, and tell the notes on stderr.

    Args:
        arguments: of `fit`'s command line.

    Raises:
        BadInputError: a capture, the config or a flag is wrong; one line naming it.
    """
    inputs = gather(arguments, arguments.captures, arguments.validate)
    _check_segment(arguments.segment, inputs)
    check_validation(inputs, arguments.adapt)
    for text in inputs.notes:
        common.note(text)
    result, document = (None, _idim(arguments, inputs)) if arguments.method == "idim" else _fit(arguments, inputs)
    for text in document["notes"][len(inputs.notes) :]:
        common.note(text)
    return Fitted(document, result)


def _fit(arguments: argparse.Namespace, inputs: Inputs) -> tuple[Identification, dict[str, Any]]:
    options = FitOptions(
        nominal=inputs.nominal,
        fixed=inputs.fixed,
        robust=not arguments.no_robust,
        segment_s=arguments.segment,
        holds_voltage=inputs.meaning.may_hold_voltage,
    )
    result = identify(
        inputs.captures, inputs.validation, IdentifyOptions(inputs.effects, inputs.baseline, options, arguments.adapt)
    )
    found = result_notes(result.fit, {**inputs.nominal, **inputs.fixed}, inputs.meaning, inputs.captures[0])
    if result.drift is not None:
        found.append(drift_note(result.drift, result.fit, linear=result.captures[0].axis == "linear"))
    return result, {**fit_document(result, inputs.winding, inputs.meaning), "notes": [*inputs.notes, *found]}


def _idim(arguments: argparse.Namespace, inputs: Inputs) -> dict[str, Any]:
    if arguments.adapt is not None or arguments.segment is not None:
        raise BadInputError("--adapt and --segment belong to --method output-error")
    return idim_document(inputs)


def _check_segment(segment_s: float | None, inputs: Inputs) -> None:
    """Each free run has an initial state of its own, which some samples must tell.

    Raises:
        BadInputError: there are too few in a run of this length, s.
    """
    if segment_s is None:
        return
    for capture in inputs.captures:
        if segment_s < (shortest := (FEWEST_SAMPLES - 1) * capture.sample_period_s):
            least = f"{FEWEST_SAMPLES} samples, here {shortest:.3g} s"
            raise BadInputError(f"--segment {segment_s:g}: {capture.path}: a free run needs at least {least}")
