"""What `compare` prints for a reader."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import zip_longest
from typing import Any

from servo_daemon.parameters import MOTOR_NAMES


def print_compare(document: Mapping[str, Any]) -> None:
    """The document of `compare` as text on stdout."""
    lines: list[str] = []
    if "method1_paper" in document:
        lines += paper_lines(document)
    if "methods" in document:
        lines += capture_lines(document)
    print("\n".join(lines))


def _table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Columns as wide as their widest cell, the first to the left."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    out = []
    for row in rows:
        cells = [row[0].ljust(widths[0]), *(cell.rjust(w) for cell, w in zip(row[1:], widths[1:], strict=True))]
        out.append("  " + "  ".join(cells).rstrip())
    return out


def capture_lines(document: Mapping[str, Any]) -> list[str]:
    """The table of methods, then what each has to say."""
    rows = [["method", *MOTOR_NAMES, "50° after 5 s", "overshoot", "distance", "held-out current", "speed", "time"]]
    rows += [[m["title"], *_parameter_cells(m), *_result_cells(m)] for m in document["methods"].values()]
    if document["truth"]:
        truth = (f"{document['truth'][n]:.5g}" if n in document["truth"] else "" for n in MOTOR_NAMES)
        rows.append(["truth", *truth, *[""] * 6])
    test = document["position_test"]
    lines = [f"{document['capture']}: method 1 assumes R = {document['assumed_R']:g} Ω", "", *_table(rows), ""]
    for m in document["methods"].values():
        if m["reason"]:
            lines.append(f"  {m['title']}: {m['reason']}")
        lines += [f"  {m['title']}: {note}" for note in m["notes"]]
    lines.append(
        f"  50° test: position loop without tacho, k_io·k_s = {test['k_io_k_s_V_rad']:.4g} V/rad "
        f"({test['gain_chosen_by']}); distances to: {test['reference']}"
    )
    return lines


def _parameter_cells(m: Mapping[str, Any]) -> list[str]:
    cells = []
    for name in MOTOR_NAMES:
        p = m["parameters"].get(name)
        text = "—" if p is None else f"{p['value']:.5g}"
        if name in m["errors"]:
            text += f" ({100 * m['errors'][name]:+.2g} %)"
        cells.append(text)
    return cells


def _result_cells(m: Mapping[str, Any]) -> list[str]:
    test, heldout = m["position_test"], m["heldout"]
    cells = ["—"] * 3
    if test is not None:
        distance = "—" if test["distance_deg"] is None else f"{test['distance_deg']:.3g}°"
        cells = [f"{test['final_deg']:.2f}°", f"{100 * test['overshoot']:.1f} %", distance]
        if not test["stable"]:
            cells[0] = "unstable"
    rmse = {} if heldout is None else heldout["rmse"]
    for name, unit in (("current_A", "A"), ("velocity_rad_s", "rad/s")):
        cells.append(f"{rmse[name]:.4g} {unit}" if name in rmse else "—")
    return [*cells, f"{m['seconds']:.2f} s" if m["available"] else "—"]


def paper_lines(document: Mapping[str, Any]) -> list[str]:
    """Method 1 digit by digit, the position test, Table 1 beside our iterations."""
    rows = [["method 1", "paper", "ours", "digits that agree", ""]]
    for name, c in document["method1_digits"].items():
        kind = "(an input)" if c["input"] else ""
        rows.append([f"{name} / {c['unit']}", c["printed"], c["ours"], f"{c['agreeing']} of {c['digits']}", kind])
    test = document["paper_position_test"]
    lines = ["The paper's method 1, comparing coefficients, with its 1 = D R + k²:", "", *_table(rows), ""]
    lines += [f"  {document['method1_note']}", "", "Its position test, 50° after 5 s:", ""]
    first, second = test["methods"]["method1"], test["methods"]["method2"]
    lines += [
        f"  method 1: {first['final_deg']:.1f}°   chosen: k_io·k_s = {test['k_io_k_s_V_rad']:.4g} V/rad makes it the "
        "45° reported",
        f"  method 2: {second['final_deg']:.1f}°   reproduced with that gain (the paper: 99 %); overshoot "
        f"{100 * second['overshoot']:.0f} %",
        "",
        "Its Table 1, and ours from the same start on a simulated noisy experiment (cost scaled to its first):",
        "",
    ]
    verdict = (f"  {text}" for text in verdict_lines(document["table1"]))
    return [*lines, *_table(table_1_rows(document["table1"])), "", *verdict, ""]


def table_1_rows(table: Mapping[str, Any]) -> list[list[str]]:
    """Headings, then the paper's iterations beside ours."""
    rows = [
        ["iteration", "paper: F-count", "cost", "angle alone: F-count", "cost", "current and angle: F-count", "cost"]
    ]
    scale = table["paper"][0]["cost"]
    ours = [table[k]["iterations"] for k in ("angle_alone", "current_and_angle")]
    for k, parts in enumerate(zip_longest(table["paper"], *ours)):
        row = [str(k)]
        for source, part in enumerate(parts):
            factor = 1.0 if source == 0 else scale / ours[source - 1][0]["cost"]
            row += ["", ""] if part is None else [str(part["function_count"]), f"{part['cost'] * factor:.4g}"]
        rows.append(row)
    return rows


def verdict_lines(table: Mapping[str, Any]) -> list[str]:
    """What the two runs show."""
    angle, both = table["angle_alone"], table["current_and_angle"]
    lines = [
        f"from the angle alone the cost falls {angle['fall']:.3g}-fold, and {len(angle['null_directions'])} null "
        "directions are left: the values are not determined by the data, whatever the fit looks like"
    ]
    lines += [d["text"] for d in angle["null_directions"]]
    errors = ", ".join(f"{name} {e:+.1f}" for name, e in both["errors_in_std"].items())
    lines.append(f"from current and angle all five are determined; errors in standard deviations: {errors}")
    floor = {n: both["residual"]["rmse"][n] / both["noise_floor"][n] for n in both["noise_floor"]}
    lines.append("residual over the noise floor: " + ", ".join(f"{n} {v:.4f}" for n, v in floor.items()))
    return lines
