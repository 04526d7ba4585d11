"""Drive lag: what acts on the motor follows what is reported."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from servo_daemon.parameters import MOTOR_NAMES, Parameter, Scale
from servo_daemon.plant.columns.regressors import NO_COLUMNS
from servo_daemon.plant.columns.screening import LAGS_S, Basis, Context, Trace, positive, relaxed
from servo_daemon.plant.effects.base import LAGGED, Effect, Signals, Terms
from servo_daemon.samples import F64

T_LAG = Parameter(
    "t_lag", "t_{lag}", "s", 0.001, 1e-07, 10.0, "log", "time constant of the lag", "start value", scale=Scale(0.001)
)


def _terms(s: Signals) -> Terms:
    return Terms(lag_s=s.p["t_lag"])


def _screening(c: Context) -> Iterator[Basis]:
    m = c.motion
    voltage = "L" in m.p
    for tau in LAGS_S:

        def start(b: F64, tau: float = float(tau)) -> dict[str, float] | None:
            return {"t_lag": tau * b[0]} if positive(b[0]) and b[0] < 5 else None

        change = np.diff(m.u, prepend=m.u[0])
        distance = change + np.exp(-m.h / tau) * relaxed(change, m.h, float(tau))  # u − lagged at the sample
        behind = distance * tau / m.h * -np.expm1(-m.h / tau)
        trace = Trace(voltage=behind) if voltage else Trace(torque=behind * m.p.get("K", 1.0))
        yield Basis((c.add(f"lag {tau}", trace),), start, 1)


EFFECT = Effect(
    name="drive_lag",
    cause="The output stage filters: the voltage or force at the motor follows the reported one by a first-order lag, "
    "the bandwidth of an inner loop (which leaves the same trace as L/R: the two trade places unless L is known).",
    equation=r"t_{lag}\,\dot v = v_{\mathrm{shown}} - v",
    parameters=(T_LAG,),
    terms=_terms,
    screening=_screening,
    regressors=NO_COLUMNS,
    late=T_LAG.name,
    hides={T_LAG.name: (T_LAG.name, *MOTOR_NAMES)},  # L and a lag trade places
    ladder=220,
    told_from={
        "measurement_delay": "excite higher frequencies: a lag also lowers the amplitude, a delay only turns the "
        "phase.",
        "shaft_compliance": "excite higher frequencies: a spring has a resonance, a lag has none.",
    },
    substeps=4,
    states=(LAGGED,),
)
