"""The parameter table: every parameter of the linear DC servo with symbol, unit, nominal value, bounds and source.

Symbols follow the paper ("Parameters estimation of DC servo motor using data driven-machine learning based estimation
approach"), with two spelled differently: its D_m is B here (as in its own result table) and its K_t = K_b is one K,
equal in SI units. Effects bring parameters of their own in the same form (see `plant/effects/`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Literal

Transform = Literal["log", "identity"]
#: Which estimators leave a parameter as it is given: none, the live ones, all.
Held = Literal["no", "live", "always"]
#: What a live estimator says of a parameter; and those statuses whose value is the motor's, now or a moment ago.
Status = Literal["estimating", "tracking", "unexcited", "at_bound", "fixed", "invalid"]
KNOWN: tuple[Status, ...] = ("tracking", "unexcited")


def spaced(unit: str) -> str:
    """A unit as it follows a number in a sentence; nothing after a bare number, whose unit is "1"."""
    return "" if unit in ("", "1") else f" {unit}"


@dataclass(frozen=True, slots=True)
class Scale:
    """The size of a parameter on a motor of any size: the product of the motor's own sizes to these powers.

    Attributes:
        share: a search starts at this share of the product; 0: at the parameter's nominal value.
        torque, voltage, current, speed: what the motor works with, N·m, V, A, rad/s.
        travel: half of the way it moves, rad.
        seconds: length of the recording, s.
        R, J, B: the motor's.
    """

    share: float
    torque: int = 0
    voltage: int = 0
    current: int = 0
    speed: int = 0
    travel: int = 0
    seconds: int = 0
    R: int = 0
    J: int = 0
    B: int = 0

    def product(self, sizes: Mapping[str, float]) -> float:
        """From "torque", "voltage", … to the parameter's unit; a size that is missing counts as 1."""
        powers = ((f.name, getattr(self, f.name)) for f in fields(self) if f.name != "share")
        return math.prod(float(sizes.get(name, 1.0) ** power) for name, power in powers if power)


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of a model.

    Attributes:
        name: the name in configuration, captures and JSON.
        symbol: LaTeX.
        unit: SI unit as it is published.
        nominal: the paper's motor (its Table 1 result) or a start value for an effect.
        lower, upper: physical bounds in `unit`; an estimate is clamped to them and flagged `at_bound`.
        transform: "log" for positive parameters (estimated as logarithms), "identity" for signed ones.
        description: what it is, in words.
        source: where the nominal value or the bounds come from.
        scale: its size on a motor of any size; None: the nominal value serves everywhere.
        held: "live": a filter that runs along cannot find it (the instant of a step, a frequency: the data hold many
            wrong values that look right), a fit from a good start can; "always": a count or a choice, which a fit
            holds, too.
        choices: what the values 0, 1, … of a choice stand for.
    """

    name: str
    symbol: str
    unit: str
    nominal: float
    lower: float
    upper: float
    transform: Transform
    description: str
    source: str
    scale: Scale | None = None
    held: Held = "no"
    choices: tuple[str, ...] = ()

    @property
    def searched(self) -> bool:
        """Whether a search must try starts: no slope leads there from far away."""
        return self.held != "no"

    def read(self, given: object) -> float:
        """A value as it is given in a file, on a command line or in a request: a number in `unit` or its text, of a
        choice its name or its number.

        Raises:
            ValueError: what is wrong with it, in words that go on after the parameter's name.
        """
        if self.choices and given in self.choices:
            return float(self.choices.index(str(given)))
        try:
            if not isinstance(given, int | float | str) or isinstance(given, bool):
                raise ValueError
            value = float(given)
        except (ValueError, OverflowError):
            what = f"none of {', '.join(self.choices)}" if self.choices else "not a number"
            raise ValueError(f"{given!r} is {what}") from None
        if not self.lower <= value <= self.upper:  # which a NaN is not
            raise ValueError(f"{value:g}{spaced(self.unit)} is outside {self.lower:g} .. {self.upper:g}")
        if self.choices and not value.is_integer():
            raise ValueError(f"{value:g} is none of {', '.join(self.choices)}")
        return value

    def __post_init__(self) -> None:
        if not self.lower < self.upper:
            raise ValueError(f"{self.name}: bounds {self.lower} .. {self.upper} are empty")
        if self.transform == "log" and self.lower <= 0:
            raise ValueError(f"{self.name}: a log parameter needs a positive lower bound")


_PAPER = "paper, section 2, method 2, estimation result"

R = Parameter("R", "R_a", "Ω", 0.4937, 1e-4, 1e4, "log", "armature resistance", _PAPER)
L = Parameter("L", "L_a", "H", 2.2769e-3, 1e-8, 10.0, "log", "armature inductance", _PAPER)
K = Parameter("K", "K", "N·m/A", 0.30628, 1e-6, 1e3, "log", "torque constant = back-EMF constant", _PAPER)
J = Parameter("J", "J", "kg·m²", 0.009751, 1e-10, 1e3, "log", "inertia of motor and load, J_m + J_d", _PAPER)
B = Parameter("B", "B", "N·m·s/rad", 0.51141, 1e-10, 1e3, "log", "viscous friction (the paper's D_m)", _PAPER)

#: The linear motor's parameters in the order in which they are published everywhere.
LINEAR: tuple[Parameter, ...] = (R, L, K, J, B)
#: Their names; and of those that the armature's balance shows.
MOTOR_NAMES = tuple(p.name for p in LINEAR)
WINDING_NAMES = MOTOR_NAMES[:3]

#: Motor inertia without load: not estimated (the data see only J), given, so that J_d = J - J_m can be published.
J_M = Parameter("J_m", "J_m", "kg·m²", 0.009751, 1e-10, 1e3, "log", "inertia of the bare motor", "datasheet")
J_D = Parameter("J_d", "J_d", "kg·m²", 0.0, -1e3, 1e3, "identity", "inertia of the load, J - J_m", "derived")
