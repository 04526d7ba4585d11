"""Bars with intervals as a real table of name, drawing and number: read, printed and narrow without any script.

The drawing is SVG with positions in percent, so that it follows the width of the page and its text does not scale.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from servo_daemon.report.blocks import CHOSEN_MARK, row_start, text_html
from servo_daemon.report.figures import Bar, Bars
from servo_daemon.report.numbers import fixed_text, number_text
from servo_daemon.report.plots import axis_text


@dataclass(frozen=True, slots=True)
class _Scale:
    low: float
    high: float
    step: float
    ticks: tuple[float, ...]

    def place(self, value: float) -> str:
        """Where a value stands, in percent of the width; at the edge where it is beyond."""
        part = (min(max(value, self.low), self.high) - self.low) / (self.high - self.low)
        return f"{100 * part:.2f}%"

    @property
    def decimals(self) -> int:
        """Those of a tick's step."""
        return -math.floor(math.log10(self.step) + 1e-9)

    def text(self, value: float) -> str:
        """A hundredth of a step is told apart; all numbers of a figure with the same decimals."""
        decimals = self.decimals + 2
        return fixed_text(value, max(0, decimals)) if -4 <= decimals <= 6 else number_text(value, 3)


def _make_scale(figure: Bars) -> _Scale:
    """From the smallest to the largest of origin, values and finite ends, with room on the sides that are used."""
    ends = [v for bar in figure.bars for v in (bar.value, bar.low, bar.high) if v is not None and math.isfinite(v)]
    low, high = min([figure.origin, *ends]), max([figure.origin, *ends])
    room = 0.06 * (high - low) or 1.0
    low, high = (low - room if low < figure.origin else low), (high + room if high >= figure.origin else high)
    rough = (high - low) / 3
    power = 10.0 ** math.floor(math.log10(rough))
    step = power * max(m for m in (1, 2, 5) if m * power <= rough * 1.0001)
    first = math.ceil(low / step - 1e-9)
    ticks = tuple(step * k for k in range(first, math.floor(high / step + 1e-9) + 1))
    return _Scale(low, high, step, ticks)


def _tick_texts(scale: _Scale) -> str:
    texts = []
    for tick in scale.ticks:
        part = (tick - scale.low) / (scale.high - scale.low)
        anchor = "start" if part < 0.04 else "end" if part > 0.96 else "middle"
        text = fixed_text(tick, scale.decimals) if abs(scale.decimals) <= 4 else number_text(tick, 2)
        texts.append(f'<text x="{scale.place(tick)}" y="13" text-anchor="{anchor}">{text}</text>')
    return "".join(texts)


def _drawing(bar: Bar, figure: Bars, scale: _Scale) -> str:
    place = scale.place
    parts = [f'<line class="grid" x1="{place(t)}" x2="{place(t)}" y1="0" y2="100%"/>' for t in scale.ticks]
    if math.isfinite(bar.value):
        left, right = sorted((figure.origin, bar.value))
        width = float(place(right)[:-1]) - float(place(left)[:-1])
        parts.append(f'<rect class="bar" x="{place(left)}" width="{width:.2f}%" y="5" height="14" rx="2"/>')
    if bar.low is not None or bar.high is not None:
        start, stop = _end(bar.low, scale.low), _end(bar.high, scale.high)
        parts.append(f'<line class="whisker" x1="{place(start)}" x2="{place(stop)}" y1="12" y2="12"/>')
        known = [v for v in (bar.low, bar.high) if v is not None and math.isfinite(v)]
        parts += [f'<line class="whisker" x1="{place(v)}" x2="{place(v)}" y1="8" y2="16"/>' for v in known]
    zero = place(figure.origin)
    parts.append(f'<line class="origin" x1="{zero}" x2="{zero}" y1="0" y2="100%"/>')
    return f'<svg aria-hidden="true" focusable="false">{"".join(parts)}</svg>'


def _end(value: float | None, edge: float) -> float:
    return value if value is not None and math.isfinite(value) else edge


def _number(bar: Bar, scale: _Scale) -> str:
    text = scale.text(bar.value)
    if bar.low is None and bar.high is None:
        return text
    low = -math.inf if bar.low is None else bar.low
    high = math.inf if bar.high is None else bar.high
    return f'{text} <span class="interval">{scale.text(low)} … {scale.text(high)}</span>'


def bars_html(figure: Bars) -> str:
    """`<figure>` with the table."""
    scale = _make_scale(figure)
    rows = []
    for bar in figure.bars:
        mark = CHOSEN_MARK if bar.chosen else ""
        note = f'<span class="note">{text_html(bar.note)}</span>' if bar.note else ""
        rows.append(
            f'{row_start(bar.chosen)}<th scope="row">{text_html(bar.name)}{mark}{note}</th>'
            f'<td class="drawing">{_drawing(bar, figure, scale)}</td><td class="number">{_number(bar, scale)}</td></tr>'
        )
    caption = f"<figcaption>{text_html(figure.caption)}</figcaption>" if figure.caption else ""
    return (
        f'<figure class="bars"><h3>{text_html(figure.title)}</h3>\n<table><thead><tr>'
        f'<th scope="col">{text_html(figure.heading)}</th>'
        f'<td class="drawing"><svg aria-hidden="true" focusable="false">{_tick_texts(scale)}</svg></td>'
        f'<th scope="col" class="number">{text_html(axis_text(figure.axis))}</th></tr></thead>\n'
        f"<tbody>{chr(10).join(rows)}</tbody></table>{caption}</figure>"
    )
