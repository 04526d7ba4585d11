"""What the daemon tells Prometheus: every published number of every drive, SI units in the metric names."""

from __future__ import annotations

import math
import re
from typing import Final, get_args

from servo_daemon.parameters import Status
from servo_daemon.published.diagnosis_state import DiagnosisStatus
from servo_daemon.published.exposition import Exposition, unit_words
from servo_daemon.published.sinks import SinkState
from servo_daemon.published.snapshot import Connection, Estimate, ParameterEstimate, Snapshot
from servo_daemon.published.trends import DAY_S
from servo_daemon.published.units import split_unit
from servo_daemon.published.view import DaemonView, DriveView
from servo_daemon.trend.series import YEAR_D

_PREFIX: Final = "servo_daemon_"

#: Words for the parameters of the linear motor; an effect's parameter goes by its own name.
_PARAMETER_WORDS: Final = {
    "R": "resistance",
    "L": "inductance",
    "K": "torque_constant",
    "J": "inertia",
    "B": "viscous_friction",
    "J_d": "load_inertia",
}

_COUNTER_HELP: Final = {
    "samples": "Samples received from the drive.",
    "samples_lost": "Samples lost: missing in the drive's own numbering, or dropped by a full queue.",
    "samples_repeated": "Samples or frames received twice and used once.",
    "queue_dropped": "Samples dropped because the pipeline did not keep up.",
    "crc_errors": "Complete frames with a wrong checksum.",
    "framing_errors": "Bytes or frames that could not be read: garbage, half frames, wrong baud rate, bus errors.",
    "reconnects": "Times the device was opened again after it had gone away.",
    "device_restarts": "Times the device's own time or numbering jumped back.",
}

_HISTORY_HELP: Final = {
    "rows": "Rows written to the history.",
    "rows_dropped": "Rows that memory no longer had when the history could be written again.",
    "events_dropped": "Events that memory no longer had when the history could be written again.",
    "outages": "Times the history went out of reach.",
}

#: Unit at the end of a key of the health record -> unit in the metric name, and the factor to the SI base unit.
_HEALTH_UNITS: Final = (
    ("_rad_s", "_radian_per_second", 1.0),
    ("_rad", "_radian", 1.0),
    ("_us", "_seconds", 1e-6),
    ("_ms", "_seconds", 1e-3),
    ("_s", "_seconds", 1.0),
    ("_hz", "_hertz", 1.0),
    ("_deg", "_radian", math.pi / 180.0),
    ("_dB", "_decibel", 1.0),
    ("_A", "_ampere", 1.0),
    ("_V", "_volt", 1.0),
)
_GAUGES_AMONG_COUNTERS: Final = re.compile(r"(^|_)(depth|length|capacity)$|^queue_samples$|^poll_")


def render_metrics(daemon: DaemonView) -> str:
    """The whole exposition. Values that are not known are absent, never NaN."""
    out = Exposition()
    out.add(_PREFIX + "build_info", "gauge", "Version of the daemon.", 1, version=daemon.version)
    out.add(_PREFIX + "start_time_seconds", "gauge", "Start of the daemon, Unix time.", daemon.started)
    out.add(_PREFIX + "healthy", "gauge", "1 while the daemon itself has no problem.", not daemon.problems())
    if daemon.archive is not None:
        for name, help_text in _HISTORY_HELP.items():
            out.add(f"{_PREFIX}history_{name}_total", "counter", help_text, getattr(daemon.archive.counts, name))
    for sink in daemon.sinks:
        _add_sink(out, sink)
    for drive in daemon.drives.values():
        snapshot = drive.snapshot()
        _add_drive(out, drive.name, drive.driver, snapshot)
        _add_model(out, drive)
        _add_trends(out, drive)
        if snapshot.estimate is not None:
            _add_estimate(out, drive.name, snapshot.estimate, set(snapshot.counters))
    return out.render()


def _add_sink(out: Exposition, sink: SinkState) -> None:
    of = {"sink": sink.name}
    text = "1 while the broker or webhook can be reached; absent before the first attempt."
    out.add(_PREFIX + "sink_connected", "gauge", text, sink.connected, **of)
    out.add(_PREFIX + "sink_waiting", "gauge", "Events and states that wait for it.", sink.waiting, **of)
    out.add(_PREFIX + "sink_sent_total", "counter", "Messages that have arrived there.", sink.sent, **of)
    text = "Events and states that were given up: the buffer was full, or they were refused."
    out.add(_PREFIX + "sink_dropped_total", "counter", text, sink.dropped, **of)
    out.add(_PREFIX + "sink_reconnects_total", "counter", "Times it could be reached again.", sink.reconnects, **of)


def _add_drive(out: Exposition, drive: str, driver: str, snapshot: Snapshot) -> None:
    out.add(_PREFIX + "drive_info", "gauge", "The configured drives.", 1, drive=drive, driver=driver)
    for state in get_args(Connection):
        out.add(
            _PREFIX + "connection_state",
            "gauge",
            "1 for the state the connection to the drive is in.",
            state == snapshot.connection,
            drive=drive,
            state=state,
        )
    out.add(
        _PREFIX + "last_sample_time_seconds",
        "gauge",
        "Arrival of the last sample, Unix time.",
        snapshot.time,
        drive=drive,
    )
    text = "1 while samples come faster than they are worked off: the oldest are left out."
    out.add(_PREFIX + "overloaded", "gauge", text, snapshot.overloaded, drive=drive)
    for key, value in snapshot.counters.items():
        word = _clean(key)
        if _GAUGES_AMONG_COUNTERS.search(word):
            out.add(_PREFIX + word, "gauge", f"{_sentence(key)} now.", value, drive=drive)
        else:
            text = _COUNTER_HELP.get(key, f"{_sentence(key)} since the start.")
            out.add(f"{_PREFIX}{word}_total", "counter", text, value, drive=drive)
    for name, true_value in (snapshot.truth or {}).items():
        out.add(
            _PREFIX + "simulated_truth",
            "gauge",
            "The simulated drive's true value in the parameter's SI unit.",
            true_value,
            drive=drive,
            parameter=name,
        )


def _add_model(out: Exposition, drive: DriveView) -> None:
    name, view = drive.name, drive.diagnosis
    out.add(
        _PREFIX + "model_info", "gauge", "Effects of the drive's model.", 1, drive=name, model=",".join(drive.model)
    )
    for status in get_args(DiagnosisStatus):
        is_now = status == view.diagnosis.status
        text = "1 for the status of the last diagnosis of what the model lacks."
        out.add(_PREFIX + "diagnosis_status", "gauge", text, is_now, drive=name, status=status)
    if view.diagnosis.status == "running":
        text = "How far the running diagnosis is, 0 to 1."
        out.add(_PREFIX + "diagnosis_progress_ratio", "gauge", text, view.diagnosis.progress, drive=name)
    for verdict in ("none", "found", "unexplained", "failed"):
        text = "Diagnoses by what they ended in, since the start."
        out.add(_PREFIX + "diagnoses_total", "counter", text, view.counts.get(verdict, 0), drive=name, verdict=verdict)
    for effect in view.diagnosis.effects:
        out.add(_PREFIX + "diagnosis_found", "gauge", "What the last diagnosis found.", 1, drive=name, effect=effect)


def _add_trends(out: Exposition, drive: DriveView) -> None:
    for name, trend in drive.trends.trends.items():
        of = {"drive": drive.name, "parameter": name}
        if trend.used is not None:
            text = (
                "Share of the way from the nominal value to the limit that is gone, season and temperature taken out."
            )
            out.add(_PREFIX + "life_used_ratio", "gauge", text, trend.used.mid, **of)
        if trend.rate_percent is not None and trend.rate_percent.mid is not None:
            text = "Change in a year as a share of the nominal value; absent without a trend."
            out.add(_PREFIX + "ageing_ratio_per_year", "gauge", text, trend.rate_percent.mid / 100.0, **of)
        if trend.years is None or trend.limit is None:
            continue
        text = "Time until the parameter reaches its limit, by probability; absent without a trend or beyond 30 years."
        for probability, years in (("0.1", trend.years.low), ("0.5", trend.years.mid), ("0.9", trend.years.high)):
            seconds = None if years is None else years * YEAR_D * DAY_S
            more = {**of, "limit": trend.limit.name, "probability": probability}
            out.add(_PREFIX + "time_until_limit_seconds", "gauge", text, seconds, **more)
    if drive.trends.time is not None:
        text = "1 while a parameter of the drive may reach its limit within warn_before."
        out.add(_PREFIX + "limit_near", "gauge", text, bool(drive.trends.near), drive=drive.name)


def _add_estimate(out: Exposition, drive: str, estimate: Estimate, counters: set[str]) -> None:
    out.add(
        _PREFIX + "sample_rate_hertz",
        "gauge",
        "Samples a second, in the device's own time.",
        estimate.sample_rate_hz,
        drive=drive,
    )
    for parameter in estimate.parameters:
        _add_parameter(out, drive, parameter)
    _add_alarms(out, drive, estimate)
    for name, value in estimate.state.items():
        stem, unit = split_unit(name)
        word, text = (_clean(stem), "") if unit is None else (f"{_clean(stem)}_{unit_words(unit)}", f" in {unit}")
        out.add(_PREFIX + word, "gauge", f"Estimated {stem}{text}.", value, drive=drive)
    for key, state in estimate.health.items():
        if key in counters or not isinstance(state, bool | int | float):
            continue
        word, factor = _health_word(key)
        out.add(_PREFIX + word, "gauge", f"{_sentence(key)}.", _scaled(state, factor), drive=drive)


def _add_parameter(out: Exposition, drive: str, p: ParameterEstimate) -> None:
    word = _PREFIX + _PARAMETER_WORDS.get(p.name, _clean(p.name))
    unit = unit_words(p.unit)
    tail = f"_{unit}" if unit else ""
    text = f"Parameter {p.name}{f' in {p.unit}' if p.unit else ''}"
    out.add(word + tail, "gauge", f"{text}, estimated.", p.value, drive=drive)
    out.add(f"{word}_std{tail}", "gauge", f"{text}, standard deviation (1 sigma).", p.std, drive=drive)
    out.add(f"{word}_nominal{tail}", "gauge", f"{text}, nominal value.", p.nominal, drive=drive)
    for status in get_args(Status):
        out.add(
            _PREFIX + "parameter_status",
            "gauge",
            "1 for the status the parameter's estimate has.",
            status == p.status,
            drive=drive,
            parameter=p.name,
            status=status,
        )


def _add_alarms(out: Exposition, drive: str, estimate: Estimate) -> None:
    """Both sides of every parameter, so that an alarm which ends goes to 0 instead of vanishing."""
    if "alarms" not in estimate.health:
        return
    active = str(estimate.health["alarms"] or "").split(",")
    for parameter in estimate.parameters:
        for limit in ("min", "max"):
            out.add(
                _PREFIX + "parameter_alarm",
                "gauge",
                "1 while the parameter is beyond the limit that the configuration sets.",
                f"{parameter.name}_{limit}" in active,
                drive=drive,
                parameter=parameter.name,
                limit=limit,
            )


def _health_word(key: str) -> tuple[str, float]:
    for suffix, word, factor in _HEALTH_UNITS:
        if key.endswith(suffix):
            return _clean(key.removesuffix(suffix)) + word, factor
    return _clean(key), 1.0


def _scaled(value: float | int | bool, factor: float) -> float | int | bool:
    return value if factor == 1.0 else value * factor


def _clean(key: str) -> str:
    """A key as part of a metric name."""
    return re.sub(r"[^a-zA-Z0-9_]", "_", key)


def _sentence(key: str) -> str:
    words = key.replace("_", " ")
    return words[:1].upper() + words[1:]
