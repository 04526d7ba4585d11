"""A figure as the page's script wants it: axes, series, arrays; and what a reader who does not see it is told."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from servo_daemon.report.decimate import keep_points, keep_rows
from servo_daemon.report.encode import encode
from servo_daemon.report.figures import Axis, Figure, Iterations, Line, Plot, Scatter
from servo_daemon.report.numbers import number_text
from servo_daemon.samples import F64

#: Rows of a figure: what a screen shows twenty times over, so that zooming in finds detail.
MAX_ROWS: Final = 20_000
_MIN_ROWS: Final = 4_000
#: Numbers in all figures of one report together, 5⅓ bytes each: about 2.7 MB.
_BUDGET: Final = 500_000
#: Colours of the style sheet; solid lines beyond take them again from the first, dashed.
COLOURS: Final = 6


@dataclass(frozen=True, slots=True)
class Entry:
    """One series in a figure's legend: its name, how it is drawn, its colour (1 to COLOURS), whether it has a band."""

    name: str
    style: str
    colour: int
    band: bool


@dataclass(frozen=True, slots=True)
class Drawing:
    """A figure ready to be written: the script's description, the legend, the words."""

    spec: dict[str, Any]
    legend: tuple[Entry, ...]
    alternative: str
    note: str


def _arrays(figure: Figure) -> int:
    if isinstance(figure, Scatter):
        return 2 * (len(figure.points) + len(figure.curves))
    return 1 + sum(1 if line.low is None else 3 for line in figure.lines)


def _length(figure: Figure) -> int:
    if isinstance(figure, Scatter):
        return max(p.x.size for p in (*figure.points, *figure.curves))
    return figure.x.size


def row_limit(figures: list[Figure]) -> int:
    """How many rows each figure of a report may keep so that the report stays small."""
    long = [_arrays(f) for f in figures if _length(f) > _MIN_ROWS]
    short = sum(_arrays(f) * _length(f) for f in figures if _length(f) <= _MIN_ROWS)
    share = (_BUDGET - short) // max(1, sum(long))
    return int(min(MAX_ROWS, max(_MIN_ROWS, share)))


def draw(figure: Figure, limit: int) -> Drawing:
    """The figure with at most `limit` rows (of each cloud: points)."""
    return _draw_scatter(figure, limit) if isinstance(figure, Scatter) else _draw_plot(figure, limit)


def _shown(values: F64, axis: Axis) -> F64:
    """NaN where the axis has no place for a value."""
    return np.where(np.isfinite(values) & ((values > 0) | (not axis.log)), values, np.nan)


def _draw_plot(figure: Plot, limit: int) -> Drawing:
    x, lines = _with_gaps(figure)
    columns = [c for line in lines for c in (line.y, line.low, line.high) if c is not None]
    gapped = [line.y for line in lines if line.style != "joined"]
    rows = keep_rows(columns, max(limit, 4 * len(columns)), gapped)
    series = []
    for k, line in enumerate(lines):
        entry: dict[str, Any] = {"name": line.name, "style": _style(line, k), "y": encode(line.y[rows])}
        if line.low is not None and line.high is not None:
            entry |= {"low": encode(line.low[rows]), "high": encode(line.high[rows])}
        series.append(entry)
    ends = (float(x[0]), float(x[-1]))
    spec = _spec(figure, ends) | {
        "kind": "iterations" if isinstance(figure, Iterations) else "lines",
        "group": figure.group,
        "x": encode(x[rows], ordered=True),
        "series": series,
    }
    legend = tuple(
        Entry(line.name, _style(line, k), 1 + k % COLOURS, line.low is not None) for k, line in enumerate(figure.lines)
    )
    ranges = [_range_text(line.name, line.y, figure.y_axis) for line in lines]
    return Drawing(spec, legend, figure.alternative or _alternative(figure, ends, ranges), _thinned(rows, x.shape[0]))


def _style(line: Line, k: int) -> str:
    """Of the k-th line of a figure."""
    return "dashed" if line.style == "solid" and k >= COLOURS else line.style


def _with_gaps(figure: Plot) -> tuple[F64, tuple[Line, ...]]:
    """x and lines as they are drawn: what the axes cannot show is NaN or left out, a row of NaN in every long step."""
    keep = _shown(figure.x, figure.x_axis) == figure.x
    x = figure.x[keep]
    holes = np.flatnonzero(np.diff(x) > figure.gap) + 1 if figure.gap is not None else np.empty(0, dtype=np.intp)
    if x.size == 0:
        raise ValueError(f"figure {figure.title!r}: a logarithmic axis shows none of its x")

    def cut(values: F64 | None) -> F64 | None:
        return None if values is None else np.insert(_shown(values[keep], figure.y_axis), holes, np.nan)

    lines = tuple(
        Line(line.name, np.insert(_shown(line.y[keep], figure.y_axis), holes, np.nan), cut(line.low), cut(line.high),
             line.style)
        for line in figure.lines
    )  # fmt: skip
    return np.insert(x, holes, 0.5 * (x[holes - 1] + x[holes])), lines


def _draw_scatter(figure: Scatter, limit: int) -> Drawing:
    series, notes, ranges, legend, xs = [], [], [], [], []
    for k, points in enumerate((*figure.points, *figure.curves)):
        cloud = k < len(figure.points)
        x, y = _shown(points.x, figure.x_axis), _shown(points.y, figure.y_axis)
        rows = keep_points(x, y, limit) if cloud else np.arange(x.shape[0])
        series.append(
            {"name": points.name, "style": "dots" if cloud else "solid", "x": encode(x[rows]), "y": encode(y[rows])}
        )
        legend.append(Entry(points.name, "dots" if cloud else "solid", 1 + k % COLOURS, band=False))
        notes.append(_thinned(rows, int(np.count_nonzero(np.isfinite(x) & np.isfinite(y)))) if cloud else "")
        ranges.append(_range_text(points.name, y, figure.y_axis))
        xs.append(x[np.isfinite(x)])
    known = np.concatenate(xs)
    ends = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    spec = _spec(figure, ends) | {"kind": "scatter", "group": "", "series": series}
    words = figure.alternative or _alternative(figure, ends, ranges)
    return Drawing(spec, tuple(legend), words, next((note for note in notes if note), ""))


def _spec(figure: Figure, ends: tuple[float, float]) -> dict[str, Any]:
    return {
        "ends": ends,
        "log": [figure.x_axis.log, figure.y_axis.log],
        "marks": [[m.at, m.label] for m in figure.marks if np.isfinite(m.at)],
        "levels": [[m.at, m.label] for m in figure.levels if np.isfinite(m.at)],
        "spans": [[s.start, s.stop, s.label] for s in figure.spans if np.isfinite([s.start, s.stop]).all()],
    }


def _thinned(rows: np.ndarray[Any, Any], n: int) -> str:
    if rows.size >= n:
        return ""
    return f"Drawn from {number_text(int(rows.size))} of {number_text(n)} points; every stretch keeps its extremes."


def _range_text(name: str, y: F64, axis: Axis) -> str:
    known = y[np.isfinite(y)]
    if known.size == 0:
        return f"{name}: no values"
    low, high = number_text(float(known.min())), number_text(float(known.max()))
    return f"{name}: {low} to {high} {axis.unit}".rstrip()


def _alternative(figure: Figure, ends: tuple[float, float], ranges: list[str]) -> str:
    span = f"{number_text(ends[0])} to {number_text(ends[1])} {figure.x_axis.unit}".rstrip()
    text = f"{figure.title}. {figure.y_axis.label} over {figure.x_axis.label} from {span}. {'; '.join(ranges)}."
    labels = [m.label for m in (*figure.marks, *figure.levels)] + [s.label for s in figure.spans]
    return f"{text} Marked: {', '.join(labels)}." if labels else text


def axis_text(axis: Axis) -> str:
    """Label and unit: "current / A"."""
    return f"{axis.label} / {axis.unit}" if axis.unit else axis.label
