"""Ageing: how a simulated motor's true parameters change over time, and the texts that say so.

    R=+40%              linear over the whole capture
    R=+40%/300s         linear, reached after 300 s, then held (s, min, h, d)
    R=+40%/300s:exp     towards +40 % with a time constant of 300 s
    R=+30%@12s          a step at 12 s; `@` also delays the other shapes
    K=5%/sqrt(min):walk random walk, 5 % (1 σ) after a minute, 5 %·√n after n minutes
    J_d=+0.003@10s      without % the change is absolute, in the parameter's unit; J_d changes J

A ramp is held, not continued, because a simulated drive runs for days and no motor loses 40 % every 300 s for long.
Percentages refer to the value at the start. Several profiles of one parameter are applied in the order given.
"""

from __future__ import annotations

import math
import re
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np

from servo_daemon.config_texts import NUMBER, UNIT_S
from servo_daemon.errors import BadInputError
from servo_daemon.parameters import Parameter
from servo_daemon.samples import F64

Shape = Literal["linear", "exp", "step", "walk"]

_UNIT = r"s|min|h|d"
_PROFILE = re.compile(
    rf"^\s*(?P<name>[A-Za-z]\w*)\s*=\s*(?P<sign>[+\-−]?)\s*(?P<amount>{NUMBER})\s*(?P<percent>%?)"
    rf"(?:\s*/\s*(?P<sqrt>sqrt)?\s*\(?\s*(?P<count>{NUMBER})?\s*(?P<unit>{_UNIT})\s*\)?)?"
    rf"(?:\s*@\s*(?P<at>{NUMBER})\s*(?P<at_unit>{_UNIT})?)?"
    r"(?:\s*:\s*(?P<shape>linear|exp|step|walk))?\s*$"
)
#: Seconds between the nodes of a random walk; linear between them. One number is kept for every node so far
#: (86,400 a day), because a walk has no shorter memory.
_WALK_STEP_S = 1.0


@lru_cache(maxsize=32)
def _walk_nodes(seed: int, n: int) -> F64:
    """A Wiener process at 0, 1, … n − 1 steps, √s; a longer one begins with the same numbers."""
    steps = np.random.Generator(np.random.PCG64(seed)).standard_normal(n - 1) * math.sqrt(_WALK_STEP_S)
    return np.concatenate(([0.0], np.cumsum(steps)))


def _walk(seed: int, t: F64) -> F64:
    """The Wiener process of this seed at times t ≥ 0 (s), √s."""
    nodes_needed = int(t[-1] / _WALK_STEP_S) + 2
    nodes = _walk_nodes(seed, 1 << nodes_needed.bit_length())  # powers of two: few different lengths to remember
    return np.interp(t, np.arange(nodes_needed) * _WALK_STEP_S, nodes[:nodes_needed])


@dataclass(frozen=True, slots=True)
class Profile:
    """One change of one parameter.

    Attributes:
        parameter: name, J_d included.
        amount: fraction of the start value where `relative`, else in the parameter's unit; for a walk 1 σ after 1 s.
        relative: which of the two.
        shape: "linear", "exp", "step" or "walk".
        duration_s: until a linear change is complete; the time constant of an exponential one; else unused.
        start_s: nothing happens before.
        seed: of a walk.
    """

    parameter: str
    amount: float
    relative: bool
    shape: Shape
    duration_s: float = 0.0
    start_s: float = 0.0
    seed: int = 0

    def progress(self, t: F64) -> F64:
        """How much of `amount` has come by time t: 0 to 1, for a walk the Wiener process in √s.

        Args:
            t: shape (n,), s, not decreasing.
        """
        since = t - self.start_s
        if self.shape == "step":
            return (since >= 0).astype(np.float64)
        since = np.maximum(since, 0.0)
        if self.shape == "linear":
            return np.minimum(since / self.duration_s, 1.0)
        if self.shape == "exp":
            return -np.expm1(-since / self.duration_s)
        return _walk(self.seed, since)

    def apply(self, value: F64, start_value: float, t: F64) -> F64:
        """`value` (n,) with this change added. A relative walk multiplies, so that it cannot change the sign."""
        if self.shape == "walk" and self.relative:
            return value * np.exp(self.amount * self.progress(t))
        return value + self.amount * (start_value if self.relative else 1.0) * self.progress(t)


def _refuse(text: str, why: str) -> BadInputError:
    return BadInputError(f"ageing {text!r}: {why}")


def parse_profile(text: str, seconds: float | None = None) -> Profile:
    """One ageing text as a profile (see the module's table of forms).

    Args:
        text: such as "R=+40%/300s".
        seconds: length of the capture, for a change "over the whole capture"; None where there is no end.

    Raises:
        BadInputError: not of one of the forms, or the form lacks what its shape needs.
    """
    match = _PROFILE.match(text)
    if match is None:
        raise _refuse(text, "not of the form NAME=+40%, +40%/300s, +40%/300s:exp, +30%@12s or 5%/sqrt(min):walk")
    given_shape, over = match["shape"], match["unit"] is not None
    is_walk = given_shape == "walk" or match["sqrt"] is not None
    if is_walk and given_shape not in (None, "walk"):
        raise _refuse(text, f"'/sqrt(…)' is a random walk, not '{given_shape}'")
    amount = float(match["amount"]) / (100.0 if match["percent"] else 1.0)
    span_s = float(match["count"] or 1.0) * UNIT_S[match["unit"] or "s"]
    start_s = float(match["at"] or 0.0) * UNIT_S[match["at_unit"] or "s"]
    if over and not span_s > 0:
        raise _refuse(text, "the time after '/' must be greater than zero")
    if not all(map(math.isfinite, (amount, span_s, start_s))):
        raise _refuse(text, "a number is too large")
    profile = Profile(match["name"], amount, bool(match["percent"]), "walk", 0.0, start_s)
    if is_walk:
        if not over:
            raise _refuse(text, "a random walk needs its pace, such as 5%/sqrt(min):walk")
        return replace(profile, amount=amount / math.sqrt(span_s), seed=zlib.crc32(match["name"].encode()))
    if not match["sign"]:
        raise _refuse(text, "say + or - before the change")
    profile = replace(profile, amount=amount if match["sign"] == "+" else -amount)
    if given_shape == "step" or (given_shape is None and not over and match["at"] is not None):
        return _step(text, profile, over, match["at"] is not None)
    if not over:
        if seconds is None:
            raise _refuse(text, "without an end the change needs a time, such as +40%/300s")
        span_s = seconds - start_s
        if not span_s > 0:
            raise _refuse(text, f"it would start after the end, {seconds:g} s")
    return replace(profile, shape="exp" if given_shape == "exp" else "linear", duration_s=span_s)


def _step(text: str, profile: Profile, over: bool, has_time: bool) -> Profile:
    if over or not has_time:
        raise _refuse(text, "a step needs its moment and no duration, such as +30%@12s")
    return replace(profile, shape="step")


@dataclass(frozen=True)
class Ageing:
    """The true parameters over time.

    Attributes:
        parameters: of the model, in its order.
        start: their values at time 0, shape (np,).
        profiles: changes, in the order they are applied.
        motor_inertia: J_m, kg·m², if known; a relative change of J_d needs it.
    """

    parameters: tuple[Parameter, ...]
    start: F64
    profiles: tuple[Profile, ...] = ()
    motor_inertia: float | None = None

    def __post_init__(self) -> None:
        names = [p.name for p in self.parameters]
        for profile in self.profiles:
            label = f"ageing of {profile.parameter}"
            if profile.parameter == "J_d" and "J" in names:
                if profile.relative and self.motor_inertia is None:
                    raise BadInputError(f"{label}: a change in % needs J_m, so that J_d = J - J_m is known")
            elif profile.parameter not in names:
                raise BadInputError(f"{label}: no such parameter here: there are {', '.join([*names, 'J_d'])}")
            self._check_range(profile, label)

    def _check_range(self, profile: Profile, label: str) -> None:
        if profile.shape == "walk":
            return
        column, start = self._target(profile)
        change = profile.amount * (start if profile.relative else 1.0)
        final, p = self.start[column] + change, self.parameters[column]
        if not p.lower <= final <= p.upper:
            raise BadInputError(
                f"{label}: {p.name} would become {final:g}, outside {p.lower:g} .. {p.upper:g} {p.unit}"
            )

    def _target(self, profile: Profile) -> tuple[int, float]:
        """Which column a profile changes and the start value its percentage refers to."""
        names = [p.name for p in self.parameters]
        if profile.parameter == "J_d":
            column = names.index("J")
            return column, float(self.start[column]) - (self.motor_inertia or 0.0)
        column = names.index(profile.parameter)
        return column, float(self.start[column])

    def values(self, t: F64) -> F64:
        """All parameters at times t, kept within their bounds.

        Args:
            t: shape (n,), s, not decreasing.

        Returns:
            shape (n, np), natural units, C-contiguous.
        """
        values = np.tile(self.start, (t.shape[0], 1))
        for profile in self.profiles:
            column, start = self._target(profile)
            if profile.parameter == "J_d" and profile.shape == "walk" and profile.relative:
                load = profile.apply(np.full(t.shape, start), start, t)
                values[:, column] += load - start
            else:
                values[:, column] = profile.apply(values[:, column], start, t)
        if self.profiles:
            lower, upper = ([getattr(p, side) for p in self.parameters] for side in ("lower", "upper"))
            np.clip(values, lower, upper, out=values)
        return values

    @property
    def changing(self) -> tuple[str, ...]:
        """Names of the model's parameters that some profile changes, in the model's order."""
        touched = {self._target(profile)[0] for profile in self.profiles}
        return tuple(p.name for k, p in enumerate(self.parameters) if k in touched)


def parse_ageing(texts: Iterable[str], seconds: float | None = None, seed: int = 0) -> tuple[Profile, ...]:
    """Several ageing texts; every walk gets a stream of its own from `seed`, its parameter and its place.

    Raises:
        BadInputError: see `parse_profile`.
    """
    profiles = [parse_profile(text, seconds) for text in texts]
    streams = [np.random.SeedSequence([seed, profile.seed, k]) for k, profile in enumerate(profiles)]
    return tuple(
        replace(profile, seed=int(stream.generate_state(1, np.uint64)[0])) if profile.shape == "walk" else profile
        for profile, stream in zip(profiles, streams, strict=True)
    )


def ageing_texts(table: Mapping[str, str | Sequence[str]] | Sequence[str]) -> tuple[str, ...]:
    """A configuration's `ageing` table (parameter -> text or list of texts) or list of texts, as a flat list.

    Raises:
        BadInputError: something in it is not text.
    """
    if isinstance(table, Mapping):
        return tuple(f"{name}={text}" for name, value in table.items() for text in _texts(value, f"{name}: "))
    return _texts(table, "")


def _texts(value: object, where: str) -> tuple[str, ...]:
    """A text, or a list of them, as a tuple."""
    texts: list[str] = []
    for text in value if isinstance(value, list | tuple) else [value]:
        if not isinstance(text, str):
            raise BadInputError(f"ageing: {where}{text!r} is not a text such as '+40%/300s'")
        texts.append(text)
    return tuple(texts)
