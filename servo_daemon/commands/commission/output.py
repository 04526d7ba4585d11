"""What `commission` shows and writes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from drivers.base import DriveInfo
from servo_daemon import __version__
from servo_daemon.captures import Capture, write_capture
from servo_daemon.commands.shared import common
from servo_daemon.commands.shared.output_folder import OutputFolder
from servo_daemon.commands.tune import output as tune_output
from servo_daemon.commands.tune.motor import fitted_motor
from servo_daemon.commissioning import Ask, Commissioning, MotionLimits
from servo_daemon.config import DriveConfig
from servo_daemon.diagnosis.verdict.result import Diagnosis
from servo_daemon.errors import TuningError
from servo_daemon.files import AtomicFile
from servo_daemon.pipeline.controller import loop_facts
from servo_daemon.plant.effects import effects_by_name
from servo_daemon.samples import Quality
from servo_daemon.tuning.document import document as tuning_document
from servo_daemon.tuning.report import Tuning, tune

_GAINS = ("tuning.json", "controller.toml")
_FILES = ("capture.csv.gz", "commission.json", "commission.toml", *_GAINS)
_INVALID = int(Quality.VOLTAGE_INVALID | Quality.CURRENT_INVALID | Quality.POSITION_INVALID)


def prepare(out: Path | None, force: bool) -> None:
    """Before anything moves: the folder can be written to.

    Raises:
        BadInputError: it cannot, or there are results already.
    """
    if out is not None:
        common.may_overwrite(force, *(out / name for name in _FILES))
        OutputFolder(out).check_writable()


def capture_of(drive: DriveConfig, info: DriveInfo, result: Commissioning) -> Capture:
    """All samples as a capture."""
    metadata = {"generator": f"servo-daemon {__version__} commission", "drive": drive.name, "driver": drive.driver}
    if info.counts_per_rev:
        metadata["counts_per_rev"] = f"{info.counts_per_rev:g}"
    block = result.block.select((result.block.quality & _INVALID) == 0)
    channels = {name: getattr(block, name) for name in block.channels}
    return Capture(Path(_FILES[0]), block.time_s, metadata=metadata, **channels)


def tuned(drive: DriveConfig, info: DriveInfo, result: Commissioning, diagnosis: Diagnosis | None) -> Tuning | None:
    """Gains for the motor, and what those in use are worth; None where the motor is not known: a run that was stopped
    or is unexplained tells it only if a diagnosis has found why."""
    found = diagnosis is not None and diagnosis.extended is not None
    if result.fit is None or not (result.outcome == "known" or found):
        return None
    facts = loop_facts(drive, info.counts_per_rev)
    try:
        motor = fitted_motor(drive, result.fit, {}, "commissioning")
        rate = None if info.sample_period_s is None else 1.0 / info.sample_period_s
        return tune(motor, facts.setup(rate), facts.ask, facts.log_nominal)
    except TuningError as error:
        common.note(f"no gains: {error}")
        return None


def document(
    drive: DriveConfig, limits: MotionLimits, ask: Ask, result: Commissioning, diagnosis: Diagnosis | None,
    tuning: Tuning | None,
) -> dict[str, Any]:  # fmt: skip
    """`commission.json`."""
    parameters = {} if result.fit is None else result.fit.parameters
    return {
        "drive": drive.name,
        "outcome": result.outcome,
        "stop": None if result.stop is None else asdict(result.stop),
        "accuracy": ask.accuracy,
        "unknown": list(result.unknown),
        "motion_s": round(result.motion_s, 3),
        "limits": asdict(limits),
        "peaks": dict(result.peaks),
        "model": [] if result.fit is None else list(result.fit.problem.plant.effects),
        "parameters": {
            name: {"value": p.value, "std": p.std, "unit": p.unit, "status": p.status} for name, p in parameters.items()
        },
        "diagnosis": None if diagnosis is None else _diagnosis_row(diagnosis),
        "tuning": None if tuning is None else tuning_document(tuning),
    }


def _diagnosis_row(d: Diagnosis) -> dict[str, Any]:
    names = [e.name for e in d.effects]
    return {
        "verdict": d.verdict,
        "effects": names,
        "causes": {name: effects_by_name()[name].cause for name in names},
        "equivalent": {e.name: list(e.equivalent) for e in d.effects},
        "depends_on": list(dict.fromkeys(x.on for x in d.depends_on)),
        "not_tried": [] if d.unfinished is None else list(d.unfinished.not_tried),
    }


def findings(report: Mapping[str, Any]) -> list[str]:
    """What stopped the run, and what a diagnosis found, a line each."""
    lines = [] if report["stop"] is None else [f"stopped: {report['stop']['text']}"]
    if (d := report["diagnosis"]) is None:
        return lines
    for name in d["effects"]:
        ties = "".join(f" (or {other})" for other in d["equivalent"][name])
        lines.append(f"found: {name}{ties}: {d['causes'][name]}")
    if d["verdict"] == "none":
        lines.append("a diagnosis finds nothing that the model lacks")
    elif not d["effects"]:
        follows = f"; what is left follows {', '.join(d['depends_on'])}" if d["depends_on"] else ""
        lines.append(f"a diagnosis names no cause{follows}")
    if d["not_tried"]:
        lines.append(f"its --budget was used up before {', '.join(d['not_tried'])} could be tried")
    return lines


def write(out: Path, capture: Capture, report: Mapping[str, Any], tuning: Tuning | None) -> None:
    """Write all files of `--out`."""
    folder = OutputFolder(out)
    write_capture(out / _FILES[0], capture.block(), metadata=capture.metadata)
    folder.write_json("commission.json", report)
    with AtomicFile(out / "commission.toml") as file:
        file.write(toml(report).encode())
    for name in _GAINS:  # those of an earlier run are not this motor's
        (out / name).unlink(missing_ok=True)
    if tuning is not None:
        tune_output.write(out, tuning, {"drive": report["drive"], "capture": _FILES[0], **tuning_document(tuning)})


def toml(report: Mapping[str, Any]) -> str:
    """For below `[[drive]]`: model, nominal values, and the limits that were kept to."""
    known = {
        name: p for name, p in report["parameters"].items() if p["value"] is not None and p["status"] != "undetermined"
    }
    limits = report["limits"]
    model = ", ".join(f'"{name}"' for name in report["model"])
    told = [f"{report['outcome']} after {report['motion_s']:g} s of motion", *findings(report)]
    lines = [*(f"# {line}" for line in told), f"model = [{model}]", "[drive.nominal]"]
    for name, p in known.items():
        std = "" if p["std"] is None else f"  # ± {p['std']:.2g} {p['unit']}"
        lines.append(f"{name} = {p['value']:.6g}{std}")
    lines += [
        "[drive.limits]",
        f"voltage_V = {limits['voltage_V']:g}",
        f"current_A = {limits['current_A']:g}",
        f"velocity_rad_s = {limits['speed_rad_s']:g}",
        f"travel_rad = {limits['travel_rad']:g}",
    ]
    return "\n".join(lines) + "\n"


def text(report: Mapping[str, Any], tuning: Tuning | None) -> str:
    """What the terminal shows."""
    lines = [f"drive {report['drive']}: {_OUTCOMES[report['outcome']]}, {report['motion_s']:.1f} s of motion"]
    lines += findings(report)
    for name, p in report["parameters"].items():
        if p["value"] is not None and p["std"] is not None:
            lines.append(f"  {name} = {p['value']:.5g} ± {p['std']:.2g} {p['unit']}")
        else:
            lines.append(f"  {name}: {p['status']}")
    limits = report["limits"]
    reached = ", ".join(f"{name} {100 * v / limits[name]:.0f} %" for name, v in report["peaks"].items())
    lines.append(f"of the limits: {reached}")
    if tuning is not None:
        lines.append(tune_output.text(tuning))
    return "\n".join(lines)


_OUTCOMES = {
    "known": "all parameters are known",
    "stopped": "stopped",
    "unexplained": "the model does not explain the motion",
    "not_known": "the time was used up before all was known",
}
