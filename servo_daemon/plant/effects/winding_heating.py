"""Winding heating: the current's loss heats the copper, whose resistance rises with its temperature."""

from __future__ import annotations

from collections.abc import Iterator

from servo_daemon.parameters import Parameter, Scale
from servo_daemon.plant.columns.regressors import NO_COLUMNS
from servo_daemon.plant.columns.screening import Basis, Context, positive, relaxed
from servo_daemon.plant.effects.base import Effect, Signals, State, Terms
from servo_daemon.samples import F64

#: Temperature coefficient of copper at 20 °C, 1/K (IEC 60028).
ALPHA_COPPER_1_K = 0.0039

R_TH = Parameter(
    "R_th",
    "R_{th}",
    "K/W",
    5.0,
    1e-4,
    1e4,
    "log",
    "thermal resistance, winding to ambient",
    "start value",
    scale=Scale(25.0, current=-2, R=-1),
)
C_TH = Parameter(
    "C_th",
    "C_{th}",
    "J/K",
    20.0,
    1e-4,
    1e6,
    "log",
    "thermal capacity of the winding",
    "start value",
    scale=Scale(1 / 75, seconds=1, current=2, R=1),
)
WARMING = State("winding_rise_K", "K", 0.0, 20.0)

#: Thermal time constants of windings in catalogues: 2 s (6 mm across) to minutes. What follows the current's square
#: faster is no heat.
_FASTEST_HEAT_S = 1.0

#: Thermal time constants that are tried, in shares of the capture.
_THERMAL = (0.05, 0.15, 0.4, 1.5)


def _terms(s: Signals) -> Terms:
    rise = s.states["winding_rise_K"]
    factor = 1 + ALPHA_COPPER_1_K * rise
    heat_W = s.p["R"] * factor * s.i_square
    return Terms(
        factor_R=factor,
        rates={"winding_rise_K": (heat_W - rise / s.p["R_th"]) / s.p["C_th"]},
    )


def _screening(c: Context) -> Iterator[Basis]:
    m = c.motion
    for share in _THERMAL:
        tau = share * float(m.t[-1] - m.t[0])

        def start(b: F64, tau: float = tau) -> dict[str, float] | None:
            return {"R_th": tau * b[0], "C_th": 1 / b[0]} if positive(b[0]) else None

        per_heat = relaxed(m.p["R"] * m.i**2 * m.h, m.h, tau)
        yield Basis((c.voltage(f"warm {tau}", m.p["R"] * ALPHA_COPPER_1_K * per_heat * m.i),), start, 2)


EFFECT = Effect(
    name="winding_heating",
    cause="The current's loss heats the winding and copper's resistance rises 0.39 % a kelvin; R is the cold value.",
    equation=r"R\,(1 + 0.0039\,\vartheta),\quad C_{th}\,\dot\vartheta = R\,i^2 - \vartheta/R_{th}",
    parameters=(R_TH, C_TH),
    terms=_terms,
    screening=_screening,
    regressors=NO_COLUMNS,
    possible=lambda value: value["R_th"] * value["C_th"] >= _FASTEST_HEAT_S,
    ladder=200,
    told_from={
        "resistance_step": "let it cool and start again: heat comes back slowly, a bad contact comes and goes at once.",
        "magnetic_saturation": "short pulses of high current, with pauses: saturation follows each at once, heat "
        "does not.",
    },
    states=(WARMING,),
)
