"""Another model for a drive that runs: what was asked for, checked, and what it means for the drive's configuration.

An adopted model is to the drive what the same lines in its configuration would be: the effects in `model`, and the
effects' parameters, where a value was given, in `[drive.nominal]`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from servo_daemon.config import DriveConfig
from servo_daemon.errors import ConfigError, ModelError
from servo_daemon.parameters import LINEAR, MOTOR_NAMES, Parameter
from servo_daemon.plant.effects import check_effects, effects_by_name
from servo_daemon.tracking.plan.settings import Message
from servo_daemon.tracking.plan.signals import is_held
from servo_daemon.tracking.prior_transfer import StartValue

#: Events are over when a filter that runs along could adopt them: what stays of them, if anything, is another effect.
_AFTER_EVENT: Mapping[str, str | None] = {
    name: effect.simpler[0][0] if effect.simpler else None
    for name, effect in effects_by_name().items()
    if effect.kind == "event"
}


@dataclass(frozen=True, slots=True)
class ModelRequest:
    """A model that a drive is to have.

    Attributes:
        effects: on top of the linear motor.
        start: value and 1 σ (None: not known) of parameters, in their units; the others keep what is known of them.
        origin_s: device time from which times among `start` count; None: as the running filter counts.
        by: who wants it: "request" or "diagnosis".
    """

    effects: tuple[str, ...]
    start: Mapping[str, StartValue]
    origin_s: float | None = None
    by: str = "request"

    def configure(self, config: DriveConfig) -> DriveConfig:
        """The drive's configuration with this model.

        Args:
            config: as the user wrote it.
        """
        nominal = dict(config.nominal)
        own = {*MOTOR_NAMES}
        for name, (value, _) in self.start.items():
            # What the filter cannot search for is held at its nominal value: there the newer one counts.
            if name not in own and (name not in nominal or is_held(parameters_of(self.effects)[name])):
                nominal[name] = value
        return config.model_copy(update={"model": self.effects, "nominal": nominal})


def parameters_of(effects: Sequence[str]) -> dict[str, Parameter]:
    """Those of a model with these effects, by name."""
    table = {p.name: p for p in LINEAR}
    for name in effects:
        table.update({p.name: p for p in effects_by_name()[name].parameters})
    return table


def describe_model(effects: Sequence[str]) -> str:
    """A model in words."""
    return " + ".join(["the linear motor", *effects])


def change_message(before: Sequence[str], now: Sequence[str]) -> Message:
    """What is told when a drive's model has changed."""
    text = f"the model is now {describe_model(now)}, before {describe_model(before)}"
    return "model_changed", text, {"model": ",".join(now), "before": ",".join(before)}


def checked_request(effects: Sequence[str], start: Mapping[str, tuple[float | str, float | None]]) -> ModelRequest:
    """The request, if a drive can have this model.

    Args:
        start: as in `ModelRequest`; a choice (`channel`) may be given by its name.

    Raises:
        ModelError: an effect does not exist, these do not go together, or a parameter is not of this model or
            impossible; naming it.
    """
    for k, name in enumerate(effects):
        if name not in (known := tuple(effects_by_name())):
            raise ModelError(f"effects.{k}", f"there is no effect {name!r}; there are {', '.join(known)}", known)
    try:
        check_effects(effects)
    except ConfigError as error:
        raise ModelError("effects", str(error)) from None
    table = parameters_of(effects)
    checked = {}
    for name, (value, std) in start.items():
        if name not in table:
            names = tuple(table)
            raise ModelError(f"parameters.{name}", f"this model has {', '.join(names)}, and no {name!r}", names)
        checked[name] = _checked(table[name], value, std)
    return ModelRequest(tuple(effects), checked)


def _checked(p: Parameter, value: float | str, std: float | None) -> StartValue:
    where = f"parameters.{p.name}"
    if isinstance(value, str) and value not in p.choices:  # JSON has numbers of its own
        raise ModelError(where, f"{value!r} is none of {', '.join(p.choices) or 'its values, which are numbers'}")
    try:
        number = p.read(value)
    except ValueError as error:
        raise ModelError(where, str(error)) from None
    if std is not None and not (math.isfinite(std) and std >= 0):
        raise ModelError(where, f"a standard deviation of {std:g} makes no sense")
    return number, std if std and std < p.upper - p.lower else None  # one that is wider says nothing


def adopted_effects(model: Sequence[str], found: Sequence[str]) -> tuple[str, ...]:
    """The model with what a diagnosis has found in it, for a filter that runs along: a found effect takes the place of
    one with which it shares a parameter (the asymmetric friction that of the plain one), and of an event what stays.

    Raises:
        ModelError: a found effect does not exist in this version.
    """
    lasting: list[str] = []
    for name in found:
        stays = _AFTER_EVENT.get(name, name)
        if stays is not None and stays not in lasting:
            lasting.append(stays)
    known = effects_by_name()
    for name in lasting:
        if name not in known:
            raise ModelError("effects", f"there is no effect {name!r}")
    taken = {p.name for name in lasting for p in known[name].parameters}
    kept = [n for n in model if n not in lasting and not taken & {p.name for p in known[n].parameters}]
    return (*kept, *lasting)
