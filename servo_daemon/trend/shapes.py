"""Shapes that ageing may have, and the columns in which a series is linear under each of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from servo_daemon.samples import F64
from servo_daemon.trend.series import YEAR_D

Kind = Literal["none", "stepwise", "linear", "exponential", "settling"]

#: Exponential rates, 1/year: growing ones double in 3.5 years to 0.2 years, settling ones are over in 2 years to weeks.
_GROWING: Final = (0.2, 0.35, 0.6, 1.05, 1.85, 3.2)
_SETTLING: Final = (-1.0, -3.0, -9.0)
#: Rates in between: half the distance of their logarithms, as the standard deviation of a rate's logarithm.
BETWEEN: Final = 0.28
#: How a rate may change in a year, as a share of a typical rate (`Priors.rate_1_y`).
_BENDING: Final = 0.3
#: How far a value may wander in a year beside its trend, as shares of the way to the limit: wear in many steps too
#: small to be seen.
_WANDERING: Final = (0.08, 0.25)
#: A year's wave is no pure cosine: where the winter is heated, its half-yearly part is up to a third of the yearly one.
_HALF_YEARLY: Final = 0.3
#: Where a trend may bend or wander, evenly over the series.
_KNOTS: Final = 8


@dataclass(frozen=True, slots=True)
class Shape:
    """One hypothesis.

    Attributes:
        prior: probability, all shapes' together 1.
        rate_1_y: of an exponential, 1/year; negative: it settles.
        bending: how its rate may change in a year, as a share of a typical rate.
        wandering: how far it may go in a year beside its trend, as a share of the way to the limit.
        steps_1_y: steps a year that are expected: single events, one in three years, or a habit.
        step: their size, as a share of the way to the limit.
    """

    kind: Kind
    prior: float
    rate_1_y: float = 0.0
    bending: float = 0.0
    wandering: float = 0.0
    steps_1_y: float = 1.0 / 3.0
    step: float = 0.5


#: Wear that grows faster and faster is taken for more likely than wear that does not, so that limits are reached before
#: and after the interval equally often (benchmarks/life_trend.py --calibration).
SHAPES: Final = (
    Shape("none", 0.24),
    *(Shape("none", 0.1 / len(_WANDERING), wandering=w) for w in _WANDERING),
    Shape("stepwise", 0.1, steps_1_y=3.0, step=0.15),
    Shape("linear", 0.09),
    Shape("linear", 0.01, bending=_BENDING),
    *(Shape("linear", 0.02 / len(_WANDERING), wandering=w) for w in _WANDERING),
    *(Shape("exponential", 0.34 / len(_GROWING), k) for k in _GROWING),
    *(Shape("settling", 0.1 / len(_SETTLING), k) for k in _SETTLING),
)


@dataclass(frozen=True, slots=True)
class Priors:
    """Standard deviations of what is not known before, relative to the value.

    Attributes:
        margin: from where it began to the limit.
        temperature_1_K: of the effect of a kelvin, what is known of it taken out before.
        season: of each half of the yearly wave that the temperature does not tell.
    """

    margin: float
    temperature_1_K: float
    season: float

    @property
    def rate_1_y(self) -> float:
        """Of the present rate: a third of the way to the limit in a year, so that lives of one year to thirty are as
        they come."""
        return self.margin / 3.0

    def rate_of(self, shape: Shape) -> float:
        """The same of a shape: an exponential that has come to the limit has its growth times the margin."""
        return max(self.rate_1_y, shape.rate_1_y * self.margin)


@dataclass(frozen=True, slots=True)
class Columns:
    """All columns of a series, whatever the shape; `values` (n, p), `stds` (p,) are prior standard deviations.

    Attributes:
        common: those of every shape: level, season, temperature.
        by_shape: the further ones of each, in the order of `SHAPES`.
    """

    values: F64
    stds: F64
    common: tuple[int, ...]
    by_shape: tuple[tuple[int, ...], ...]


def path(shape: Shape, time_y: F64, now_y: float, log_rate: float | F64 = 0.0) -> F64:
    """A trend's column at times since the beginning, years: 0 at the beginning. Its rate is 1 now; of one that settles
    what it settles to is 1.

    Args:
        log_rate: of an exponential: how its rate's logarithm differs from the shape's.
    """
    k = shape.rate_1_y * np.exp(log_rate)
    if shape.kind == "linear":
        return time_y
    if shape.kind == "settling":
        return np.asarray(-np.expm1(k * time_y))
    return np.asarray((np.exp(k * (time_y - now_y)) - np.exp(-k * now_y)) / k)


def _in_between(shape: Shape, time_y: F64, now_y: float) -> F64:
    """How a trend's column changes with the logarithm of its rate."""
    h = 0.1
    return (path(shape, time_y, now_y, h) - path(shape, time_y, now_y, -h)) / (2.0 * h)


def knots(now_y: float) -> F64:
    """Where a trend may bend or wander, years since the beginning."""
    return np.arange(1, _KNOTS + 1) * now_y / (_KNOTS + 1)


def columns(time_d: F64, start_d: float, temperature_K: F64 | None, priors: Priors) -> Columns:
    """The columns of a series.

    Args:
        time_d: as in `Series`.
        start_d: where the trend began.
        temperature_K: above a reference, shape (n,); None: not known.
    """
    time_y = (time_d - start_d) / YEAR_D
    now_y = float(time_y[-1])
    year = 2.0 * np.pi * time_d / YEAR_D
    values, stds = [np.ones_like(time_d)], [1.0]
    for wave, std in ((1.0, priors.season), (2.0, _HALF_YEARLY * priors.season)):
        values += [np.cos(wave * year), np.sin(wave * year)]
        stds += [std, std]
    if temperature_K is not None:
        values.append(temperature_K)
        stds.append(priors.temperature_1_K)
    common = tuple(range(len(values)))
    at = knots(now_y)
    by_shape: list[tuple[int, ...]] = []
    for shape in SHAPES:
        first = len(values)
        if shape.kind not in ("none", "stepwise"):
            values.append(path(shape, time_y, now_y))
            stds.append(priors.margin if shape.kind == "settling" else priors.rate_of(shape))
        if shape.rate_1_y > 0:
            values.append(_in_between(shape, time_y, now_y))
            stds.append(priors.rate_of(shape) * BETWEEN)
        if shape.bending:
            values += [np.maximum(time_y - t, 0.0) for t in at]
            stds += [shape.bending * priors.rate_1_y * float(np.sqrt(at[0]))] * len(at)
        if shape.wandering:
            values += [1.0 * (time_y >= t) for t in at]
            stds += [shape.wandering * priors.margin * float(np.sqrt(at[0]))] * len(at)
        by_shape.append(tuple(range(first, len(values))))
    return Columns(np.column_stack(values), np.array(stds), common, tuple(by_shape))
