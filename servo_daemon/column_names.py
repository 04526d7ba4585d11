"""What a column is by the name people give it: quantity and unit ("t_us", "i_q_A", "Spannung [mV]", "enc").

One table for captures and for the text wire. A name whose unit nobody can know ("speed" may be in rpm or rad/s) has a
meaning that is not certain: it is asked about, never applied.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace

TURN = 2.0 * math.pi
RPM = TURN / 60.0

_CALLED_COUNTS = ("count", "counts", "cnt", "cnts", "tick", "ticks", "pulses")
#: Unit as it is spelt (lower case, no blanks) -> quantity and factor to SI. "%" is of a duty cycle.
UNITS: dict[str, tuple[str, float]] = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds", "sek"), ("time", 1.0)),
    **dict.fromkeys(("ms", "msec", "millis", "milliseconds"), ("time", 1e-3)),
    **dict.fromkeys(("us", "µs", "μs", "usec", "micros", "microseconds"), ("time", 1e-6)),
    **dict.fromkeys(("ns", "nsec"), ("time", 1e-9)),
    **dict.fromkeys(("v", "volt", "volts"), ("voltage", 1.0)),
    **dict.fromkeys(("mv", "millivolt", "millivolts"), ("voltage", 1e-3)),
    **dict.fromkeys(("a", "amp", "amps", "ampere", "amperes"), ("current", 1.0)),
    **dict.fromkeys(("ma", "milliamp", "milliamps"), ("current", 1e-3)),
    **dict.fromkeys(("ua", "µa", "μa"), ("current", 1e-6)),
    **dict.fromkeys(("rad", "radian", "radians"), ("angle", 1.0)),
    "mrad": ("angle", 1e-3),
    **dict.fromkeys(("deg", "degs", "degree", "degrees", "°", "grad"), ("angle", math.pi / 180)),
    **dict.fromkeys(("rev", "revs", "turn", "turns", "revolutions", "umdr"), ("angle", TURN)),
    **dict.fromkeys(("rad/s", "rads", "rad/sec", "radps", "s^-1", "1/s"), ("speed", 1.0)),
    **dict.fromkeys(("deg/s", "°/s", "dps", "degps", "deg/sec"), ("speed", math.pi / 180)),
    **dict.fromkeys(("rpm", "1/min", "min-1", "min^-1", "u/min", "rev/min", "r/min", "revs/min"), ("speed", RPM)),
    "krpm": ("speed", 1e3 * RPM),
    **dict.fromkeys(("rps", "rev/s", "revs/s", "turn/s", "turns/s", "u/s"), ("speed", TURN)),
    "erpm": ("erpm", RPM),
    **dict.fromkeys(("hz", "hertz"), ("frequency", TURN)),
    **dict.fromkeys(("cps", "qpps", *(f"{c}/{s}" for c in _CALLED_COUNTS for s in ("s", "sec"))), ("count rate", 1.0)),
    **dict.fromkeys(
        (f"{c}/{s}" for c in _CALLED_COUNTS for s in ("sample", "loop", "period", "cycle", "interval")),
        ("increments", 1.0),
    ),
    **dict.fromkeys((*_CALLED_COUNTS, "inc", "lsb", "cts"), ("counts", 1.0)),
    **dict.fromkeys(("nm", "n·m", "n*m", "newtonmeter"), ("torque", 1.0)),
    **dict.fromkeys(("mnm", "mn·m"), ("torque", 1e-3)),
    **dict.fromkeys(("ncm", "n·cm"), ("torque", 1e-2)),
    "n": ("force", 1.0),
    "m": ("length", 1.0),
    "cm": ("length", 1e-2),
    "mm": ("length", 1e-3),
    "um": ("length", 1e-6),
    **dict.fromkeys(("m/s", "mps"), ("linear speed", 1.0)),
    **dict.fromkeys(("mm/s", "mmps"), ("linear speed", 1e-3)),
    **dict.fromkeys(("c", "°c", "degc", "celsius"), ("temperature", 1.0)),
    **dict.fromkeys(("%", "percent", "pct"), ("duty", 1e-2)),
}

#: Quantity -> column of a capture. A duty cycle, a supply voltage, an electrical speed, a frequency, counts since the
#: last sample and counts a second need something beside.
COLUMNS: dict[str, str] = {
    "time": "time_s",
    "voltage": "voltage_V",
    "current": "current_A",
    "angle": "position_rad",
    "counts": "position_counts",
    "speed": "velocity_rad_s",
    "torque": "torque_Nm",
    "temperature": "temperature_C",
    "length": "position_m",
    "linear speed": "velocity_m_s",
    "force": "force_N",
    "duty": "duty",
    "supply": "supply",
    "erpm": "erpm",
    "frequency": "frequency",
    "increments": "increments",
    "turned": "turned",
    "count rate": "count_rate",
}


def _set(words: str) -> frozenset[str]:
    return frozenset(words.split())


#: What is wanted of the motor is no measurement of it, nor are the d axis, an error, a limit, or the supply's current.
_NOT_MEASURED = _set(
    "target ref reference set setpoint sp cmd command commanded desired demand soll goal des err "
    "error max min limit d id ud vd std var average gnss acc gyro roll pitch yaw kp ki kd dt delta "
    "period loop sample samples frame index idx seq packet"
)
_SUPPLY = _set("supply bus vbus ubus vcc vdd battery batt vbat input dc dclink psu versorgung ibus isupply")

_COUNTS = _set("counts count cnt ticks tick pulses pulse enc encoder quad qei inkremente")

#: Quantity -> words of a name that mean it, the first that fits; whether its SI unit may be taken for granted.
_WORDS: tuple[tuple[str, bool, frozenset[str]], ...] = (
    ("time", True, _set("t time timestamp timestamps zeit temps tiempo tout clock elapsed uptime ts")),
    ("duty", True, _set("duty pwm dutycycle")),
    (
        "voltage",
        True,
        _set("v u voltage voltages volt volts spannung tension uq vq va ua vm vmot vmotor uarm varm umot umotor"),
    ),
    ("voltage", False, _set("vin uin")),
    (
        "current",
        True,
        _set("i current currents strom courant curr amp amps ampere iq im ia iarm imot imotor"),
    ),
    ("torque", True, _set("torque tau drehmoment moment couple tq")),
    ("torque", False, _set("effort")),  # ROS: N·m by its convention, of servos often a current
    ("force", True, _set("force kraft")),
    ("temperature", False, _set("temp temperature temperatur")),
    ("speed", True, _set("omega w wm ω thetadot dtheta qdot dq")),
    ("speed", False, _set("speed vel velocity drehzahl geschwindigkeit vitesse tach tacho tachometer")),
    ("counts", True, _COUNTS),
    ("frequency", True, _set("freq frequency frequenz frequence fréquence")),
    ("angle", True, _set("theta phi θ φ q")),
    ("angle", False, _set("angle pos position winkel angolo")),
)
#: Of an angle: since the sample before.
_SINCE = _set("delta diff difference increment d Δ δ")
#: German compounds: "Ankerspannung", "Motorstrom".
_ENDS = (
    ("spannung", "voltage"),
    ("strom", "current"),
    ("drehzahl", "speed"),
    ("winkel", "angle"),
    ("moment", "torque"),
)

#: Names that mean one thing by the program that writes them: quantity, factor.
_WHOLE: dict[str, tuple[str, float]] = {
    "ms_today": ("time", 1e-3),  # VESC Tool
    "x_value": ("time", 1.0),  # LabVIEW
    "drehzahl": ("speed", RPM),  # in German always 1/min
    "pos_estimate": ("angle", TURN),  # ODrive counts turns since its firmware 0.5
    "vel_estimate": ("speed", TURN),
    "pos_estimate_counts": ("counts", 1.0),
}

#: Quantity of the words, and whether they are sure of it -> quantities of units that make it another one.
_FITS: dict[tuple[str, bool], frozenset[str]] = {
    ("counts", True): frozenset({"angle", "length", "speed", "time", "count rate", "increments"}),  # "enc_deg"
    ("speed", False): frozenset({"linear speed", "erpm", "frequency", "count rate"}),
    ("angle", False): frozenset({"counts", "length", "increments"}),  # "position_mm"
    ("torque", False): frozenset({"current"}),
}
#: A unit at the end of a name: "U [V]", "U (V)", "t/ms", "Zeit in s".
_TAIL = re.compile(r"(?:[\[({]\s*([^\[\](){}]*?)\s*[\])}]|(?<=[^\W\d_])\s*/\s*([^/]+)|\s+in\s+(\S+))\s*$")
#: What says nothing: of a signal that depends on time, "u(t)", "millis()"; a unit of what has none.
_ARGUMENT = re.compile(r"\(\s*[tk]?\s*\)\s*$")
_NO_UNIT = ("-", "–", "1", "none")
_CAMEL = re.compile(r"(?<=[a-z])(?=[A-Z])")


@dataclass(frozen=True, slots=True)
class Meaning:
    """What a name means.

    Attributes:
        column: of a capture, or "duty" (share of the supply voltage), "supply" (V), "erpm" (electrical speed).
        scale: factor to that column's unit.
        certain: the unit is told, or nobody uses another; else the meaning is a guess that is only ever shown.
        told: the unit stands in the name.
    """

    column: str
    scale: float = 1.0
    certain: bool = True
    told: bool = True


def unit_of(text: str) -> tuple[str, float] | None:
    """Quantity and factor to SI of a unit as people spell it; None: not a unit that a capture has."""
    return UNITS.get(re.sub(r"\s|^[\[({]|[\])}]$", "", text.strip()).lower().replace("_", "/"))


def meaning(name: str, unit: str = "") -> Meaning | None:
    """What a column is by its name, and by the unit that stands beside it where there is one; None: nothing known."""
    base = _ARGUMENT.sub("", name.strip().strip("\"'"))
    unit = "" if unit.strip(" []()").lower() in _NO_UNIT else unit
    if unit_of(base) is None:
        base, unit = _without_unit(base, unit)
    base = re.split(r"[.:\\]", base)[-1].strip() or base
    if (whole := _WHOLE.get(base.lower())) and not unit:
        return _made(*whole)
    tokens = _tokens(base)
    lower = [t.lower() for t in tokens]
    if "per" in lower[1:]:  # "counts_per_s"
        at = lower.index("per", 1)
        known = unit_of(f"{lower[at - 1]}/{'/'.join(lower[at + 1 :])}")
        return None if known is None else _with_unit(tokens[: at - 1], *known)
    if (step := _since_before(tokens, unit)) is not None:
        return step
    if not tokens or _NOT_MEASURED.intersection(lower):
        return None
    if unit:
        known = unit_of(unit)
        return None if known is None else _with_unit(tokens, *known)
    return _named_by_unit(base, tokens) or _named_by_words(tokens)


def not_measured(name: str) -> bool:
    """Whether a name says that the signal is wanted or limited, or counts something else: no measurement."""
    return bool(_NOT_MEASURED.intersection(t.lower() for t in _tokens(name)))


def _since_before(tokens: list[str], unit: str) -> Meaning | None:
    """What a name means that is a difference from the sample before: "delta_counts", "dEnc", "delta_pos [deg]"."""
    apart = [p for t in tokens for p in (("d", t[1:]) if t[:1] in "dδΔ" and t[1:].lower() in _COUNTS else (t,))]
    rest = [t for t in apart if t.lower() not in _SINCE]
    found = meaning("_".join(rest), unit) if rest and len(rest) < len(apart) else None
    if found is None or (not found.told and found.column != COLUMNS["counts"]):
        return None
    quantity = {COLUMNS["counts"]: "increments", COLUMNS["angle"]: "turned"}.get(found.column)
    return _made(quantity, found.scale) if quantity else None


def _named_by_unit(base: str, tokens: list[str]) -> Meaning | None:
    """What a name means that is a unit, or has one at its end; a speed's may be at its beginning: "rpm_filtered"."""
    if (known := unit_of(base)) is not None and (len(base) > 1 or base in "VA"):
        return _made(*known)
    for count in range(min(3, len(tokens) - 1), 0, -1):
        known = unit_of("/".join(tokens[-count:]))
        found = None if known is None else _with_unit(tokens[:-count], *known)
        if found is not None:
            return found
    first = unit_of(tokens[0])
    return _made(*first) if first is not None and first[0] == "speed" else None


def _named_by_words(tokens: list[str]) -> Meaning | None:
    quantity, certain = _quantity(tokens)
    return replace(_made(quantity, 1.0), certain=certain, told=False) if quantity else None


def _made(quantity: str, scale: float) -> Meaning:
    return Meaning(COLUMNS[quantity], scale)


def _without_unit(name: str, unit: str) -> tuple[str, str]:
    """The name without a unit at its end, and the unit: what stands beside the name comes first."""
    match = _TAIL.search(name)
    if match is None:
        return name, unit
    inside, before = next(group for group in match.groups() if group is not None), name[: match.start()].strip()
    if unit_of(inside) is None and not unit:
        return name, ""
    if match[2] is not None and unit_of(f"{_tokens(before)[-1]}/{inside}") is not None:  # "vel_rad/s"
        return name, unit
    return before, unit or inside


def _tokens(base: str) -> list[str]:
    """The words of a name: "motorSpeed_rpm" -> motor, Speed, rpm."""
    words = [w for w in re.split(r"[^\w°%µμ]+|_", base) if w]
    return [part for w in words for part in ([w] if w.lower() in UNITS else _CAMEL.split(w))]


def _with_unit(words: list[str], unit_quantity: str, scale: float) -> Meaning | None:
    """The meaning of words whose unit is known; None: they mean something that has another unit."""
    quantity, certain = _quantity(words)
    if quantity == "supply":
        return _made("supply", scale) if unit_quantity == "voltage" else None
    if quantity == "duty":
        return _made(unit_quantity, scale) if unit_quantity in ("duty", "voltage") else None
    if not quantity and unit_quantity == "time":  # how long something took
        return None
    if not quantity or unit_quantity == quantity or unit_quantity in _FITS.get((quantity, certain), ()):
        return _made(unit_quantity, scale)
    # "q_A", "q_V": a q axis, no joint angle.
    return _made(unit_quantity, scale) if [w.lower() for w in words] == ["q"] else None


def _quantity(words: list[str]) -> tuple[str, bool]:
    """What words mean, and whether its SI unit may be taken for granted; empty: nothing."""
    lower = [w.lower() for w in words]
    if _SUPPLY.intersection(lower):
        current = any(w in ("current", "i", "strom", "a", "ibus", "isupply", "power") for w in lower)
        return ("", False) if current else ("supply", True)
    if "in" in lower and "current" in lower:  # of VESC: what the supply gives
        return "", False
    if {"encoder", "enc"}.intersection(lower) and {"position", "pos", "angle", "speed", "vel"}.intersection(lower):
        lower = [w for w in lower if w not in ("encoder", "enc")]
    for quantity, certain, known in _WORDS:
        if known.intersection(lower):
            return "speed" if quantity == "angle" and "dot" in lower else quantity, certain
    for word in lower:
        for end, quantity in _ENDS:
            if word.endswith(end):
                return quantity, quantity in ("voltage", "current")
    return "", False
