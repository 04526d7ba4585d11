"""What an offline method says of one parameter, in natural units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

Axis = Literal["rotary", "linear"]

#: On a linear axis force stands for torque and metres for radians.
_LINEAR_UNITS: Mapping[str, str] = {
    "kg·m²": "kg",
    "N·m·s/rad": "N·s/m",
    "N·m": "N",
    "N·m/A": "N/A",
    "rad": "m",
    "rad/s": "m/s",
    "A·s²/rad": "A·s²/m",
    "A·s/rad": "A·s/m",
    "rad/(s·V)": "m/(s·V)",
    "N·m/V": "N/V",
    "N·m/rad": "N/m",
    "N·m·s²/rad²": "N·s²/m²",
    "1/rad": "1/m",
    "1/rad²": "1/m²",
}


@dataclass(frozen=True, slots=True)
class Estimate:
    """One parameter.

    Attributes:
        value: in `unit`.
        std: 1 σ in `unit`.
        unit: SI.
        std_white: 1 σ as it would be if the residual were white noise; None where the method makes no difference.
    """

    value: float
    std: float
    unit: str
    std_white: float | None = None


def unit_on(axis: Axis, unit: str) -> str:
    """A rotary unit as it reads on this axis."""
    return unit if axis == "rotary" else _LINEAR_UNITS.get(unit, unit)
