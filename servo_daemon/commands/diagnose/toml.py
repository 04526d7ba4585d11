"""The lines of configuration that put what was found into the daemon."""

from __future__ import annotations

from collections.abc import Sequence

from servo_daemon.diagnosis.verdict.result import NamedEffect
from servo_daemon.identification.output_error import OutputErrorFit
from servo_daemon.parameters import Parameter
from servo_daemon.plant.effects import effects_by_name


def toml_lines(fit: OutputErrorFit, effects: Sequence[NamedEffect]) -> str:
    """For below `[[drive]]`: the model, and the values of the added effects as nominal ones."""
    names = ", ".join(f'"{name}"' for name in fit.problem.plant.effects)
    added = [effects_by_name()[e.name] for e in effects]
    table = {p.name: p for effect in added for p in effect.parameters}
    found = {n: fit.parameters[n] for n in table if n in fit.parameters}
    values = {n: None if p.status == "undetermined" else p.value for n, p in found.items()}
    lines = [f"{name} = {_number(table[name], value)}" for name, value in values.items() if value is not None]
    unknown = [name for name, value in values.items() if value is None]
    if unknown:
        lines.append(f"# not determined by these data: {', '.join(unknown)}")
    return "\n".join([f"model = [{names}]", *(["[drive.nominal]", *lines] if lines else [])]) + "\n"


def _number(p: Parameter, value: float) -> str:
    """Six digits, unless rounding leaves the bounds; a choice by its name."""
    if p.choices:
        return f'"{p.choices[round(value)]}"'
    text = f"{value:.6g}"
    return text if p.lower <= float(text) <= p.upper else repr(min(max(value, p.lower), p.upper))
