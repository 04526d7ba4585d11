"""Brush voltage drop: a voltage that opposes the current, whatever its size."""

from __future__ import annotations

from servo_daemon.parameters import Parameter, Scale
from servo_daemon.plant.columns.regressors import Regressors, itself
from servo_daemon.plant.effects.base import Effect, Signals, Terms

VB = Parameter(
    "Vb",
    "V_b",
    "V",
    0.5,
    1e-06,
    1000.0,
    "log",
    "voltage lost against the direction of the current",
    "start value",
    scale=Scale(0.03, voltage=1),
)


def _terms(s: Signals) -> Terms:
    return Terms(dry_drop=s.p["Vb"])


EFFECT = Effect(
    name="brush_voltage_drop",
    cause="The contact of carbon brushes takes about a constant voltage against the current's direction; an inverter's "
    "dead time leaves the same trace.",
    equation=r"V_b\operatorname{sgn} i",
    parameters=(VB,),
    terms=_terms,
    regressors=Regressors(armature=(itself(VB),)),
    ladder=170,
    told_from={
        "resistance_step": "hold several currents for a second each: a brush drop is the same at all of them, R i is "
        "not.",
    },
    # The current may reverse within a sample, and not wait at zero for its end: in one part L was 34 % off at 12 σ
    # (slow reversals of the gear motor at 1 kHz), in two R at 3.4 σ, in four nothing at more than 0.6 σ.
    substeps=4,
)
