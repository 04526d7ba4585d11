"""Every kind of dressing, by name: a function of a draw. Nothing here knows the program."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping

import numpy as np

from tests.recovery.field import hidden, readings
from tests.recovery.field.draws import Draw, Run
from tests.recovery.field.dressed import Dressed, Mend, table
from tests.recovery.generator.native import F64

_TURN = 2 * np.pi
_MICROS = 2.0**32
_RKJB = ("R", "K", "J", "B")

# -- the same numbers in other files -----------------------------------------------------------------------------------


def _semicolons(d: Draw) -> Dressed:
    r = d.run()
    columns = {"Zeit": 1e3 * r.t, "Spannung": r.v, "Strom": 1e3 * r.i, "Winkel": np.degrees(r.x)}
    above = ("Messung 14;Prüfstand 2", "Datum;26.11.2026", "")
    text = table(columns, separator=";", decimal=",", above=above, units=("ms", "V", "mA", "°"))
    return Dressed(r.motor.name, "messung.csv", text.encode("cp1252"), r.truth, expects=_RKJB)


def _tabs(d: Draw) -> Dressed:
    r = d.run()
    columns = {"Time [s]": r.t, "U [mV]": 1e3 * r.v, "I [mA]": 1e3 * r.i, "position_deg": np.degrees(r.x)}
    text = table(columns, separator="\t", tail="\t", end="\r\n")
    return Dressed(r.motor.name, "scope.txt", text.encode("utf-16"), r.truth, expects=_RKJB)


def _no_header(d: Draw) -> Dressed:
    r = d.run()
    text = table({"t": 1e3 * r.t, "v": r.v, "i": r.i, "x": r.counts}, header=False)
    turn = ("--counts-per-rev", f"{r.counts_per_rev:g}")
    mend = Mend(r"--columns", ("--columns", "time_ms,voltage_V,current_A,counts", *turn))
    return Dressed(r.motor.name, "putty.log", text.encode(), r.truth, mend=mend)


def _serial_log(d: Draw) -> Dressed:
    r = d.run("multisine", rate_hz=200.0)
    clock = [f"{10 + int(t // 60):02d}:{int(t // 60) % 60:02d}:{t % 60:06.3f} -> " for t in r.t]
    columns = {"t_us": 1e6 * r.t, "U_V": r.v, "I_A": r.i, "enc": r.counts}
    boot = ("ets Jun  8 2016 00:22:57", "rst:0x1 (POWERON_RESET),boot:0x13", "motor test v2 ready")
    lines = table(columns, digits={"t_us": ".0f", "enc": ".0f"}, before=clock, above=boot).splitlines()
    lines[len(boot)] = clock[0] + lines[len(boot)]
    words = ("--counts-per-rev", f"{r.counts_per_rev:g}")
    return Dressed(r.motor.name, "monitor.log", "\n".join(lines).encode(), r.truth, words, expects=_RKJB)


def _json_lines(d: Draw) -> Dressed:
    r = d.run()
    rows = zip(r.t.tolist(), r.v.tolist(), r.i.tolist(), r.x.tolist(), strict=True)
    lines = (json.dumps({"ts": t, "motor": {"voltage_V": v, "current_A": i, "theta": x}}) for t, v, i, x in rows)
    return Dressed(r.motor.name, "log.jsonl", "\n".join(lines).encode(), r.truth, expects=_RKJB)


def _no_time(d: Draw) -> Dressed:
    rate = d.one((250.0, 500.0, 1000.0))
    r = d.run(rate_hz=rate)
    text = table({"voltage_V": r.v, "current_A": r.i, "position_rad": r.x})
    return Dressed(r.motor.name, "daq.csv", text.encode(), r.truth, mend=Mend(r"--rate", ("--rate", f"{rate:g}")))


def _whole_milliseconds(d: Draw) -> Dressed:
    r = d.run(rate_hz=d.one((100.0, 200.0)))
    columns = {"millis": np.floor(1e3 * r.t), "voltage_V": r.v, "current_A": r.i, "position_rad": r.x}
    return Dressed(r.motor.name, "arduino.csv", table(columns).encode(), r.truth)


def _micros_wrap(d: Draw) -> Dressed:
    r = d.run()
    begin = _MICROS - 1e6 * float(d.rng.uniform(1.0, 7.0))
    columns = {"t_us": np.mod(np.round(1e6 * r.t + begin), _MICROS), "voltage_V": r.v, "current_A": r.i}
    columns |= {"speed_rpm": r.w * 60 / _TURN}
    return Dressed(r.motor.name, "micros.csv", table(columns, digits={"t_us": ".0f"}).encode(), r.truth, expects=_RKJB)


def _duty_and_counts(d: Draw) -> Dressed:
    r = d.run(d.rng.choice(["multisine", "prbs"]))
    pwm = np.round(255 * r.v / r.motor.supply_V)
    columns = {"t_ms": 1e3 * r.t, "pwm": pwm, "mA": np.round(1e3 * r.i), "ticks": r.counts}
    words = ("--supply", f"{r.motor.supply_V:g}/255", "--counts-per-rev", f"{r.counts_per_rev:g}")
    return Dressed(r.motor.name, "hobby.csv", table(columns).encode(), r.truth, words, expects=("R", "K"))


# -- columns that do not mean what their names say ---------------------------------------------------------------------


def _misnamed(change: Callable[[Draw, Run], Mapping[str, F64]], says: str, **told: object) -> Callable[[Draw], Dressed]:
    """A dressing whose columns `change` gives."""

    def dressed(d: Draw) -> Dressed:
        # an angle within a turn moves by less than a fifth of one between two samples
        rates = [rate for rate in (200.0, 500.0, 1000.0) if rate > 0.8 * d.motor.speed_max_rad_s]
        r = d.run("multisine", rate_hz=d.one(rates or (2000.0,)))
        columns = {"time_s": r.t, "voltage_V": r.v, "current_A": r.i, "position_rad": r.x} | change(d, r)
        more = {key: value(r) if callable(value) else value for key, value in told.items()}
        left_out = bool(more.pop("left_out", False))
        columns = {name: values for name, values in columns.items() if values is not None}
        text = table(columns, digits={"time_s": ".9f"})
        return Dressed(r.motor.name, "named.csv", text.encode(), r.truth, mend=Mend(says, **more), told_only=left_out)

    return dressed


_MISNAMED: Mapping[str, Callable[[Draw], Dressed]] = {
    "counts called rad": _misnamed(
        lambda d, r: {"position_rad": r.counts},
        r"counts of an encoder",
        put=lambda r: {"counts_per_rev": f"{r.counts_per_rev:g}"},
    ),
    "mA called A": _misnamed(lambda d, r: {"current_A": np.round(1e3 * r.i)}, r"milliamperes"),
    "rpm called rad/s": _misnamed(
        lambda d, r: {"velocity_rad_s": np.round(r.w * 60 / _TURN), "position_rad": None}, r"rpm"
    ),
    "degrees called rad, beside a speed": _misnamed(
        lambda d, r: {"position_rad": np.degrees(r.x), "velocity_rad_s": r.w}, r"degrees"
    ),
    "a PWM code called V": _misnamed(
        lambda d, r: {"voltage_V": np.round(1000 * r.v / np.max(np.abs(r.v)))},
        r"a PWM code",
        put=lambda r: {"scale": f"{np.max(np.abs(r.v)) / 1000:.10g}"},
    ),
    "ms called s": _misnamed(lambda d, r: {"time_s": 1e3 * r.t}, r"milliseconds"),
    "a full 16-bit counter": _misnamed(
        lambda d, r: {"position_rad": np.mod(r.counts - (np.min(r.counts) + np.max(r.counts)) // 2, 65_536)},
        r"wrap = 65536",
        put=lambda r: {"counts_per_rev": f"{r.counts_per_rev:g}"},
    ),
    "an angle within a turn": _misnamed(lambda d, r: {"position_rad": np.mod(r.x, _TURN)}, r"wrap = 6\.28"),
    "|i|": _misnamed(lambda d, r: {"current_A": np.abs(r.i)}, r"\|i\|", left_out=True),
    "the supply's current": _misnamed(
        lambda d, r: {"current_A": r.i * r.v / r.motor.supply_V},
        r"supply",
        left_out=True,
        put=lambda r: {"supply_V": f"{r.motor.supply_V:g}"},
    ),
    "a current turned round": _misnamed(lambda d, r: {"current_A": -r.i}, r"counts against|sign (is )?turned"),
    "an encoder turned round": _misnamed(lambda d, r: {"position_rad": -r.x}, r"counts against|sign (is )?turned"),
}


def _millis_called_micros(d: Draw) -> Dressed:
    r = d.run("multisine", rate_hz=200.0)
    columns = {"t_us": 1e3 * r.t, "voltage_V": r.v, "current_A": r.i, "position_rad": r.x}
    return Dressed(r.motor.name, "log.csv", table(columns).encode(), r.truth, mend=Mend(r"milliseconds"))


def _modulus_under_other_names(d: Draw) -> Dressed:
    """Names and units of the file's own in the map that is offered."""
    r = d.run("multisine")
    columns = {"t_ms": 1e3 * r.t, "U_mV": 1e3 * r.v, "I_mA": np.abs(1e3 * r.i), "enc": np.mod(r.counts, 65_536)}
    words = ("--counts-per-rev", f"{r.counts_per_rev:g}")
    text = table(columns, separator=";")
    return Dressed(r.motor.name, "log.csv", text.encode(), r.truth, words, mend=Mend(r"\|i\|"), told_only=True)


# -- all ---------------------------------------------------------------------------------------------------------------

#: Group -> kind -> what makes it.
DRESSINGS: Mapping[str, Mapping[str, Callable[[Draw], Dressed]]] = {
    "files": {
        "semicolons, decimal commas, preamble, units row": _semicolons,
        "tabs, UTF-16, mV, mA, degrees": _tabs,
        "no header": _no_header,
        "serial monitor": _serial_log,
        "JSON lines": _json_lines,
        "no time": _no_time,
        "whole milliseconds": _whole_milliseconds,
        "micros() starts again, rpm": _micros_wrap,
        "PWM, mA and ticks": _duty_and_counts,
    },
    "meaning": {
        **_MISNAMED,
        "millis() called microseconds": _millis_called_micros,
        "|i|, own names and units": _modulus_under_other_names,
    },
    "readings": readings.DRESSINGS,
    "hidden": hidden.DRESSINGS,
}
#: Kind -> group.
GROUP = {kind: group for group, kinds in DRESSINGS.items() for kind in kinds}


def dress(kind: str, seed: int) -> Dressed:
    """One file of a kind. The same seed is the same file."""
    return DRESSINGS[GROUP[kind]][kind](Draw(seed))
