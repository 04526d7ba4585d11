"""Instruments and motions that tell less: signals that are missing, rest, jitter, filters, few points, a held shaft."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from tests.recovery.field.draws import Draw, Run, held_steps, moves_and_holds
from tests.recovery.field.dressed import Dressed, table
from tests.recovery.generator import Plan
from tests.recovery.generator.native import F64
from tests.recovery.generator.sensors import filtered_speed, speed_over_window

_NAMES = {"voltage_V": "v", "current_A": "i", "position_rad": "x", "velocity_rad_s": "w"}


def written(r: Run, *names: str, **more: object) -> Dressed:
    """Columns of a run under our own names."""
    columns: dict[str, F64] = {"time_s": r.t, **{name: getattr(r, _NAMES[name]) for name in names}}
    return Dressed(r.motor.name, "capture.csv", table(columns, digits={"time_s": ".9f"}).encode(), r.truth, **more)  # type: ignore[arg-type]


def _without_current(d: Draw) -> Dressed:
    return written(d.run(), "voltage_V", "position_rad")


def _voltage_and_speed(d: Draw) -> Dressed:
    return written(d.run(), "voltage_V", "velocity_rad_s")


def _without_voltage(d: Draw) -> Dressed:
    return written(d.run(), "current_A", "position_rad")


def _dead_current(d: Draw) -> Dressed:
    r = d.run()
    return written(replace(r, i=np.full(len(r.t), d.one((0.0, 0.12)))), "voltage_V", "current_A", "position_rad")


def _locked(d: Draw) -> Dressed:
    clamped = replace(d.motor, J=1e6, B=1e6)
    r = d.run(held_steps, motor=clamped, seconds=4.0, rate_hz=1000.0)
    truth = {name: value for name, value in r.truth.items() if name in {"R", "L"}}
    return replace(written(r, "voltage_V", "current_A", "position_rad", expects=("R",)), truth=truth)


def _twelve_points(d: Draw) -> Dressed:
    every = 100
    volts = 0.4 * min(d.motor.supply_V, d.motor.R * d.motor.current_limit_A)
    r = d.run(Plan("voltage", np.full(12 * every, volts)), seconds=0.6, rate_hz=2000.0).part(slice(None, None, every))
    step = 10.0 ** np.floor(np.log10(1e-2 * np.max(np.abs(r.w))))
    return written(replace(r, w=np.round(r.w / step) * step), "voltage_V", "velocity_rad_s")


def _rests(d: Draw) -> Dressed:
    r = d.run(moves_and_holds, seconds=24.0, rate_hz=200.0)
    return written(r, "voltage_V", "current_A", "position_rad")


def _jitter(d: Draw) -> Dressed:
    """Read by a program that does other things, too, every 2 to 12 ms, from a drive that holds its voltage for 10 ms;
    one sample in fifty is lost."""
    r = d.run("prbs", rate_hz=1000.0)
    steps = np.clip(np.round(d.rng.gamma(4.0, 1.0, len(r.t))), 2, 12).astype(int)
    at = np.cumsum(np.where(d.rng.random(len(steps)) < 0.02, 2 * steps, steps))
    seen = at[at < len(r.t)]
    # the mean of what was applied until the next sample, which a logger of its own commands knows
    total = np.concatenate([[0.0], np.cumsum(r.v[:-1] * np.diff(r.t))])
    mean = np.diff(total[seen]) / np.diff(r.t[seen])
    return written(replace(r.part(seen), v=np.append(mean, r.v[seen[-1]])), "voltage_V", "current_A", "position_rad")


def _slow(d: Draw) -> Dressed:
    return written(d.run(rate_hz=d.one((50.0, 100.0)), seconds=16.0), "voltage_V", "current_A", "position_rad")


def _coarse(d: Draw) -> Dressed:
    """An encoder of few lines and a converter of 8 bits."""
    counts = d.one((48.0, 100.0, 400.0))
    sensors = replace(d.sensors(), counts_per_rev=counts, current_lsb_A=2 * d.motor.current_limit_A / 2**8)
    return written(d.run("multisine", sensors=sensors), "voltage_V", "current_A", "position_rad")


def _filtered_speed(d: Draw) -> Dressed:
    r = d.run(rate_hz=500.0)
    clean = filtered_speed(r.t, r.w, float(d.rng.uniform(0.003, 0.03)))
    return written(replace(r, w=clean), "voltage_V", "current_A", "velocity_rad_s", hidden=("speed_filter",))


def _window_speed(d: Draw) -> Dressed:
    r = d.run(rate_hz=500.0)
    window = float(d.rng.uniform(0.006, 0.04))
    moved = speed_over_window(r.t, r.x, window)
    return written(replace(r, w=moved), "voltage_V", "velocity_rad_s", hidden=("speed_filter", "measurement_delay"))


DRESSINGS: Mapping[str, Callable[[Draw], Dressed]] = {
    "no current": _without_current,
    "voltage and speed": _voltage_and_speed,
    "no voltage": _without_voltage,
    "a current that never changes": _dead_current,
    "held shaft": _locked,
    "step of 12 points": _twelve_points,
    "moves and holds": _rests,
    "jitter, lost samples": _jitter,
    "50 or 100 Hz": _slow,
    "few counts, 8 bits": _coarse,
    "filtered speed": _filtered_speed,
    "no current, speed over a window": _window_speed,
}
