"""What a diagnosis is given and what it leaves: the capture and the drive's model as files, the document it writes.

The drive is handed over as a configuration file of its own: its present model in the place of the configured one, and
what is known of its parameters now in the place of their nominal values, so that the motor as it is is what is doubted.
"""

from __future__ import annotations

import json
import logging
import math
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeGuard

from drivers.base import DriveInfo
from servo_daemon.config import DriveConfig
from servo_daemon.errors import DiagnosisError
from servo_daemon.parameters import KNOWN
from servo_daemon.pipeline.model_change import parameters_of
from servo_daemon.plant.effects import parameter_table
from servo_daemon.published.diagnosis_state import Diagnosis
from servo_daemon.published.snapshot import Estimate
from servo_daemon.published.view import StartValues
from servo_daemon.samples import SampleBlock
from servo_daemon.signal_meaning import SignalMeaning, as_texts

log = logging.getLogger(__name__)

CAPTURE, DRIVE, DOCUMENT, REPORT, RECORD = "capture.csv", "drive.toml", "diagnosis.json", "report.html", "record.json"
#: What an unfinished diagnosis leaves for the next one: its recording, its drive, what it has fitted.
JOURNAL, UNFINISHED = "journal.jsonl", "unfinished"
_VERDICTS = ("none", "found", "unexplained")


def drive_toml(config: DriveConfig, estimate: Estimate | None) -> str:
    """A configuration with this one drive, its model and parameters as they are now.

    Args:
        config: with the present model.
        estimate: the last one.
    """
    nominal = dict(config.nominal)
    for p in estimate.parameters if estimate is not None else ():
        if p.status in KNOWN and p.value is not None and p.name in parameter_table():
            nominal[p.name] = p.value
    head = {"name": config.name, "model": list(config.model)}
    tables = {
        "nominal": nominal,
        "estimation": {"skew_s": config.estimation.skew_s},
        "load": config.load.model_dump(exclude_none=True),
        "limits": config.limits.model_dump(exclude_none=True),
    }
    lines = ["# The drive as it is now, written by servo-daemon for its diagnosis.", "[[drive]]", *_pairs(head)]
    for name, table in tables.items():
        if table:
            lines += [f"[drive.{name}]", *_pairs(table)]
    return "\n".join(lines) + "\n"


def _pairs(table: Mapping[str, Any]) -> list[str]:
    """TOML: JSON's texts, numbers and lists are TOML's, too."""
    return [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in table.items()]


def capture_metadata(config: DriveConfig, info: DriveInfo, version: str, meaning: SignalMeaning) -> dict[str, str]:
    """As `record` writes it.

    Args:
        meaning: of the drive's signals; those of the ring have been converted.
    """
    metadata = {"generator": f"servo-daemon {version} run", "drive": config.name, "driver": config.driver}
    metadata |= {key: f"{value:g}" for key, value in config.load.model_dump().items() if value is not None}
    if info.identity:
        metadata["identity"] = info.identity
    if meaning != SignalMeaning():
        metadata |= as_texts(meaning.as_dc)
    if info.counts_per_rev:
        metadata.setdefault("counts_per_rev", f"{info.counts_per_rev:g}")
    return metadata


def write_inputs(folder: Path, blocks: Iterable[SampleBlock], metadata: Mapping[str, str], toml: str) -> int:
    """Capture and drive into a folder. Returns how many samples the capture has.

    Raises:
        ServoDaemonError: the disk refuses, or the samples are no capture.
    """
    from servo_daemon.captures import CaptureWriter

    with CaptureWriter(folder / CAPTURE, metadata=metadata) as writer:
        for block in blocks:
            writer.write(block)
    if not writer.samples:
        raise DiagnosisError("no sample of the recording is a measurement")
    try:
        (folder / DRIVE).write_text(toml, encoding="utf-8")
    except OSError as error:
        raise DiagnosisError(f"{folder / DRIVE}: {error.strerror or error}") from error
    return writer.samples


def put_by(scratch: Path, folder: Path, *, unfinished: bool) -> None:
    """What an unfinished diagnosis worked on, for the next one; nothing of one that was finished. A disk that refuses
    costs the next one time, no more."""
    kept = folder / UNFINISHED
    shutil.rmtree(kept, ignore_errors=True)
    if unfinished:
        try:
            kept.mkdir()
            for name in (CAPTURE, DRIVE, JOURNAL):
                (scratch / name).replace(kept / name)
        except OSError as error:
            log.warning("%s: %s", kept, error.strerror or error)


def take_up(folder: Path, scratch: Path) -> bool:
    """The same the other way; False: it is not there as a whole."""
    try:
        for name in (CAPTURE, DRIVE, JOURNAL):
            shutil.copyfile(folder / UNFINISHED / name, scratch / name)
    except OSError:
        return False
    return True


def read_document(path: Path) -> dict[str, Any]:
    """The document that a diagnosis has written.

    Raises:
        DiagnosisError: it is not there, or not what was agreed on.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"), parse_constant=_no_constant)
        if document["schema"] != 1:
            raise ValueError(f"schema {document['schema']!r}, this version reads 1")
        if document["verdict"] not in _VERDICTS:
            raise ValueError(f"verdict {document['verdict']!r}")
        for effect in document["effects"]:
            if not isinstance(effect["name"], str) or not isinstance(effect["parameters"], dict):
                raise ValueError(f"effect {effect!r}")
        if bool(document["effects"]) != (document["verdict"] == "found"):
            raise ValueError(f"verdict {document['verdict']!r} with {len(document['effects'])} effects")
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        what = f"{type(error).__name__}: {error}" if isinstance(error, KeyError) else str(error)
        raise DiagnosisError(f"the diagnosis left no usable {path.name}: {what}") from error
    return document  # type: ignore[no-any-return]


def save_record(folder: Path, done: Diagnosis) -> None:
    """Beside a result: of what it is. Where it cannot be written the next run of the daemon knows no result."""
    record = {
        "trigger": done.trigger,
        "model": list(done.model or ()),
        "started": done.started,
        "finished": done.finished,
        "samples": done.samples,
        "span_s": done.span_s,
    }
    try:
        (folder / RECORD).write_text(json.dumps(record), encoding="utf-8")
    except OSError as error:
        log.warning("%s: %s", folder / RECORD, error.strerror or error)


def load_record(folder: Path) -> Diagnosis | None:
    """The result of an earlier run of the daemon; None where there is none that can be used."""
    if not (folder / RECORD).exists():
        return None
    try:
        record = json.loads((folder / RECORD).read_text(encoding="utf-8"), parse_constant=_no_constant)
        return Diagnosis(
            "done",
            "mismatch" if record["trigger"] == "mismatch" else "request",
            tuple(str(m) for m in record["model"]),
            float(record["started"]),
            float(record["finished"]),
            int(record["samples"]),
            float(record["span_s"]),
            1.0,
            result=read_document(folder / DOCUMENT),
            report=folder / REPORT if (folder / REPORT).exists() else None,
        )
    except (OSError, ValueError, KeyError, TypeError, RecursionError, DiagnosisError) as error:
        log.warning("%s: the last diagnosis cannot be read: %s", folder, error)
        return None


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} in it")


def start_values(document: Mapping[str, Any], effects: Sequence[str]) -> StartValues:
    """Where a filter with these effects is to begin: what was fitted, as far as such a model has it and it is possible.

    Args:
        effects: the whole model.
    """
    fitted: dict[str, Any] = dict((document.get("extended") or {}).get("parameters") or {})
    for effect in document["effects"]:
        fitted |= effect["parameters"]
    start: dict[str, tuple[float | str, float | None]] = {}
    for name, p in parameters_of(effects).items():
        entry = fitted.get(name)
        value, std = (entry.get("value"), entry.get("std")) if isinstance(entry, dict) else (entry, None)
        if isinstance(value, str) and value in p.choices:
            start[name] = value, None
        elif _is_number(value) and p.lower <= value <= p.upper:
            start[name] = float(value), float(std) if _is_number(std) and std > 0 else None
    return start


def _is_number(value: Any) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
