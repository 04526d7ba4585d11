"""What `diagnose` finds, as a value: for the command itself and for others that diagnose many captures."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from typing import Any

from servo_daemon.commands.diagnose.document import diagnosis_document
from servo_daemon.commands.diagnose.evidence import Evidence, gather_evidence
from servo_daemon.commands.diagnose.progress import progress_told
from servo_daemon.commands.fit.inputs import Inputs, check_validation, gather
from servo_daemon.commands.shared import common
from servo_daemon.diagnosis.diagnose import DiagnoseOptions, diagnose
from servo_daemon.diagnosis.verdict.result import Diagnosis


@dataclass(frozen=True, slots=True)
class Diagnosed:
    """The document, and what it was made of."""

    document: dict[str, Any]
    diagnosis: Diagnosis
    evidence: Evidence


def diagnosed(arguments: argparse.Namespace) -> Diagnosed:
    """Read, diagnose, and tell notes and progress on stderr.

    Args:
        arguments: of `diagnose`'s command line.

    Raises:
        BadInputError: a capture, the config or a flag is wrong; one line naming it.
    """
    inputs = gather(arguments, arguments.captures, arguments.validate, searches=True)
    check_validation(inputs, arguments.adapt)
    for text in inputs.notes:
        common.note(text)
    diagnosis = _diagnose(arguments, inputs)
    evidence = gather_evidence(diagnosis)
    document = diagnosis_document(diagnosis, inputs, evidence)
    for text in document["notes"][len(inputs.notes) :]:
        common.note(text)
    return Diagnosed(document, diagnosis, evidence)


def _diagnose(arguments: argparse.Namespace, inputs: Inputs) -> Diagnosis:
    options = DiagnoseOptions(
        inputs.effects,
        inputs.nominal,
        inputs.fixed,
        arguments.adapt,
        budget_s=arguments.budget,
        journal=arguments.journal,
    )
    with progress_told(as_json=arguments.progress_json) as told:
        return diagnose(inputs.captures, inputs.validation, options, told)
