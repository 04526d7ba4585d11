"""The report of `compare`: the methods' table and curves, and the paper's figures from our run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from servo_daemon.commands.compare.text import capture_lines, table_1_rows, verdict_lines
from servo_daemon.identification.inverse_dynamics.estimate import Estimate
from servo_daemon.identification.paper.compare import Comparison
from servo_daemon.identification.paper.paper import PaperRedone
from servo_daemon.identification.paper.position_experiment import PositionTest
from servo_daemon.parameters import MOTOR_NAMES
from servo_daemon.report import (
    Axis,
    Code,
    Column,
    Items,
    Iterations,
    Line,
    Mark,
    Measured,
    Provenance,
    Report,
    Section,
    Table,
    Text,
    TimeSeries,
)
from servo_daemon.report.document import Block, Cell

_UNITS = {"R": "Ω", "L": "H", "K": "N·m/A", "J": "kg·m²", "B": "N·m·s/rad"}


def compare_report(
    document: Mapping[str, Any], comparison: Comparison | None, paper: PaperRedone | None, provenance: Provenance
) -> Report:
    """The whole report.

    Args:
        document: of `capture_document` and `paper_document`.
    """
    sections: list[Section] = []
    if comparison is not None:
        sections += _capture_sections(document, comparison)
    if paper is not None:
        sections += _paper_sections(document, paper)
    subtitle = "the paper's own numbers" if comparison is None else str(comparison.capture.path)
    return Report("Three methods", subtitle, tuple(sections), provenance)


def _capture_sections(document: Mapping[str, Any], c: Comparison) -> list[Section]:
    columns = (Column("method", text=True), *(Column(n, _UNITS[n]) for n in MOTOR_NAMES))
    rows: list[tuple[Cell, ...]] = []
    for m in c.methods:
        cells = (_cell(m.parameters.get(n)) for n in MOTOR_NAMES)
        rows.append((m.title, *cells))
    if c.truth:
        rows.append(("truth", *(c.truth.get(n) for n in MOTOR_NAMES)))
    notes = [f"{m.title}: {text}" for m in c.methods for text in ((m.reason,) if m.reason else m.notes)]
    blocks: tuple[Block, ...] = (
        Table("Parameters", columns, tuple(rows), note=f"Method 1 assumes R = {c.assumed_R:g} Ω."),
        *((Items(tuple(notes)),) if notes else ()),
    )
    return [
        Section("Parameters", blocks),
        Section("Position test: 50° after 5 s", _position_blocks(c)),
        Section("Held-out part", _heldout_blocks(c)),
        Section("As text", (Code("\n".join(capture_lines(document))),)),
    ]


def _cell(e: Estimate | None) -> Cell:
    if e is None:
        return None
    return Measured(e.value, e.std if np.isfinite(e.std) and e.std > 0 else None)


def _position_blocks(c: Comparison) -> tuple[Block, ...]:
    columns = (
        Column("method", text=True),
        Column("after 5 s", "°", decimals=2),
        Column("overshoot", "%", decimals=1),
        Column("distance of the curve", "°", digits=3),
        Column("time taken", "s", digits=2),
    )
    tests = [(m.title, m.position) for m in c.methods if m.position is not None]
    seconds = {m.title: m.seconds for m in c.methods}
    rows = tuple((title, t.final_deg, 100 * t.overshoot, t.distance_deg, seconds[title]) for title, t in tests)
    if not tests:
        return (Items(("no method has all five parameters",)),)
    note = f"k_io·k_s = {c.product_V_rad:.4g} V/rad: {c.product_source}. Distances to: {c.reference}."
    return (Table("Position test", columns, rows, note=note), _curves(tests, c.reference_test))


def _curves(tests: list[tuple[str, PositionTest]], reference: PositionTest | None) -> TimeSeries:
    lines = [Line(title, t.angle_deg) for title, t in tests]
    if reference is not None:
        lines.append(Line("reference", reference.angle_deg, style="dashed"))
    time = tests[0][1].time_s
    return TimeSeries(
        "The axis follows a step of 50°",
        time,
        tuple(lines),
        Axis("angle", "°"),
        levels=(Mark(50.0, "wanted"),),
        group="position test",
    )


def _heldout_blocks(c: Comparison) -> tuple[Block, ...]:
    scored = [(m.title, m.heldout) for m in c.methods if m.heldout is not None]
    if not scored:
        return (Items(("no method can be simulated over this capture",)),)
    names = scored[0][1].channels
    columns = (
        Column("method", text=True),
        *(Column(f"{n}, free run") for n in names),
        *(Column(f"{n}, 1 s") for n in names),
    )
    rows = tuple((title, *(s.rmse.get(n) for n in names), *(s.rmse_1s.get(n) for n in names)) for title, s in scored)
    block = c.capture.block()
    first = len(block) - len(scored[0][1].simulated)
    time = block.time_s[first:] - block.time_s[0]
    figures = []
    for name, label, unit in (("current_A", "current", "A"), ("position_rad", "angle", "rad")):
        measured = getattr(block, name)
        if name not in names or measured is None:
            continue
        k = names.index(name)
        lines = (Line("measured", measured[first:]), *(Line(t, _shown(s.simulated[:, k])) for t, s in scored))
        figures.append(TimeSeries(f"Held out: {label}", time, lines, Axis(label, unit), group="held out"))
    return (Table("RMS error on the last 30 %, which no method has seen", columns, rows), *figures)


def _shown(values: np.ndarray) -> np.ndarray:
    return np.where(np.abs(values) < 1e12, values, np.nan)


def _paper_sections(document: Mapping[str, Any], p: PaperRedone) -> list[Section]:
    curves = [("method 1", p.tests["method1"]), ("method 2", p.tests["method2"])]
    test, table = document["paper_position_test"], document["table1"]
    gain = (
        f"Chosen: k_io·k_s = {test['k_io_k_s_V_rad']:.4g} V/rad, so that method 1 stands at 45°. Method 2 then follows."
    )
    open_ones = Items(tuple(d["text"] for d in table["angle_alone"]["null_directions"]))
    return [
        Section("The paper's method 1 and ours", (_digits(document), Text(document["method1_note"]))),
        Section("The paper's position test", (Text(gain), _curves(curves, None))),
        Section("The paper's Table 1 and ours", (_iterations_table(table), Items(tuple(verdict_lines(table))))),
        Section("From the angle alone, as in the paper", (*_ways(table["angle_alone"], "Angle alone"), open_ones)),
        Section("From current and angle", (*_ways(table["current_and_angle"], "Current and angle"), _figure_6(p))),
    ]


def _digits(document: Mapping[str, Any]) -> Table:
    columns = (
        Column("parameter", text=True),
        Column("unit", text=True),
        Column("paper", text=True),
        Column("ours", text=True),
        Column("digits that agree", text=True),
    )
    rows = tuple(
        (n, c["unit"], c["printed"], c["ours"], "an input" if c["input"] else f"{c['agreeing']} of {c['digits']}")
        for n, c in document["method1_digits"].items()
    )
    return Table("Comparing coefficients with 1 = D R + k²", columns, rows)


def _iterations_table(table: Mapping[str, Any]) -> Table:
    heading, *rows = table_1_rows(table)
    columns = tuple(Column(h, text=k == 0) for k, h in enumerate(heading))
    return Table("Iterations", columns, tuple(tuple(row) for row in rows), note="Costs scaled to the paper's first.")


def _figure_6(p: PaperRedone) -> TimeSeries:
    """Measured and simulated angle."""
    fit = p.from_both
    k, segment = fit.problem.channels.index("position_rad"), fit.problem.segments[0]
    residual = fit.solution.point.linearisation.residuals[0][:, k]
    measured = segment.measured[:, k]
    lines = (Line("measured", measured), Line("simulated", measured - residual, style="dashed"))
    title = "The paper's Figure 6 from our run: measured and simulated angle"
    return TimeSeries(title, segment.rows[:, 0], lines, Axis("angle", "rad"), group="experiment")


def _ways(run: Mapping[str, Any], title: str) -> tuple[Block, ...]:
    rows = run["iterations"]
    number = np.array([float(r["iteration"]) for r in rows])
    cost = np.array([r["cost"] for r in rows])
    last = rows[-1]["parameters"]
    ways = tuple(Line(n, np.array([r["parameters"][n] / last[n] for r in rows])) for n in last)
    return (
        Iterations(
            f"{title}: cost (the paper's Figure 4)", number, (Line("cost", cost),), Axis("cost", log=True), group=title
        ),
        Iterations(
            f"{title}: parameters over their last value (Figure 5)",
            number,
            ways,
            Axis("value / last value"),
            group=title,
        ),
    )
