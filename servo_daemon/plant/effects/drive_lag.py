"""Drive lag: what acts on the motor follows what is reported."""

from __future__ import annotations

from servo_daemon.parameters import LINEAR, Parameter, Scale
from servo_daemon.plant.effects.base import LAGGED, Effect, Signals, Terms
from servo_daemon.plant.regressors import NO_COLUMNS

T_LAG = Parameter(
    "t_lag", "t_{lag}", "s", 0.001, 1e-07, 10.0, "log", "time constant of the lag", "start value", scale=Scale(0.001)
)


def _terms(s: Signals) -> Terms:
    return Terms(lag_s=s.p["t_lag"])


EFFECT = Effect(
    name="drive_lag",
    cause="The output stage filters: the voltage or force at the motor follows the reported one by a first-order lag, "
    "the bandwidth of an inner loop (which leaves the same trace as L/R: the two trade places unless L is known).",
    equation=r"t_{lag}\,\dot v = v_{\mathrm{shown}} - v",
    parameters=(T_LAG,),
    terms=_terms,
    regressors=NO_COLUMNS,
    late=T_LAG.name,
    hides={T_LAG.name: (T_LAG.name, *(p.name for p in LINEAR))},  # L and a lag trade places
    ladder=220,
    told_from={
        "measurement_delay": "excite higher frequencies: a lag also lowers the amplitude, a delay only turns the "
        "phase.",
        "shaft_compliance": "excite higher frequencies: a spring has a resonance, a lag has none.",
    },
    substeps=4,
    states=(LAGGED,),
)
