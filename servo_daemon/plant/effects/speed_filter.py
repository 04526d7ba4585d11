"""Speed filter: the speed is filtered, or a difference over a window, before it is shown."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from servo_daemon.parameters import Parameter, Scale
from servo_daemon.plant.columns.regressors import NO_COLUMNS
from servo_daemon.plant.columns.screening import LAGS_S, Basis, Context, Trace, positive, relaxed
from servo_daemon.plant.effects.base import Effect, Signals, State, Terms
from servo_daemon.samples import F64

T_F = Parameter(
    "t_f", "t_f", "s", 0.003, 1e-07, 10.0, "log", "time constant of the filter", "start value", scale=Scale(0.003)
)
#: The speed as the filter has it.
FILTERED = State("filtered_speed_rad_s", "rad/s", 0.0, 10.0)


def _terms(s: Signals) -> Terms:
    behind = s.states[FILTERED.name] - s.omega
    return Terms(rates={FILTERED.name: -behind / s.p["t_f"]}, sensed={"velocity_rad_s": behind})


def _screening(c: Context) -> Iterator[Basis]:
    if "velocity_rad_s" not in c.channels:
        return
    m = c.motion
    speed = m.at_sample["velocity_rad_s"]
    for tau in LAGS_S:

        def start(b: F64, tau: float = float(tau)) -> dict[str, float] | None:
            return {"t_f": tau * b[0]} if positive(b[0]) and b[0] < 5 else None

        change = np.diff(speed, prepend=speed[0])  # half a step ago, on average
        behind = -np.exp(-m.h / (2 * tau)) * (change + np.exp(-m.h / tau) * relaxed(change, m.h, float(tau)))
        yield Basis((c.add(f"filter {tau}", Trace(shown={"velocity_rad_s": behind})),), start, 1)


EFFECT = Effect(
    name="speed_filter",
    cause="The sensor filters its speed, or takes it from a difference of the angle over a window (a lag of half): "
    "what is shown follows the motor's speed.",
    equation=r"t_f\,\dot\omega_{\mathrm{shown}} = \omega - \omega_{\mathrm{shown}}",
    parameters=(T_F,),
    terms=_terms,
    screening=_screening,
    regressors=NO_COLUMNS,
    late=T_F.name,
    hides={T_F.name: (T_F.name,)},
    ladder=240,
    substeps=4,
    states=(FILTERED,),
)
