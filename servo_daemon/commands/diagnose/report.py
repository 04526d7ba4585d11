"""The report of `diagnose`: a page that shows what was found, why, what it gains and what it leaves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from servo_daemon.commands.diagnose.criterion import by_balance
from servo_daemon.commands.diagnose.evidence import Evidence, has_other_torques
from servo_daemon.commands.diagnose.figures import MOST_DRAWN, free_run_figures, needed_figures, signal_figures
from servo_daemon.commands.diagnose.missing import missing_figures
from servo_daemon.commands.diagnose.tables import (
    candidate_blocks,
    difference_sections,
    effect_blocks,
    error_blocks,
    free_run_tables,
    note_sections,
    parameter_blocks,
    remaining_blocks,
    toml_blocks,
    verdict_block,
)
from servo_daemon.commands.fit.report import validation_sections
from servo_daemon.diagnosis.verdict.result import Diagnosis
from servo_daemon.plant.effects import event_times
from servo_daemon.report import Mark, Provenance, Report, Section, Text
from servo_daemon.report.document import Block


def diagnosis_report(d: Diagnosis, evidence: Evidence, document: Mapping[str, Any], provenance: Provenance) -> Report:
    """The whole report.

    Args:
        document: of `diagnosis_document`.
    """
    marks = _events(document)
    sections = (
        Section("Result", (verdict_block(document), *error_blocks(document))),
        *(Section(_title(e["name"]), effect_blocks(e)) for e in document["effects"]),
        *((Section("For the daemon", toml_blocks(document)),) if document["toml"] else ()),
        Section(
            "Measured and simulated",
            needed_figures(d, marks)
            if by_balance(document)
            else (
                *free_run_tables(document),
                *free_run_figures(d, evidence, marks),
                _short_runs(d),
                *signal_figures(d, marks),
            ),
        ),
        Section("What is missing", (_missing(d, evidence), *missing_figures(d, evidence, marks))),
        Section("What is left", remaining_blocks(document)),
        Section("What was tried", candidate_blocks(document)),
        Section("Parameters", parameter_blocks(document)),
        *difference_sections(document),
        *validation_sections(document),
        *note_sections(document),
    )
    return Report("Diagnosis", ", ".join(c.path.name for c in d.captures), sections, provenance)


def _title(name: str) -> str:
    return name.replace("_", " ").capitalize()


def _events(document: Mapping[str, Any]) -> list[Mark]:
    """Instants that were found, to be marked in what is drawn over time."""
    rows = {name: p for e in document["effects"] for name, p in e["parameters"].items()}
    return [
        Mark(rows[n]["value"], n)
        for n in dict.fromkeys(event_times().values())
        if n in rows and rows[n]["value"] is not None
    ]


def _short_runs(d: Diagnosis) -> Block:
    first = d.baseline.problem.segments[0].rows
    text = (
        f"Below, the simulation runs freely in pieces of about {first[-1, 0] - first[0, 0]:.2g} s, each from the "
        "initial state that suits it best, as in the fit: what it cannot follow within that time is missing, not "
        "drifted away."
    )
    if len(d.captures) > MOST_DRAWN:
        text += f" Of {len(d.captures)} captures the first {MOST_DRAWN} are drawn."
    return Text(text)


def _missing(d: Diagnosis, evidence: Evidence) -> Block:
    torque = "force" if d.captures[0].axis == "linear" else "torque"
    visible = {
        "torque and voltage": f"What would have to be added to the balances of {torque} and voltage for the simulation "
        f"to show exactly what was measured. Like a load, a missing {torque} counts against positive motion; a missing "
        "voltage counts as a drop.",
        "sum as torque": f"Without a measured current only the sum of missing {torque} and missing voltage is visible, "
        f"referred to the shaft: what would have to be added to the balance of {torque}.",
        "sum as voltage": f"Without a measured motion only the sum of missing {torque} and missing voltage is visible, "
        "referred to the terminals: what would have to be added to the balance of the voltage.",
        "torque": f"What would have to be added to the balance of {torque} for the simulation to show exactly what was "
        "measured; it counts like a load, against positive motion.",
    }[d.before.visible]
    if len(d.captures) > 1:
        visible += f" Of {d.captures[evidence.longest].path.name}, the longest capture."
    if evidence.asked is not None:
        where = "All figures here" if has_other_torques(d, evidence) else "Over speed, angle and current the figures"
        visible += (
            "\n\nA fit that lacks a cause biases its other parameters to make up for it, and what the baseline then "
            f"lacks has another shape than the cause. {where} therefore show the "
            "extended model with its effects left out: what the effects answer for. “Extended” is what they leave."
        )
    return Text(visible)
