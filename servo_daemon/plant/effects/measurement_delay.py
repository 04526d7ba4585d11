"""Measurement delay: one channel is late."""

from __future__ import annotations

from collections.abc import Iterator

from servo_daemon.parameters import Parameter, Scale
from servo_daemon.plant.columns.regressors import NO_COLUMNS
from servo_daemon.plant.columns.screening import Basis, Context, Trace, positive
from servo_daemon.plant.effects.base import LATE, Delay, Effect, Signals, Terms
from servo_daemon.samples import F64

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


def _screening(c: Context) -> Iterator[Basis]:
    m = c.motion
    rates = {"position_rad": -m.at_sample["velocity_rad_s"], "velocity_rad_s": -m.omega_rate}
    if "L" in m.p:
        rates["current_A"] = -m.at_sample["current_A_rate"]
    late = {channel: Trace(shown={channel: rate}) for channel, rate in rates.items() if channel in c.channels}
    for channel, trace in late.items():

        def start(b: F64, channel: str = channel) -> dict[str, float | str] | None:
            return {"t_d": b[0], "channel": channel} if positive(b[0]) else None

        yield Basis((c.add(f"late {channel}", trace),), start, 2)


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
    screening=_screening,
    regressors=NO_COLUMNS,
    late=T_D.name,
    ladder=230,
    states=LATE,
)
