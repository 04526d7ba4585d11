"""What `tune` shows: the table, and the files of `--out`."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from servo_daemon.errors import BadInputError
from servo_daemon.files import AtomicFile
from servo_daemon.tuning.advice import Advice
from servo_daemon.tuning.assess import smaller_gain_margin_dB
from servo_daemon.tuning.document import config_keys
from servo_daemon.tuning.knowledge import NEEDED, UNITS, CascadeGains
from servo_daemon.tuning.laws import Gains, controller
from servo_daemon.tuning.margins import Margins, grid, return_ratio
from servo_daemon.tuning.report import Tuning
from servo_daemon.tuning.response import Response, duration_s, step
from servo_daemon.tuning.sampled import sampled_motor


def text(tuning: Tuning) -> str:
    """Everything, for a person."""
    setup = tuning.setup
    lines = ["motor"]
    for name in NEEDED:
        p = tuning.motor.parameters[name]
        if name in tuning.motor.open:
            continue
        std = "" if p.std is None else f" ± {p.std:.2g}"
        why = "" if p.why is None else f" ({p.why})"
        lines.append(f"  {name} = {p.value:.5g}{std} {UNITS[name]}  {p.source}{why}")
    lines += [f"  {c.expression} = {c.value:.5g} ± {c.std:.2g} {c.unit}" for c in tuning.motor.answer]
    if tuning.motor.answer:
        lines.append(
            "  R, L, K, J, B are not all known by themselves: these gains rest on how the speed answers the voltage, "
            "which is all that loops without a current see (for the LQR give --fix R=…,K=…)"
        )
    voltage = "" if setup.voltage_V is None else f", ±{setup.voltage_V:g} V"
    delay = f"voltage {setup.delay_samples:g} samples after the encoder"
    lines.append(f"loop: {setup.rate_hz:g} Hz ({setup.rate_source}), {delay}{voltage}")
    worst = "not claimed (a capture or --tolerance is needed)" if tuning.region is None else tuning.region
    lines.append(f"worst case: {worst}")
    if tuning.region is not None and tuning.not_covered:
        lines.append(f"  not in it: {', '.join(tuning.not_covered)}")
    for d, advice in tuning.designs:
        worst_margins = None if d.worst is None else d.worst.margins
        lines += _loop(d.family.title, d.gains, d.response, [("margins", d.margins), ("worst case", worst_margins)])
        lines += _notes(advice, [] if d.reason is None else [f"capped: {d.reason}"])
    if (u := tuning.in_use) is not None:
        worst_margins = None if u.worst is None else u.worst.margins
        shown = [("margins", u.margins), ("nominally", u.nominal), ("worst case", worst_margins)]
        lines += _loop("Gains in use ([drive.controller])", u.gains, u.response, shown)
        lines += _notes(u.advice, [f"WARNING: {w.text}" for w in u.weak])
    return "\n".join(lines)


def _loop(title: str, gains: Gains, answer: Response | None, shown: Iterable[tuple[str, Margins | None]]) -> list[str]:
    lines = ["", f"{title}: {'unstable' if answer is None else _answer(answer)}"]
    lines += [f"  {name} = {_number(value)}" for name, value in _named(gains).items()]
    return lines + [f"  {name + ':':<12}{_margins(m)}" for name, m in shown if m is not None]


def _named(gains: Gains) -> Mapping[str, float | Sequence[float] | None]:
    if isinstance(gains, CascadeGains):
        return config_keys(gains)
    names = ("angle_V_rad", "speed_V_s_rad", "current_V_A", "integral_V_rad_s", "previous_V_V", "setpoint_weight")
    return {**{name: getattr(gains, name) for name in names}, "speed_filter_hz": gains.filter_hz}


def _number(value: float | Sequence[float] | None) -> str:
    if value is None:
        return "none"
    return f"{value:.5g}" if isinstance(value, int | float) else ", ".join(f"{v:.5g}" for v in value)


def _answer(r: Response) -> str:
    parts = []
    if r.bandwidth_hz is not None:
        parts.append(f"bandwidth {r.bandwidth_hz:.3g} Hz")
    if r.settling_s is not None:
        parts.append(f"settles in {r.settling_s:.3g} s")
    if r.overshoot_percent is not None:
        parts.append(f"overshoot {r.overshoot_percent:.2g} %")
    return ", ".join(parts)


def _margins(m: Margins) -> str:
    if not m.stable:
        return "unstable"
    values = (
        ("gain", smaller_gain_margin_dB(m), 1.0, " dB"),
        ("phase", m.phase_margin_deg, 1.0, "°"),
        ("delay", m.delay_margin_s, 1e3, " ms"),
        ("M_s", m.sensitivity_peak, 1.0, ""),
    )
    return ", ".join(f"{name} {'∞' if v is None else format(v * k, '.3g')}{unit}" for name, v, k, unit in values)


def _notes(advice: Advice, first: list[str]) -> list[str]:
    return [f"  {line}" for line in (*first, *advice.notes)]


def write(folder: Path, tuning: Tuning, report: Mapping[str, Any]) -> None:
    """The files of `--out`.

    Raises:
        BadInputError: the folder cannot be made or written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInputError(f"--out {folder}: {error.strerror or error}") from error
    _put(folder / "tuning.json", json.dumps(report, ensure_ascii=False, allow_nan=False, indent=2) + "\n")
    _put(folder / "controller.toml", _toml(tuning))
    loops = {d.family.key: d.gains for d, _ in tuning.designs}
    stable = dict(loops)
    if tuning.in_use is not None:
        loops["in_use"] = tuning.in_use.gains
        if tuning.in_use.margins.stable:
            stable["in_use"] = tuning.in_use.gains
    _put(folder / "bode.csv", _bode(tuning, loops))
    for key, gains in stable.items():
        _put(folder / f"step_{key}.csv", _step(tuning, gains))


def _put(path: Path, content: str) -> None:
    with AtomicFile(path) as file:
        file.write(content.encode())


def _toml(tuning: Tuning) -> str:
    """The position loop's gains as the configuration has them."""
    design = next(d for d, _ in tuning.designs if d.family.key == "position_pid")
    assert isinstance(design.gains, CascadeGains)
    lines = [f"# {design.family.title}: {_answer(design.response)}", f"# margins: {_margins(design.margins)}"]
    lines += ["[drive.controller]", *(f"{key} = {value:.6g}" for key, value in config_keys(design.gains).items())]
    return "\n".join([*lines, f"rate_hz = {tuning.setup.rate_hz:.6g}", ""])


def _bode(tuning: Tuning, loops: Mapping[str, Gains]) -> str:
    """Return ratio of every loop, cut at the voltage, at the estimate."""
    setup = tuning.setup
    motor = sampled_motor(tuning.motor.log_values[None, :], setup.period_s, setup.delay_samples)
    omega = grid(setup.period_s)
    columns, names = [omega / (2 * np.pi)], ["frequency_hz"]
    for key, gains in loops.items():
        ratio = return_ratio(motor, controller(gains, setup.period_s), omega)[0]
        columns += [20 * np.log10(np.abs(ratio)), np.degrees(np.unwrap(np.angle(ratio)))]
        names += [f"{key}_gain_dB", f"{key}_phase_deg"]
    return _csv(names, np.column_stack(columns))


def _step(tuning: Tuning, gains: Gains) -> str:
    """A unit step of the reference: angle (rad) or speed (rad/s), and voltage."""
    setup = tuning.setup
    motor = sampled_motor(tuning.motor.log_values[None, :], setup.period_s, setup.delay_samples)
    loop = controller(gains, setup.period_s)
    answer = step(motor, loop, duration_s(motor, loop))
    shown = "position_rad" if loop.position else "velocity_rad_s"
    return _csv(["time_s", shown, "voltage_V"], np.column_stack((answer.time_s, answer.shown, answer.voltage_V)))


def _csv(names: Sequence[str], rows: np.ndarray[Any, Any]) -> str:
    body = "\n".join(",".join(f"{v:.9g}" for v in row) for row in rows.tolist())
    return f"{','.join(names)}\n{body}\n"
