"""What an effect adds to the balances as far as it is linear in parameters: the columns of a regression.

A column's coefficient is a torque (N·m), a share of the motor torque, or a voltage. What is held (orders, frequencies)
is a constant of the signals; a term that is not linear in what is left (`ws` of the Stribeck friction) is taken at its
start value.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from servo_daemon.parameters import Parameter
from servo_daemon.samples import F64

#: Of all parameters, natural units, by name.
Values = Mapping[str, float]
#: A number, and its derivatives by what it is made of.
Derived = tuple[float, dict[str, float]]


class Course(Protocol):
    """A motion as columns are made of it; shapes (n,), SI units, 0 where it is no measurement.

    Attributes:
        time_s: since some start.
        sliding: direction of motion, 0 where noise may have made it.
        speed, angle: of the shaft.
        effort: current, or the torque where that is the input.
    """

    @property
    def time_s(self) -> F64: ...
    @property
    def sliding(self) -> F64: ...
    @property
    def speed(self) -> F64: ...
    @property
    def angle(self) -> F64: ...
    @property
    def effort(self) -> F64: ...


@dataclass(frozen=True, slots=True)
class Column:
    """One column.

    Attributes:
        name: columns of one name are one (a constant).
        gives: the parameter that it is looked at for.
        coefficient: with the derivatives by the estimated coordinates.
        solve: the parameter from the coefficients of all columns, with the derivatives by these; None: it is the
            coefficient itself.
        share: the coefficient is a share of the motor torque.
    """

    name: str
    gives: str
    coefficient: Callable[[Values], Derived]
    solve: Callable[[Values], Derived] | None = None
    share: bool = False


@dataclass(frozen=True, slots=True)
class Regressors:
    """One effect's columns.

    Attributes:
        shaft, armature: in these balances.
        signals: what the shaft's columns are the integrals of, each of shape (n,).
        beside: an effect without which there are none.
    """

    shaft: tuple[Column, ...] = ()
    armature: tuple[Column, ...] = ()
    signals: Callable[[Course, Values], list[F64]] = lambda _, __: []
    beside: str = ""


#: Of an effect without which the balances are judged: it is small, or an error of a sensor and no term of theirs.
NO_COLUMNS = Regressors()


def itself(p: Parameter, *, share: bool = False) -> Column:
    """A column whose coefficient is the parameter."""
    return Column(
        p.name, p.name, lambda value: (value[p.name], {p.name: value[p.name] if p.transform == "log" else 1.0}),
        share=share,
    )  # fmt: skip


def constant(p: Parameter, factor: Callable[[Values], float] = lambda _: 1.0) -> Column:
    """The constant of a balance, of which a parameter that may be in no model is so much."""

    def coefficient(value: Values) -> Derived:
        by = factor(value)
        return by * value.get(p.name, 0.0), {p.name: by}

    return Column("one", p.name, coefficient)


def wave(stem: str, amplitude: Parameter, phase: Parameter, *, share: bool = False) -> tuple[Column, Column]:
    """A sine of an angle: A sin(α + φ) = (A cos φ) sin α + (A sin φ) cos α."""
    A, phi = amplitude.name, phase.name
    sine, cosine = f"{stem}_sin", f"{stem}_cos"

    def of_sine(value: Values) -> Derived:
        c, s = value[A] * math.cos(value[phi]), value[A] * math.sin(value[phi])
        return c, {A: c, phi: -s}

    def of_cosine(value: Values) -> Derived:
        c, s = value[A] * math.cos(value[phi]), value[A] * math.sin(value[phi])
        return s, {A: s, phi: c}

    def size(value: Values) -> Derived:
        c, s = value[sine], value[cosine]
        length = _length(c, s)
        return length, {sine: c / length, cosine: s / length}

    def angle(value: Values) -> Derived:
        c, s = value[sine], value[cosine]
        length = _length(c, s)
        return math.atan2(s, c), {sine: -s / length**2, cosine: c / length**2}

    return Column(sine, A, of_sine, size, share), Column(cosine, phi, of_cosine, angle, share)


def _length(c: float, s: float) -> float:
    return max(math.hypot(c, s), 1e-300)


def sine_and_cosine(angle: F64) -> list[F64]:
    """Sine and cosine of the angle: the signals of a `wave`."""
    return [np.sin(angle), np.cos(angle)]
