"""Where an exported model comes from: a document of `fit` or `diagnose`, a configuration, a running daemon."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

from servo_daemon.captures.capture.model import LINEAR_COLUMNS
from servo_daemon.commands.shared import daemon_http
from servo_daemon.config import Config, DriveConfig
from servo_daemon.errors import BadInputError
from servo_daemon.export.model import CORE, ExportedModel, Value
from servo_daemon.plant.core import Drive
from servo_daemon.plant.effects import check_effects, effects_by_name, parameter_table
from servo_daemon.signal_meaning import SignalMeaning

#: Statuses of parameters that no number may be taken from.
_UNUSABLE = {"invalid": "do not use: the estimate is invalid", "undetermined": "these data do not determine it"}


def from_document(path: Path, name: str | None, config: Config | None = None) -> ExportedModel:
    """The model of a `fit.json` or `diagnosis.json`.

    Args:
        name: of the configuration's drive; None: the one that the document names, or the first.
        config: what it says besides: limits, signals.

    Raises:
        BadInputError: it is no such document.
        ConfigError: there is no such drive.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        address = " (a daemon's address begins with http://)" if ":" in str(path) else ""
        raise BadInputError(f"{path}: {error.strerror or error}{address}") from None
    except (ValueError, RecursionError) as error:
        raise BadInputError(
            f"{path}: no JSON document ({error}): name the fit.json of `fit --out`, the diagnosis.json of `diagnose`, "
            "a daemon's address, or a configuration with --config"
        ) from None
    if not isinstance(document, Mapping):
        raise BadInputError(f"{path}: neither a fit.json nor a diagnosis.json")
    found: Any
    if "verdict" in document:
        found = document.get("extended") or document.get("baseline")
        what = f"the {'extended' if document.get('extended') else 'baseline'} model of {path}"
    else:
        found, what = document, str(path)
    try:
        rows, effects = found["parameters"], found["model"]
        input_ = document.get("input") or _input(rows)
        linear = not set(LINEAR_COLUMNS).isdisjoint(document.get("measured", ()))
    except (KeyError, TypeError):
        raise BadInputError(
            f"{path}: neither a fit.json nor a diagnosis.json: it has no model and parameters"
        ) from None
    own, drive = document.get("drive"), None
    if config is not None:
        if name is None and any(d.name == own for d in config.drive):
            name = own
        drive = config.drive_named(name)
    called = name or own or (drive.name if drive is not None else path.stem)
    signals = document.get("signals")
    model = _checked(str(called), what, input_, effects, rows, str(path), linear=linear)
    meaning = _meaning(signals, str(path)) if isinstance(signals, Mapping) else None
    return _with_drive(model, drive, meaning)


def from_daemon(url: str, name: str | None, config: Config | None) -> ExportedModel:
    """What a running daemon says of a drive now.

    Args:
        name: of its drive; None: its first.
        config: what it says besides of the drive of that name: limits, signals.

    Raises:
        BadInputError, ServoDaemonError: as `daemon_http.get`.
        ConfigError: the configuration has no such drive.
    """
    drives = [d["name"] for d in daemon_http.document(url, "/drives")["drives"]]
    name = drives[0] if name is None else name
    document = daemon_http.document(url, f"/drives/{quote(name, safe='')}/estimates")
    rows = document["parameters"]
    source = f"{url}, drive {name}, {document['time'] or 'before the first sample'}"
    model = _checked(name, source, _input(rows), document["model"], rows, url, linear=False)
    drive = None if config is None else config.drive_named(name)
    rate = document.get("sample_rate_hz")
    signals = daemon_http.document(url, f"/drives/{quote(name, safe='')}").get("signals")
    meaning = _meaning(signals, url) if isinstance(signals, Mapping) else None
    return replace(_with_drive(model, drive, meaning), sample_period_s=1.0 / rate if rate else None)


def from_config(drive: DriveConfig, path: Path) -> ExportedModel:
    """The nominal values of a configured drive."""
    rows = {name: {"value": value, "std": None, "status": "nominal"} for name, value in drive.nominal.items()}
    source = f"{path}, drive {drive.name}"
    model = _checked(drive.name, source, "voltage", drive.model, rows, str(path), linear=False)
    return _with_drive(model, drive, SignalMeaning())


def with_fixed(model: ExportedModel, fixed: Mapping[str, float]) -> ExportedModel:
    """With values that the user knows.

    Raises:
        BadInputError: the model has no such parameter.
    """
    if lost := [name for name in fixed if name not in model.needed]:
        raise BadInputError(f"--fix: the model has no parameter {', '.join(lost)}")
    table = parameter_table()
    given = {n: Value(v, None, model.values[n].unit if n in model.values else table[n].unit, "given with --fix")
             for n, v in fixed.items()}  # fmt: skip
    missing = {name: why for name, why in model.missing.items() if name not in fixed}
    return replace(model, values=_in_order(model.needed, {**model.values, **given}), missing=missing)


def _checked(
    name: str, source: str, input_: object, effects: Any, rows: Any, place: str, *, linear: bool
) -> ExportedModel:
    if input_ not in CORE or not isinstance(rows, Mapping) or not isinstance(effects, list | tuple):
        raise BadInputError(f"{place}: neither a fit.json nor a diagnosis.json: its model cannot be read")
    names = tuple(effects)
    check_effects(names)
    drive: Drive = input_  # type: ignore[assignment]
    values, missing = dict[str, Value](), dict[str, str]()
    needed = dict.fromkeys((*CORE[drive], *(p.name for n in names for p in effects_by_name()[n].parameters)))
    # R and L of a voltage that is a measurement are known beside a model that the current drives.
    for parameter in (*needed, *(n for n in ("R", "L", "K") if n not in needed and n in rows)):
        row = rows.get(parameter, {})
        try:
            value, why = _value(parameter, row)
        except (TypeError, ValueError, AttributeError) as error:
            raise BadInputError(f"{place}: parameter {parameter}: {error}") from None
        if value is not None:
            values[parameter] = value
        else:
            missing[parameter] = why
    return ExportedModel(name, source, drive, names, values, missing, linear=linear)


def _input(rows: Mapping[str, Any]) -> Drive:
    """What drives a model of these parameters."""
    return "voltage" if "R" in rows else ("current" if "K" in rows else "torque")


def _value(name: str, row: Mapping[str, Any]) -> tuple[Value | None, str]:
    """A parameter's row of any document, or why there is no number in it."""
    status, value, std = row.get("status"), row.get("value"), row.get("std")
    if status in _UNUSABLE and not (status == "undetermined" and value is not None):
        return None, _UNUSABLE[status]
    if value is None:
        return None, str(row.get("reason") or "no value")
    number = parameter_table()[name].read(value)
    # A number without a std that an estimator has not qualified is what the user told it.
    nominal = status in ("estimating", "undetermined", "nominal")
    origin = "nominal, not estimated" if nominal else str(status or "estimated")
    if row.get("at_bound") and status != "at_bound":
        origin += ", at a bound"
    unit = str(row.get("unit") or parameter_table()[name].unit)
    return Value(number, None if std is None or nominal else float(std), unit, origin), ""


def _meaning(signals: Mapping[str, Any], place: str) -> SignalMeaning:
    try:
        return SignalMeaning(**{key: signals[key] for key in SignalMeaning().document if key in signals})
    except (BadInputError, TypeError) as error:
        raise BadInputError(f"{place}: signals: {error}") from None


def _with_drive(model: ExportedModel, drive: DriveConfig | None, meaning: SignalMeaning | None) -> ExportedModel:
    """With what the configuration says of signals and limits."""
    known = meaning is not None
    meaning = meaning or SignalMeaning()
    limits: dict[str, float] = {}
    period = None
    if drive is not None:
        known = True
        period = None if drive.controller.rate_hz is None else 1.0 / drive.controller.rate_hz
        meaning = drive.signals.meaning(meaning)
        given = drive.limits
        names = ("voltage_V", "current_A", "velocity_rad_s")
        limits = {n: float(v) for n in names if (v := getattr(given, n)) is not None}
    return replace(model, meaning=meaning, gear_known=known, limits=limits, sample_period_s=period)


def _in_order(names: tuple[str, ...], values: Mapping[str, Value]) -> dict[str, Value]:
    first = {name: values[name] for name in names if name in values}
    return first | {name: value for name, value in values.items() if name not in first}
