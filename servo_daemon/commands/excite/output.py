"""What `excite` writes and prints: the plan as CSV, the document, and the text."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from servo_daemon import __version__
from servo_daemon.errors import BadInputError
from servo_daemon.experiment import expected_errors, expected_stds
from servo_daemon.files import AtomicFile

if TYPE_CHECKING:
    from servo_daemon.experiment import ExpectedError, ExpectedStd, MotionPlan, Request

#: Column of the plan by what it is.
COLUMN = {"voltage": "voltage_V", "velocity": "velocity_rad_s", "position": "position_rad"}
_UNITS = {"voltage_V": "V", "current_A": "A", "velocity_rad_s": "rad/s", "travel_rad": "rad", "current_rms_A": "A RMS"}
#: From here on a wrong model shows: its error is 5 % above the noise.
_SHOWS = 1.05


def document(drive: str, path: Path, request: Request, plan: MotionPlan, notes: tuple[str, ...]) -> dict[str, Any]:
    """JSON-ready: plain types, no NaN, no infinity."""
    return {
        "plan": str(path),
        "drive": drive,
        "reference": request.reference,
        "seconds": len(plan.reference) / request.rate_hz,
        "rate_hz": request.rate_hz,
        "seed": request.seed,
        "model": list(request.model),
        "nominal": dict(request.known),
        "limits": {k: v if math.isfinite(v) else None for k, v in asdict(request.limits).items()},
        "peaks": {
            "nominal": asdict(plan.nominal),
            "worst": asdict(plan.worst),
            "multisine": asdict(plan.default_peaks),
        },
        "blocks": [
            {"begin_s": b.begin / request.rate_hz, "end_s": b.end / request.rate_hz, "motion": b.text}
            for b in plan.blocks
        ],
        "parameters": {p.name: _std(p) for p in expected_stds(plan)},
        "separation": [_error(e) for e in expected_errors(plan)],
        "notes": list(notes),
    }


def _std(p: ExpectedStd) -> dict[str, Any]:
    return {
        "value": p.value,
        "std": p.std,
        "multisine_std": p.default_std,
        "ratio": p.default_std / p.std,
        "unit": p.unit,
        "wanted": p.wanted,
    }


def _error(e: ExpectedError) -> dict[str, Any]:
    return {
        "truth": list(e.truth),
        "fitted": list(e.other),
        "error_over_noise": e.growth,
        "error_over_noise_least": e.least,
        "multisine_error_over_noise": e.default_growth,
        "multisine_error_over_noise_least": e.default_least,
    }


def check_path(path: Path) -> None:
    """That a plan can be written there, before it is computed.

    Raises:
        BadInputError: the name does not end in .csv or .csv.gz (a pipe may have any), or there is no folder.
    """
    if not path.name.endswith((".csv", ".csv.gz")) and (path.is_file() or not path.exists()):
        raise BadInputError(f"--out {path}: a plan's name ends in .csv or .csv.gz")
    if not path.parent.is_dir():
        raise BadInputError(f"--out {path}: cannot be written: {path.parent} is no folder")


def write(path: Path, plan: MotionPlan, report: Mapping[str, Any], command: str) -> None:
    """The CSV, complete or not there.

    Raises:
        BadInputError: the file cannot be made.
    """
    column = COLUMN[report["reference"]]
    lines = [f"# {key}: {value}" for key, value in _metadata(report, command)]
    lines.append(f"time_s,{column}")
    time = np.arange(len(plan.reference)) / report["rate_hz"]
    lines += [f"{t:.9g},{v:.6g}" for t, v in zip(time.tolist(), plan.reference.tolist(), strict=True)]
    with AtomicFile(path) as output:
        output.write(("\n".join(lines) + "\n").encode())


def _metadata(report: Mapping[str, Any], command: str) -> list[tuple[str, str]]:
    out = [
        ("generator", f"servo-daemon {__version__} excite"),
        ("command", " ".join(command.split())),
        ("drive", report["drive"]),
        ("reference", f"{report['reference']}, held from each sample to the next"),
        ("rate_hz", f"{report['rate_hz']:g}"),
        ("seed", str(report["seed"])),
        ("model", ",".join(report["model"]) or "linear"),
    ]
    out += [(f"nominal_{name}", f"{value:.9g}") for name, value in report["nominal"].items()]
    out += [(f"limit_{k}", f"{v:.6g}") for k, v in report["limits"].items() if v is not None]
    out += [(f"peak_{k}", f"{v:.6g}") for k, v in report["peaks"]["nominal"].items()]
    out += [(f"peak_worst_{k}", f"{v:.6g}") for k, v in report["peaks"]["worst"].items()]
    out += [("block", f"{b['begin_s']:g} s to {b['end_s']:g} s: {b['motion']}") for b in report["blocks"]]
    return out


def text(report: Mapping[str, Any]) -> str:
    """What the terminal shows."""
    lines = [
        f"{report['plan']}: {report['seconds']:g} s at {report['rate_hz']:g} Hz, {report['reference']} reference",
        "",
    ]
    lines += [f"  {b['begin_s']:6.3g} … {b['end_s']:<6.3g} s  {b['motion']}" for b in report["blocks"]]
    lines += ["", "the nominal motor, the worst of those it may be, and the limit:"]
    for key, limit in report["limits"].items():
        bound = "free" if limit is None else f"{limit:.4g}"
        nominal, worst = (report["peaks"][which][key] for which in ("nominal", "worst"))
        lines.append(f"  {_name(key):>12} {nominal:9.4g} {worst:9.4g} {bound:>9} {_UNITS[key]}")
    lines += _precision_lines(report) + _separation_lines(report)
    return "\n".join(lines)


def _name(key: str) -> str:
    return {"velocity_rad_s": "speed", "current_rms_A": "RMS current"}.get(key, key.split("_", maxsplit=1)[0])


def _precision_lines(report: Mapping[str, Any]) -> list[str]:
    if not report["parameters"]:
        return []
    lines = ["", "expected 1 σ after this plan, and after a multisine of equal length and limits:"]
    for name, p in report["parameters"].items():
        mark = "" if p["wanted"] else "  (not asked for)"
        lines.append(
            f"  {name:>8} = {p['value']:.5g} ± {p['std']:.2g} {p['unit']}, multisine ± {p['multisine_std']:.2g}: "
            f"{p['ratio']:.2g} times as well{mark}"
        )
    return lines


def _separation_lines(report: Mapping[str, Any]) -> list[str]:
    if not report["separation"]:
        return []
    lines = ["", "error that the wrong model would leave, in units of the noise (1: no trace), and after a multisine:"]
    for s in report["separation"]:
        truth, fitted = (" + ".join(s[key]) or "no effect" for key in ("truth", "fitted"))
        mine, theirs = s["error_over_noise"], s["multisine_error_over_noise"]
        lines.append(f"  {fitted} fitted to {truth}: {mine:.3g}, multisine {theirs:.3g}")
    if all(s["error_over_noise"] < _SHOWS for s in report["separation"]):
        lines.append("  no motion of the family tells these apart within the limits")
    return lines
