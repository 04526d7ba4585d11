"""Measurement delay: one channel is late."""

from __future__ import annotations

from servo_daemon.parameters import Parameter, Scale
from servo_daemon.plant.effects.base import LATE, Delay, Effect, Signals, Terms
from servo_daemon.plant.regressors import NO_COLUMNS

T_D = Parameter(
    "t_d", "t_d", "s", 0.0005, 1e-07, 0.1, "log", "how late the channel is", "start value", scale=Scale(5e-4)
)
CHANNEL = Parameter(
    "channel",
    r"\text{channel}",
    "1",
    1.0,
    0.0,
    2.0,
    "identity",
    "the late channel: 0 current_A, 1 position_rad, 2 velocity_rad_s",
    "a choice",
    held="always",
    choices=("current_A", "position_rad", "velocity_rad_s"),
)


def _terms(s: Signals) -> Terms:
    return Terms(delay=Delay(s.p["t_d"], s.p["channel"]))


EFFECT = Effect(
    name="measurement_delay",
    cause="One channel is read, filtered or sent later than the voltage: its values belong to an earlier instant than "
    "their time stamps say.",
    equation=r"y_{\mathrm{shown}}(t) = y(t - t_d)",
    parameters=(
        T_D,
        CHANNEL,
    ),
    terms=_terms,
    regressors=NO_COLUMNS,
    late=T_D.name,
    ladder=230,
    states=LATE,
)
