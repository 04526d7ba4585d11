"""Figures of the signals in the report of `diagnose`: measured, and simulated by both models."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servo_daemon.captures import Capture
from servo_daemon.commands.diagnose.criterion import WHY
from servo_daemon.commands.diagnose.evidence import Evidence
from servo_daemon.commands.fit.report import LABELS, capture_series
from servo_daemon.commands.shared.units import shown_column
from servo_daemon.diagnosis.missing.missing import Missing
from servo_daemon.diagnosis.verdict.result import Diagnosis
from servo_daemon.identification.output_error.problem.score import Score, measured_speed
from servo_daemon.kalman.gaussian import natural_values
from servo_daemon.report import Axis, Line, Mark, Text, TimeSeries
from servo_daemon.report.document import Block
from servo_daemon.samples import F64, SampleBlock

#: Captures whose signals are drawn.
MOST_DRAWN = 4
#: What a run that has left all bounds shows is no number for a figure.
_LIMIT = 1e9


def signal_figures(d: Diagnosis, marks: Sequence[Mark]) -> tuple[Block, ...]:
    """For each capture and channel: measured over simulated in short free runs, and what both models leave."""
    figures = list[Block]()
    for k, capture in enumerate(d.captures[:MOST_DRAWN]):
        for c, name in enumerate(d.baseline.problem.channels):
            time, measured, before = capture_series(d.baseline, k, c)
            lines = [Line("measured", measured), Line("baseline", measured - before, style="dashed")]
            left = [Line("baseline", before)]
            if d.extended is not None:
                _, _, after = capture_series(d.extended, k, c)
                lines.append(Line("extended", measured - after, style="dashed"))
                left.append(Line("extended", after))
            label, unit = LABELS[shown_column(name, linear=capture.axis == "linear")]
            where = _where(d, capture)
            figures += [
                _figure(f"{label.capitalize()}{where}", time, lines, Axis(label, unit), capture, marks),
                _figure(
                    f"{label.capitalize()}{where}: measured − simulated",
                    time,
                    left,
                    Axis("residual", unit),
                    capture,
                    marks,
                ),
            ]
    return tuple(figures)


def free_run_figures(d: Diagnosis, evidence: Evidence, marks: Sequence[Mark]) -> tuple[Block, ...]:
    """One run over each whole capture, from its first samples' state: speed where there is one, else the current."""
    figures = list[Block]()
    for capture, (before, after) in list(zip(d.captures, evidence.free_runs, strict=True))[:MOST_DRAWN]:
        name = "velocity_rad_s" if "velocity_rad_s" in before.channels else before.channels[0]
        block = capture.block()
        lines = [Line("measured", _measured(block, name)), Line("baseline", _run(before, name), style="dashed")]
        if after is not None:
            lines.append(Line("extended", _run(after, name), style="dashed"))
        label, unit = LABELS[shown_column(name, linear=capture.axis == "linear")]
        title = f"{label.capitalize()}{_where(d, capture)}: one free run"
        figures.append(_figure(title, block.time_s - block.time_s[0], lines, Axis(label, unit), capture, marks))
    return tuple(figures)


def needed_figures(d: Diagnosis, marks: Sequence[Mark]) -> tuple[Block, ...]:
    """The measured current (or torque) over time, and what the motion needs by both models: the longest capture."""
    torque = d.baseline.problem.plant.drive == "torque"
    capture = max(d.captures, key=len)
    axis = Axis("torque" if torque else "current", "N·m" if torque else "A")
    time = d.before.time_s - d.before.time_s[0]
    lines = [Line("measured", d.before.input), Line("baseline", _needed(d.before), style="dashed")]
    if d.after is not None:
        lines.append(Line("extended", _needed(d.after), style="dashed"))
    title = f"{axis.label.capitalize()}: measured, and needed for the measured motion"
    return (Text(WHY["balance"]), _figure(title, time, lines, axis, capture, marks))


def _needed(missing: Missing) -> F64:
    """What would leave nothing missing."""
    K = natural_values(missing.augmented.plant.parameters, missing.coordinates).get("K", 1.0)
    return np.asarray(missing.input - missing.series["torque"] / K)


def _figure(
    title: str, time: F64, lines: Sequence[Line], axis: Axis, capture: Capture, marks: Sequence[Mark]
) -> TimeSeries:
    gap = 5.0 * capture.sample_period_s
    return TimeSeries(title, time, tuple(lines), axis, group=str(capture.path), gap=gap, marks=tuple(marks))


def _where(d: Diagnosis, capture: Capture) -> str:
    return f", {capture.path.name}" if len(d.captures) > 1 else ""


def _measured(block: SampleBlock, name: str) -> F64:
    speed = measured_speed(block) if name == "velocity_rad_s" else None
    values: F64 = getattr(block, name) if speed is None else speed
    return values


def _run(score: Score, name: str) -> F64:
    values = score.simulated[:, score.channels.index(name)]
    return np.where(np.abs(values) < _LIMIT, values, np.nan)
