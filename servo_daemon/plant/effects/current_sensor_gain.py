"""Gain of the current sensor: it shows a multiple of the current."""

from __future__ import annotations

from collections.abc import Iterator

from servo_daemon.parameters import Parameter
from servo_daemon.plant.columns.regressors import NO_COLUMNS
from servo_daemon.plant.columns.screening import Basis, Context, Trace
from servo_daemon.plant.effects.base import Effect, Signals, Terms
from servo_daemon.samples import F64

G_I = Parameter("g_i", "g_i", "1", 1.0, 0.05, 20.0, "log", "shown current over true current", "start value")

#: R/g_i, L/g_i and every torque times g_i are all that voltage, current and motion hold.
_SCALED = (
    *("R", "L", "J", "B", "B_neg", "Tc", "Tc_neg", "Ts", "c2", "TL", "dTL"),
    *("Tg", "Tper", "Tcog", "Tcog_2", "Tcog_3", "Tcog_4"),
)

#: No current sensor is further off.
_MOST_GAIN = 0.6


def _terms(s: Signals) -> Terms:
    return Terms(sensed={"current_A": (s.p["g_i"] - 1) * s.i})


def _screening(c: Context) -> Iterator[Basis]:
    current = c.motion.at_sample["current_A"]
    trace = Trace(shown={"current_A": current}) if "L" in c.motion.p else Trace(torque=c.motion.p["K"] * current)

    def start(b: F64) -> dict[str, float] | None:
        # With J and B free a gain of 2 explains any torque, by an inertia and a friction of nothing.
        return {"g_i": 1 + b[0]} if abs(b[0]) < _MOST_GAIN else None

    yield Basis((c.add("g_i", trace),), start, 1)


EFFECT = Effect(
    name="current_sensor_gain",
    cause="The shunt or its amplifier has another gain than assumed; a torque constant that differs from the back-EMF "
    "constant (K_t ≠ K_e) leaves the same trace.",
    equation=r"i_{\mathrm{shown}} = g_i\,i",
    parameters=(G_I,),
    terms=_terms,
    screening=_screening,
    regressors=NO_COLUMNS,
    hides={G_I.name: _SCALED},
    ladder=140,
    told_from={
        "magnetic_saturation": "measure the back-EMF: turn it by hand with the drive off, and hold that K against "
        "the torque's.",
    },
)
