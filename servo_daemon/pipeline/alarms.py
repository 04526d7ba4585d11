"""Alarms: a published parameter beyond the limit that the user has set for it in `[drive.limits]`.

An alarm rings when the value is beyond its limit by more than `MARGIN_STD` of its own standard deviation, so that noise
does not ring, and ends when it is inside by as much. Only a value that is known rings or ends one (`tracking`, or held
as `unexcited`); with any other status it stays as it is.
"""

from __future__ import annotations

from servo_daemon.config import DriveConfig
from servo_daemon.config_texts import share
from servo_daemon.parameters import J_D, KNOWN, spaced
from servo_daemon.pipeline.publish import published_names
from servo_daemon.published.snapshot import AlarmLimit, Estimate, ParameterEstimate
from servo_daemon.tracking.plan.settings import Message

#: Standard deviations beyond the limit at which an alarm rings, and inside at which it ends (decision 43).
MARGIN_STD = 2.0


class Alarms:
    """The alarms of one drive. Pure: fed estimates, answers with what is to be told.

    Args:
        config: its limits, nominal values and model.

    Attributes:
        impossible: to be told at the start: alarms that can never ring, and why.
    """

    def __init__(self, config: DriveConfig) -> None:
        self._limits: list[AlarmLimit] = []
        self._active: set[str] = set()
        self._seen: tuple[ParameterEstimate, ...] | None = None
        self.impossible: list[Message] = []
        for name, written in config.limits.alarms.items():
            parameter, _, side = name.rpartition("_")
            why = _impossible(config, parameter, isinstance(written, str))
            if why is None:
                value = _limit(config, parameter, written)
                self._limits.append(AlarmLimit(name, parameter, side == "max", value))
            else:
                self.impossible.append(("alarm_impossible", f"the alarm {name} cannot work: {why}", {"alarm": name}))

    @property
    def limits(self) -> tuple[AlarmLimit, ...]:
        """The limits whose alarm can ring."""
        return tuple(self._limits)

    @property
    def active(self) -> str | None:
        """Names of the alarms that ring, separated by commas, in the order of the configuration; None: none does."""
        return ",".join(limit.name for limit in self._limits if limit.name in self._active) or None

    def update(self, estimate: Estimate) -> list[Message]:
        """Compare an estimate with the limits; returns the alarms that begin and end with it."""
        if estimate.parameters is self._seen:  # parameters change with the ticks, the rest of an estimate more often
            return []
        self._seen = estimate.parameters
        parameters = {p.name: p for p in estimate.parameters}
        messages = []
        for limit in self._limits:
            p = parameters[limit.parameter]
            if p.status not in KNOWN or p.value is None or p.std is None:
                continue
            excess, margin = limit.excess(p.value), MARGIN_STD * p.std
            if limit.name not in self._active and excess > margin:
                self._active.add(limit.name)
                messages.append(_message("alarm", limit, p, p.value, estimate.time_s))
            elif limit.name in self._active and excess < -margin:
                self._active.remove(limit.name)
                messages.append(_message("alarm_cleared", limit, p, p.value, estimate.time_s))
        return messages

    def follow(self, before: Alarms, why: str = "the model has changed") -> list[Message]:
        """Take the place of alarms of another model, or of other limits: what rings goes on ringing until the next
        estimate. Returns what there is to tell.

        Args:
            why: those end that are no more, in words.
        """
        names = {limit.name for limit in self._limits}
        self._active = before._active & names
        told = {data["alarm"] for _, _, data in before.impossible}
        before._active -= names
        ended = before.forget(why)
        return [*ended, *(m for m in self.impossible if m[2]["alarm"] not in told)]

    def forget(self, why: str) -> list[Message]:
        """End all alarms: what they were about is no longer known.

        Args:
            why: in words.
        """
        ended = [limit for limit in self._limits if limit.name in self._active]
        self._active.clear()
        self._seen = None
        return [
            ("alarm_cleared", f"alarm {a.name} is forgotten: {why}", {"alarm": a.name, "parameter": a.parameter})
            for a in ended
        ]


def _impossible(config: DriveConfig, parameter: str, relative: bool) -> str | None:
    """Why nothing can be compared with this limit, in words; None if something can."""
    if parameter == J_D.name and "J_m" not in config.nominal:
        return "J_d is published only where [drive.nominal] gives J_m"
    if parameter not in published_names(config):
        return f"{parameter} is no parameter of this drive's model"
    needed = "J" if parameter == J_D.name else parameter
    if relative and needed not in config.nominal:
        return f"it is relative to a nominal value, and [drive.nominal] gives none of {needed}"
    return None


def _limit(config: DriveConfig, parameter: str, written: float | str) -> float:
    """The limit in the parameter's unit. A share is one of the nominal value's size: "+30 %" is above it whatever its
    sign."""
    if not isinstance(written, str):
        return float(written)
    given = config.nominal
    nominal = given["J"] - given["J_m"] if parameter == J_D.name else given[parameter]
    return nominal + share(written) * abs(nominal)


def _message(kind: str, limit: AlarmLimit, p: ParameterEstimate, value: float, time_s: float) -> Message:
    side = "above" if limit.is_upper else "below"
    back = "below" if limit.is_upper else "above"
    where = f"is {side}" if kind == "alarm" else f"is back {back}"
    unit = spaced(p.unit)
    text = f"{p.name} = {value:.4g}{unit} {where} its limit {limit.name} = {limit.value:.4g}{unit}"
    data: dict[str, float | int | str | None] = {
        "alarm": limit.name,
        "parameter": p.name,
        "unit": p.unit,
        "value": value,
        "std": p.std,
        "limit": limit.value,
        "age_s": p.age_s,
        "time_s": time_s,
    }
    return kind, text.rstrip(), data
