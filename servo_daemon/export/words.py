"""What every exported file says of itself: where it comes from, how sure its numbers are, what it leaves out."""

from __future__ import annotations

import keyword
import re
from collections.abc import Collection, Mapping, Sequence

from servo_daemon import __version__
from servo_daemon.export.model import ExportedModel, Value
from servo_daemon.parameters import spaced
from servo_daemon.plant.effects import effects_by_name, parameter_table


def number(value: float) -> str:
    """Nine significant digits: more than any estimate is known to."""
    return f"{value:.9g}"


def with_std(value: Value) -> str:
    std = "" if value.std is None else f" ± {value.std:.3g}"
    return f"{number(value.value)}{std}{spaced(value.unit)} ({value.origin})"


#: Words of C, Modelica and MATLAB that no variable can be called, beside Python's.
_KEYWORDS = """
    algorithm annotation asm auto block bool case catch char class classdef connect connector const constant
    constrainedby continue default der discrete do double each else elseif elsewhen encapsulated end endif enum
    enumeration equation expandable extends extern external final float flow for function global goto if import
    impure in initial inline inner input int long loop model nargin nargout not operator otherwise outer output
    package parameter parfor partial persistent protected public pure record redeclare register replaceable restrict
    return short signed sizeof spmd static stream struct switch then true try type typedef union unsigned void
    volatile when while within
"""
#: Names that the files have inside, beside the parameters'.
_WITHIN = """
    p n i t u x omega theta flange rotor drive friction gear input_u rates time Real Modelica np JOINT DC_MOTOR
    sin cos tan exp log sqrt abs sign min max tanh atan2
"""


def identifier(name: str) -> str:
    """A drive's name as every language takes it."""
    text = re.sub(r"\W", "_", name, flags=re.ASCII)
    taken = {*_KEYWORDS.split(), *keyword.kwlist, *_WITHIN.split(), *parameter_table()}
    return text if text[:1].isalpha() and text not in taken else f"drive_{text}"


def header(model: ExportedModel, notes: Sequence[str]) -> list[str]:
    """Lines for a comment at the top of the file."""
    lines = [
        f"{model.name}: {', '.join(('the linear motor', *model.effects))}; input: {model.drive}",
        f"from {model.source}, by servo-daemon {__version__}",
        "at the motor's shaft, SI units, ± 1 standard deviation:",
        *(f"  {name} = {with_std(value)}" for name, value in model.values.items()),
        *(f"  {name}: not known ({why})" for name, why in model.missing.items()),
    ]
    return [*lines, *conventions(model), *(f"NOTE: {text}" for text in notes)]


def conventions(model: ExportedModel) -> list[str]:
    """How voltage, current and angle of the file relate to those that the drive reports."""
    meaning, lines = model.meaning, []
    if meaning.convention == "dq":
        v, i = meaning.factors
        lines.append(
            f"voltage and current are a DC motor's (power v i): {v:.9g} x v_q and {i:.9g} x i_q of the drive "
            f"(amplitude-invariant dq, {meaning.publish} values, {meaning.pole_pairs} pole pairs)"
        )
        if model.limits:
            lines.append("limits of voltage and current are taken as the DC motor's, like R, L and K")
    if meaning.gear_ratio != 1.0:
        lines.append(f"gear: {meaning.gear_ratio:.9g} turns of the motor for one of the output")
    return lines


def common_notes(model: ExportedModel) -> list[str]:
    """Remarks that hold whatever the target."""
    notes = []
    if not model.gear_known:
        notes.append("the source does not say how the encoder is geared: 1 is taken (--config or --gear-ratio say it)")
    return notes


#: For targets whose model has bodies of its own.
ALL_INERTIA = (
    "J is all the inertia that the motor moved, load included: what the other model has of it as bodies must be "
    "taken off"
)


def not_expressed(model: ExportedModel, expressed: Collection[str], why: Mapping[str, str] | None = None) -> list[str]:
    """A sentence for each effect that a target has no place for.

    Args:
        expressed: effects that it has a place for.
        why: by effect, instead of the usual words.
    """
    notes = []
    for name in model.effects:
        if name in expressed:
            continue
        effect = effects_by_name()[name]
        values = ", ".join(
            f"{p.name} = {with_std(model.values[p.name])}" if p.name in model.values else f"{p.name} not known"
            for p in effect.parameters
        )
        reason = (why or {}).get(name, "has no place in this format")
        notes.append(f"{name} {reason}: {effect.cause.rstrip('.')}" + (f"; {values}" if values else ""))
    return notes


def xml_comment(lines: Sequence[str]) -> str:
    """XML knows no two hyphens within a comment."""
    body = "\n".join(f"  {line}" for line in lines).replace("--", "- -")
    return f"<!--\n{body}\n-->"


def line_comments(lines: Sequence[str], mark: str) -> str:
    return "\n".join(f"{mark} {line}".rstrip() for line in lines)
