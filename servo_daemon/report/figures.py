"""What a figure shows: numbers and words only; nothing here knows how it is drawn.

Arrays may hold NaN: a gap in a line, a point that is not drawn. All figures of one `group` have the same quantity on
their x axis and zoom together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from servo_daemon.samples import F64

#: "steps" holds a value until the next (a zero-order hold, a quantised angle); "joined" runs across NaN (a channel
#: that has a value at every tenth row only); "dots" are points without a line.
LineStyle = Literal["solid", "dashed", "steps", "joined", "dots"]


@dataclass(frozen=True, slots=True)
class Axis:
    """What an axis shows and in which unit ("" for none). `log` leaves out what is not positive."""

    label: str
    unit: str = ""
    log: bool = False


TIME = Axis("time", "s")
FREQUENCY = Axis("frequency", "Hz", log=True)
ITERATION = Axis("iteration")


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """One curve over the figure's x, shape (n,); `low` and `high`, shape (n,), are its band (95 %, say)."""

    name: str
    y: F64
    low: F64 | None = None
    high: F64 | None = None
    style: LineStyle = "solid"


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """A cloud of points or, in `Scatter.curves`, a curve: x and y, both of shape (n,)."""

    name: str
    x: F64
    y: F64

    def __post_init__(self) -> None:
        _check_shapes(self.name, self.x, self.y)


@dataclass(frozen=True, slots=True)
class Mark:
    """A labelled straight line across the figure, at a value of one axis."""

    at: float
    label: str


@dataclass(frozen=True, slots=True)
class Span:
    """A labelled part of the x axis (what was held out, where the motor stood still)."""

    start: float
    stop: float
    label: str


@dataclass(frozen=True, slots=True, eq=False)
class Plot:
    """Lines over a common x, shape (n,), strictly increasing. The base of the figures with lines.

    Attributes:
        title: what it is, in a few words.
        caption: what is to be seen in it.
        marks, levels: vertical and horizontal lines with labels.
        spans: shaded parts of the x axis.
        group: figures with the same name (not "") zoom together.
        gap: in units of x; a longer step from one x to the next is drawn as a gap.
        alternative: what a reader who does not see the figure is told; made from names and ranges if empty.

    Raises:
        ValueError: arrays of different shapes, no line, or an x that does not increase.
    """

    title: str
    x: F64
    lines: tuple[Line, ...]
    y_axis: Axis
    caption: str = ""
    x_axis: Axis = TIME
    marks: tuple[Mark, ...] = ()
    levels: tuple[Mark, ...] = ()
    spans: tuple[Span, ...] = ()
    group: str = ""
    gap: float | None = None
    alternative: str = ""

    def __post_init__(self) -> None:
        if not self.lines:
            raise ValueError(f"figure {self.title!r} has no line")
        for line in self.lines:
            if (line.low is None) != (line.high is None):
                raise ValueError(f"{line.name!r}: a band needs both its edges")
            for y in (line.y, line.low, line.high):
                if y is not None:
                    _check_shapes(line.name, self.x, y)
        if not np.all(np.isfinite(self.x)) or np.any(np.diff(self.x) <= 0):
            raise ValueError(f"figure {self.title!r}: x is not finite and strictly increasing")


@dataclass(frozen=True, slots=True, eq=False)
class TimeSeries(Plot):
    """Signals over time; figures over time zoom together unless told otherwise."""

    group: str = "time"


@dataclass(frozen=True, slots=True, eq=False)
class Spectrum(Plot):
    """Amplitude or density over frequency, both axes logarithmic unless `x_axis` and `y_axis` say otherwise."""

    x_axis: Axis = FREQUENCY
    group: str = "frequency"


@dataclass(frozen=True, slots=True, eq=False)
class Iterations(Plot):
    """What changes from one iteration to the next, each drawn with a dot. `y_axis.log` for a cost."""

    x_axis: Axis = ITERATION
    group: str = "iteration"


@dataclass(frozen=True, slots=True, eq=False)
class Scatter:
    """Clouds of points and the curves fitted to them.

    Raises:
        ValueError: nothing to draw.
    """

    title: str
    points: tuple[Points, ...]
    x_axis: Axis
    y_axis: Axis
    curves: tuple[Points, ...] = ()
    caption: str = ""
    marks: tuple[Mark, ...] = ()
    levels: tuple[Mark, ...] = ()
    spans: tuple[Span, ...] = ()
    alternative: str = ""

    def __post_init__(self) -> None:
        if not self.points and not self.curves:
            raise ValueError(f"figure {self.title!r} has nothing to draw")


Figure: TypeAlias = TimeSeries | Spectrum | Iterations | Plot | Scatter


@dataclass(frozen=True, slots=True)
class Bar:
    """A value with its interval; `low` or `high` infinite or None: no such end is known. `chosen` stands out."""

    name: str
    value: float
    low: float | None = None
    high: float | None = None
    note: str = ""
    chosen: bool = False


@dataclass(frozen=True, slots=True)
class Bars:
    """Horizontal bars with intervals, in the order given, from `origin`; `heading` says what the names are.

    Raises:
        ValueError: no bar.
    """

    title: str
    bars: tuple[Bar, ...]
    axis: Axis
    caption: str = ""
    heading: str = "candidate"
    origin: float = 0.0

    def __post_init__(self) -> None:
        if not self.bars:
            raise ValueError(f"figure {self.title!r} has no bar")


def _check_shapes(name: str, x: F64, y: F64) -> None:
    if x.ndim != 1 or y.shape != x.shape or x.shape[0] == 0:
        raise ValueError(f"{name!r}: y has shape {y.shape}, x has {x.shape}; both are (n,), n >= 1")
