"""The report of `fit`: what was found, what was not, and the pictures that show whether to believe it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from servo_daemon.commands.fit.text import settled_words
from servo_daemon.commands.shared.units import shown_column
from servo_daemon.identification import Identification
from servo_daemon.identification.output_error import OutputErrorFit
from servo_daemon.report import (
    Axis,
    Column,
    Items,
    Iterations,
    Line,
    Measured,
    Provenance,
    Report,
    Section,
    Table,
    TimeSeries,
    Verdict,
)
from servo_daemon.report.document import Block
from servo_daemon.samples import F64

LABELS = {
    "current_A": ("current", "A"),
    "position_rad": ("angle", "rad"),
    "velocity_rad_s": ("speed", "rad/s"),
    "position_m": ("position", "m"),
    "velocity_m_s": ("speed", "m/s"),
}


def fit_report(result: Identification, document: Mapping[str, Any], provenance: Provenance) -> Report:
    """The whole report.

    Args:
        document: of `fit_document`.
    """
    model = " + ".join(["linear motor", *document["model"]])
    sections = (
        Section("Result", (_verdict(document), parameter_table(document["parameters"]), *open_blocks(document))),
        Section("Measured and simulated", signal_figures(result)),
        Section("The way to the minimum", iteration_figures(document)),
        *validation_sections(document),
        *_correlation(document),
    )
    return Report("Identification", f"{model}, output error", sections, provenance)


def _verdict(document: Mapping[str, Any]) -> Verdict:
    open_ones = [n for n, p in document["parameters"].items() if p["status"] == "undetermined"]
    if open_ones:
        lines = tuple(d["text"] for d in document["null_directions"])
        return Verdict("warn", f"These data do not determine {', '.join(open_ones)}", lines)
    noise = document["residual"]["noise_model"]
    if document["residual"]["white"] and noise is not None:
        lines = (
            f"Noise of {noise['voltage_noise_V']:.2g} V on the voltage is not in the capture, and enters the motor.",
        )
        return Verdict("good", "The model and the noise of its voltage explain these data", lines)
    if document["residual"]["white"]:
        return Verdict("good", "The model explains these data to their noise")
    return Verdict(
        "warn",
        "Determined, but what the model leaves is not white",
        ("The noise is coloured or the model lacks something: try it with --effect.",),
    )


def parameter_table(parameters: Mapping[str, Mapping[str, Any]]) -> Table:
    """Values with their standard deviations."""
    columns = (Column("parameter", text=True), Column("value ± std"), Column("unit", text=True), Column("", text=True))
    rows = []
    for name, p in parameters.items():
        std = np.inf if p["status"] == "undetermined" else p["std"]
        rows.append((name, Measured(p["value"], std), p["unit"], parameter_remark(p)))
    return Table("Parameters", columns, tuple(rows))


def parameter_remark(p: Mapping[str, Any]) -> str:
    """'held', 'not determined', 'by search', 'at its bound'; a choice by its name."""
    words = {"fixed": "held", "undetermined": "not determined", "searched": "by search", "estimated": ""}
    at_bound = f"(at bound {p['bound']:.6g})" if p["at_bound"] else ""
    return " ".join(filter(None, (p.get("choice"), words[p["status"]], at_bound)))


def open_blocks(document: Mapping[str, Any]) -> tuple[Block, ...]:
    """What is determined where parameters are not."""
    if not document["combinations"]:
        return ()
    columns = (Column("combination", text=True), Column("value ± std"), Column("unit", text=True))
    rows = tuple((c["expression"], Measured(c["value"], c["std"]), c["unit"]) for c in document["combinations"])
    return (Table("What these data do determine", columns, rows),)


def signal_figures(result: Identification) -> tuple[Block, ...]:
    """For each capture and channel: measured over simulated, and what is left."""
    fit, figures = result.fit, list[Block]()
    for k, capture in enumerate(result.captures):
        linear = capture.axis == "linear"
        for c, name in enumerate(fit.problem.channels):
            time, measured, residual = capture_series(fit, k, c)
            label, unit = LABELS[shown_column(name, linear=linear)]
            gap = 5.0 * capture.sample_period_s
            lines = (Line("measured", measured), Line("simulated", measured - residual, style="dashed"))
            figures.append(
                TimeSeries(
                    f"{capture.path.name}: {label}", time, lines, Axis(label, unit), group=str(capture.path), gap=gap
                )
            )
            figures.append(
                TimeSeries(
                    f"{capture.path.name}: {label}, what is left",
                    time,
                    (Line("measured − simulated", residual),),
                    Axis("residual", unit),
                    caption="A residual that follows a signal is an effect the model lacks.",
                    group=str(capture.path),
                    gap=gap,
                )
            )
    return tuple(figures)


def capture_series(fit: OutputErrorFit, recording: int, channel: int) -> tuple[F64, F64, F64]:
    """Time since the capture began, measured and residual over all its segments, shape (n,) each."""
    time, measured, residual = [], [], []
    for segment, r in zip(fit.problem.segments, fit.solution.point.linearisation.residuals, strict=True):
        if segment.recording == recording:
            time.append(segment.rows[:, 0])
            measured.append(segment.measured[:, channel])
            residual.append(r[:, channel])
    return np.concatenate(time), np.concatenate(measured), np.concatenate(residual)


def iteration_figures(document: Mapping[str, Any]) -> tuple[Block, ...]:
    """The paper's Table 1 and its Figures 4 and 5: cost and parameters over the iterations."""
    rows = document["iterations"]
    number = np.array([float(r["iteration"]) for r in rows])
    table = Table(
        "Iterations",
        (Column("iteration", decimals=0), Column("function count", decimals=0), Column("cost", digits=5)),
        tuple((float(r["iteration"]), float(r["function_count"]), r["cost"]) for r in rows),
        note="Cost: mean squared residual over the mean square of the measured signal about its mean.",
    )
    if len(rows) < 2:
        return (table,)
    cost = np.array([r["cost"] for r in rows])
    last = rows[-1]["parameters"]
    shown = [name for name, value in last.items() if value != 0.0]
    ways = tuple(Line(n, np.array([r["parameters"][n] / last[n] for r in rows])) for n in shown)
    return (
        table,
        Iterations("Cost", number, (Line("cost", cost),), Axis("cost", log=True)),
        Iterations("Parameters on the way, over their last value", number, ways, Axis("value / last value")),
    )


def validation_sections(document: Mapping[str, Any]) -> tuple[Section, ...]:
    """A table for each capture that was only scored."""
    if not document["validation"]:
        return ()
    text = Items(
        (
            "free run: from the state of the first samples to the end",
            "1 s: free runs of one second, each restarted from the measured state",
            "adapted: friction and offsets have settled on the first part, the rest is scored",
        )
    )
    tables = (score_table(f"RMS error on {Path(v['capture']).name}", v) for v in document["validation"])
    return (Section("Validation", (text, *tables)),)


def score_table(caption: str, scores: Mapping[str, Any]) -> Table:
    """RMS errors of free runs by model: a row of `validation`."""
    names = list(scores["baseline"]["rmse"])
    columns = (
        Column("model", text=True),
        *(Column(f"{n}, free run", digits=4) for n in names),
        *(Column(f"{n}, 1 s", digits=4) for n in names),
    )
    rows = [
        (kind, *(scores[kind]["rmse"][n] for n in names), *(scores[kind]["rmse_1s"][n] for n in names))
        for kind in ("baseline", "extended", "adapted")
        if scores[kind] is not None
    ]
    adapted = scores["adapted"]
    return Table(caption, columns, tuple(rows), note="" if adapted is None else f"Adapted: {settled_words(adapted)}.")


def _correlation(document: Mapping[str, Any]) -> tuple[Section, ...]:
    names = list(document["correlation"])
    if len(names) < 2:
        return ()
    columns = (Column("", text=True), *(Column(n, decimals=2) for n in names))
    rows = tuple((a, *(document["correlation"][a][b] for b in names)) for a in names)
    table = Table(
        "Correlation of the estimates", columns, rows, note="Near ±1: only a combination of the two is well known."
    )
    return (Section("Correlation", (table,)),)
