"""What the offline commands (fit, compare) make of their arguments: captures, model, fixed and nominal values."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from servo_daemon.captures import Capture
from servo_daemon.captures.plausible import check_time_unit, plausibility_notes
from servo_daemon.commands import common
from servo_daemon.config import DriveConfig
from servo_daemon.errors import BadInputError
from servo_daemon.estimators.output_error.setup import choose_signals
from servo_daemon.plant.effects import effects_by_name, parameter_table
from servo_daemon.simulate.settings import parse_effect, with_harmonics

#: m/s², standard acceleration of gravity (CGPM 1901).
GRAVITY = 9.80665


@dataclass(frozen=True, slots=True)
class Inputs:
    """Everything a fit starts from.

    Attributes:
        drive: of the config, or without one a drive of which nothing is nominal.
        captures: to be fitted.
        validation: only to be scored.
        effects: the model: the config's, then those of the flags.
        baseline: the config's model alone.
        nominal: start values, natural units.
        fixed: held values.
        notes: for the user.
    """

    drive: DriveConfig
    captures: tuple[Capture, ...]
    validation: tuple[Capture, ...]
    effects: tuple[str, ...]
    baseline: tuple[str, ...]
    nominal: Mapping[str, float]
    fixed: Mapping[str, float]
    notes: tuple[str, ...]


def gather(arguments: argparse.Namespace, paths: Sequence[Path], validation_paths: Sequence[Path] = ()) -> Inputs:
    """Read and check everything the command line names.

    Args:
        paths, validation_paths: captures to be fitted, and only to be scored.

    Raises:
        BadInputError: a file, the config or a flag is wrong; one line naming it.
    """
    drive = common.offline_drive(arguments)
    captures = common.read_captures(paths, arguments)
    validation = common.read_captures(validation_paths, arguments)
    for capture in (*captures, *validation):
        check_time_unit(capture)
    _same_axis((*captures, *validation))
    lost = _unused_channels(captures)
    effects, starts = model_effects(drive, arguments.effect)
    fixed = fixed_values(",".join(arguments.fix))
    notes = [f"{c.path}: {text}" for c in (*captures, *validation) for text in plausibility_notes(c)]
    notes += lost
    weight = known_weight(drive, captures[0])
    if "gravity_load" in effects and weight is not None and "Tg" not in fixed:
        fixed["Tg"] = weight
        notes.append(f"gravity_load: Tg = {weight:.6g} N·m is held, from the known mass and arm length")
    nominal = {k: v for k, v in drive.nominal.items() if k != "J_m"} | starts
    return Inputs(drive, captures, validation, effects, drive.model, nominal, fixed, tuple(notes))


def model_effects(drive: DriveConfig, texts: Sequence[str]) -> tuple[tuple[str, ...], dict[str, float]]:
    """Effects of config and flags, in that order, each once; start values given with the flags."""
    names, starts = list(drive.model), dict[str, float]()
    for text in texts:
        name, values = parse_effect(text)
        names += [n for n in with_harmonics(name, values) if n not in names]
        starts |= values
    return tuple(names), starts


def fixed_values(text: str) -> dict[str, float]:
    """'R=3.57,K=0.046' as numbers within the parameters' bounds.

    Raises:
        BadInputError: not of that form, unknown parameter, impossible value.
    """
    table, out = parameter_table(), {}
    for part in filter(None, (p.strip() for p in text.split(","))):
        name, equals, number = (s.strip() for s in part.partition("="))
        if not equals:
            raise BadInputError(f"--fix: {part!r} is not of the form R=3.57")
        if name not in table or name == "J_m":
            raise BadInputError(f"--fix: no parameter {name!r}: R, L, K, J, B, or one of an effect of the model")
        if name in out:
            raise BadInputError(f"--fix: {name} is given twice")
        try:
            value = float(number)
        except ValueError:
            raise BadInputError(f"--fix: {number!r} is not a number") from None
        p = table[name]
        if not (math.isfinite(value) and p.lower <= value <= p.upper):
            raise BadInputError(f"--fix: {name} = {number} {p.unit} is outside {p.lower:g} .. {p.upper:g}")
        out[name] = value
    return out


def known_weight(drive: DriveConfig, capture: Capture) -> float | None:
    """m g l of a pendulum told by the config or the capture's metadata, N·m; None where it is not."""
    mass = drive.load.mass_kg if drive.load.mass_kg is not None else capture.mass_kg
    arm = drive.load.arm_length_m if drive.load.arm_length_m is not None else capture.arm_length_m
    return None if mass is None or arm is None else mass * GRAVITY * arm


def unused_fixed(fixed: Mapping[str, float], effects: Sequence[str]) -> list[str]:
    """Fixed parameters that belong to no effect of the model."""
    own = {p.name for name in effects for p in effects_by_name()[name].parameters}
    return [name for name in fixed if name not in own and name not in ("R", "L", "K", "J", "B")]


def _same_axis(captures: Sequence[Capture]) -> None:
    axes = {c.axis for c in captures}
    if len(axes) > 1:
        names = ", ".join(f"{c.path} is {c.axis}" for c in captures)
        raise BadInputError(f"captures of a rotary and of a linear axis cannot be fitted together: {names}")


def _unused_channels(captures: Sequence[Capture]) -> list[str]:
    """Captures are fitted together by the signals that all of them have; what that leaves out is said.

    Raises:
        BadInputError: together they have no pair of an input and a response.
    """
    common_ones = [c for c in captures[0].channels if all(c in other.channels for other in captures)]
    try:
        choose_signals(common_ones)
    except BadInputError as error:
        if len(captures) == 1:
            raise
        have = "; ".join(f"{c.path}: {', '.join(c.channels)}" for c in captures)
        raise BadInputError(f"these captures have no input and response in common ({have}): fit them apart") from error
    notes = []
    for c in captures:
        lost = [n for n in c.channels if n not in common_ones and n != "temperature_C"]
        if lost:
            notes.append(
                f"{c.path}: {', '.join(lost)} is not used: not all of these captures have it; fitted alone it is"
            )
    return notes
