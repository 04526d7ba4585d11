"""Freewheeling drive: at a command of zero the bridge is open, and the motor coasts."""

from __future__ import annotations

import casadi as ca

from servo_daemon.plant.columns.regressors import NO_COLUMNS
from servo_daemon.plant.effects.base import Effect, Signals, Terms

#: V: more than any back-EMF that the bridge's diodes hold back (they conduct against the supply; what is left of the
#: current is gone within L i / supply, 0.2 ms for 1 mH, 2 A and 12 V).
_SUPPLY = 1000.0


def _terms(s: Signals) -> Terms:
    return Terms(dry_drop=ca.if_else(s.v == 0.0, _SUPPLY, 0.0))


EFFECT = Effect(
    name="freewheel_drive",
    cause="The bridge is open where the command is zero, as most hobby PWM drives have it: its diodes stop the current "
    "at once and the motor coasts instead of braking (a command of exactly 0 must mean that in the capture).",
    equation=r"i = 0 \quad (v_{\mathrm{command}} = 0)",
    parameters=(),
    terms=_terms,
    # Missing is a voltage as large as the back-EMF, in stretches of no command alone: a search proposes it by these.
    screening=lambda _: (),
    regressors=NO_COLUMNS,
    ladder=210,
    exact_zero=True,
    told_from={
        "coulomb_friction": "command zero at speed: an open bridge lets the motor coast, a closed one brakes it with "
        "its own back-EMF."
    },
    # The current ends early in the step, see `brush_voltage_drop`.
    substeps=4,
)
