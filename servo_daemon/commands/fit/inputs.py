"""What the offline commands (fit, compare) make of their arguments: captures, model, fixed and nominal values."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from servo_daemon.captures import Capture, in_canonical_order, without_copies
from servo_daemon.captures.capture.model import capture_error
from servo_daemon.captures.columns.plausible import check_time_unit, plausibility_notes
from servo_daemon.captures.meaning import as_meant, excluded_values, without_unusable
from servo_daemon.commands.shared import common
from servo_daemon.conditioning.current_moment import earlier, unfiltered
from servo_daemon.config import DriveConfig
from servo_daemon.errors import BadInputError
from servo_daemon.identification.output_error.problem.setup import FEWEST_SAMPLES, choose_signals
from servo_daemon.identification.procedure.validate import check_input, check_share
from servo_daemon.identification.winding import Winding, one_meaning, winding_of
from servo_daemon.parameters import MOTOR_NAMES
from servo_daemon.plant.effects import effects_by_name
from servo_daemon.signal_meaning import SignalMeaning, told
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
        winding: what the voltage says where it is a measurement; the captures are then without it, and K is held at
            what it says.
        meaning: of the captures' signals before they were converted to a DC motor's.
    """

    drive: DriveConfig
    captures: tuple[Capture, ...]
    validation: tuple[Capture, ...]
    effects: tuple[str, ...]
    baseline: tuple[str, ...]
    nominal: Mapping[str, float]
    fixed: Mapping[str, float]
    notes: tuple[str, ...]
    winding: Winding | None = None
    meaning: SignalMeaning = field(default_factory=SignalMeaning)


def gather(
    arguments: argparse.Namespace,
    paths: Sequence[Path],
    validation_paths: Sequence[Path] = (),
    *,
    searches: bool = False,
) -> Inputs:
    """Read and check everything the command line names.

    Args:
        paths, validation_paths: captures to be fitted, and only to be scored.
        searches: effects are looked for: what is known of one that the model lacks holds if it is found.

    Raises:
        BadInputError: a file, the config or a flag is wrong; one line naming it.
    """
    drive = common.offline_drive(arguments)
    read, copies = without_copies(in_canonical_order(common.read_captures(paths, arguments)))
    meaning = one_meaning(read, drive.signals.meaning())
    captures, said = _as_meant(read, drive)
    validation, said_there = _as_meant(common.read_captures(validation_paths, arguments), drive)
    for capture in (*captures, *validation):
        check_length(capture)
        check_time_unit(capture)
    for capture in captures:
        if len(capture) < FEWEST_SAMPLES:
            text = f"{len(capture)} samples are too few: at least {FEWEST_SAMPLES} without a long gap are needed"
            raise BadInputError(f"{capture.path}: {text}")
    _same_axis((*captures, *validation))
    lost = _unused_channels(captures)
    effects, starts = model_effects(drive, arguments.effect)
    fixed = common.parse_fix(",".join(arguments.fix))
    _check_fixed(fixed, effects)
    nominal = {k: v for k, v in drive.nominal.items() if k != "J_m"} | starts
    notes = [*copies, *said, *said_there]
    notes += [f"{c.path}: {text}" for c in captures for text in excluded_values(c, {**nominal, **fixed})]
    notes += [f"{c.path}: {text}" for c in (*captures, *validation) for text in plausibility_notes(c)]
    notes += lost
    winding = None
    if meaning != SignalMeaning():
        notes.append(f"signals: {told(meaning, {c for one in captures for c in one.channels})}")
    if meaning.measures_voltage:
        if any(c.voltage_V is not None for c in captures):
            winding = winding_of(captures, meaning, effects, fixed)
            fixed |= {"K": K[0]} if "K" not in fixed and (K := winding.of("K")) is not None else {}
            notes += winding.notes
        captures, validation = (tuple(_driven(c, meaning) for c in cs) for cs in (captures, validation))
        nominal = {k: v for k, v in nominal.items() if k not in ("R", "L")}  # which the motion knows nothing of
        fixed = {k: v for k, v in fixed.items() if k not in ("R", "L")}
    elif meaning.current_late_s:
        captures, validation = (tuple(_put_right(c, meaning) for c in cs) for cs in (captures, validation))
    weight = known_weight(drive, captures[0])
    if (searches or "gravity_load" in effects) and weight is not None and "Tg" not in fixed:
        fixed["Tg"] = weight
        notes.append(f"gravity_load: Tg = {weight:.6g} N·m is held, from the known mass and arm length")
    return Inputs(drive, captures, validation, effects, drive.model, nominal, fixed, tuple(notes), winding, meaning)


def _driven(capture: Capture, meaning: SignalMeaning) -> Capture:
    """Without its voltage, and with its motion of the current's moment: the current drives it."""
    moved: dict[str, Any] = {
        name: earlier(capture.time_s, values, meaning.current_late_s)
        for name in ("position_rad", "velocity_rad_s")
        if meaning.current_late_s and (values := getattr(capture, name)) is not None
    }
    return replace(capture.without_voltage(), **moved)


def _put_right(capture: Capture, meaning: SignalMeaning) -> Capture:
    """With the current that flowed, where the drive holds its voltage and filters what it shows of the current."""
    if capture.voltage_V is None or capture.current_A is None:
        return capture
    return replace(capture, current_A=unfiltered(capture.time_s, capture.current_A, meaning.current_late_s))


def _as_meant(captures: Sequence[Capture], drive: DriveConfig) -> tuple[tuple[Capture, ...], list[str]]:
    """The captures in a DC motor's units, without columns that do not mean what they say, and what was found.

    Raises:
        CaptureError: one cannot be used so.
    """
    kept, notes = [], []
    for read in captures:
        capture, found = as_meant(read, drive.signals.meaning(), limit_V=drive.limits.voltage_V)
        kept.append(without_unusable(capture, found))
        notes += [f"{capture.path}: {one.text}" for one in found]
    return tuple(kept), notes


def check_length(capture: Capture) -> None:
    """A capture is long enough to learn something from, or to score a model on.

    Raises:
        CaptureError: it is not.
    """
    if len(capture) < FEWEST_SAMPLES:
        what = f"{len(capture)} samples are too few to learn from or to score a model on: {FEWEST_SAMPLES} at the least"
        raise capture_error(capture.path, what)


def check_validation(inputs: Inputs, adapt: float | None) -> None:
    """That every validation capture can be scored, and `--adapt` used on it: asked before anything is computed.

    Raises:
        BadInputError: one cannot, or `--adapt` makes no sense.
    """
    if adapt is not None and not 0.0 < adapt < 1.0:
        raise BadInputError(f"--adapt must lie between 0 and 1, not {adapt:g}")
    if adapt is not None and not inputs.validation:
        raise BadInputError("--adapt needs a --validate capture to adapt to")
    drive, _ = choose_signals([c for c in inputs.captures[0].channels if all(c in x.channels for x in inputs.captures)])
    for capture in inputs.validation:
        check_input(capture, drive)
        if adapt is not None:
            check_share(capture, adapt)


def model_effects(drive: DriveConfig, texts: Sequence[str]) -> tuple[tuple[str, ...], dict[str, float]]:
    """Effects of config and flags, in that order, each once; start values given with the flags."""
    names, starts = list(drive.model), dict[str, float]()
    for text in texts:
        name, values = parse_effect(text)
        names += [n for n in with_harmonics(name, values) if n not in names]
        starts |= values
    return tuple(names), starts


def known_weight(drive: DriveConfig, capture: Capture) -> float | None:
    """m g l of a pendulum told by the config or the capture's metadata, N·m; None where it is not."""
    mass = drive.load.mass_kg if drive.load.mass_kg is not None else capture.mass_kg
    arm = drive.load.arm_length_m if drive.load.arm_length_m is not None else capture.arm_length_m
    return None if mass is None or arm is None else mass * GRAVITY * arm


def _check_fixed(fixed: Mapping[str, float], effects: Sequence[str]) -> None:
    """Every fixed parameter must be one of the model's.

    Raises:
        BadInputError: it is not.
    """
    own = {p.name for name in effects for p in effects_by_name()[name].parameters} | {*MOTOR_NAMES}
    if lost := [name for name in fixed if name not in own]:
        raise BadInputError(f"--fix: the model has no parameter {', '.join(lost)}")


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
