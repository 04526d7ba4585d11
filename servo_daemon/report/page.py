"""The whole document as one HTML file: style, script and data inside, nothing fetched, nothing of strangers run.

The file says so itself in a Content-Security-Policy that admits only its own style and script, by their hashes. A
server that sends a policy of its own must admit them too: `CONTENT_SECURITY_POLICY` is that header's value.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC
from functools import cache
from importlib.resources import files
from typing import Any, Final

from servo_daemon.report.bars import bars_html
from servo_daemon.report.blocks import (
    code_html,
    equation_block_html,
    items_html,
    paragraphs_html,
    table_html,
    text_html,
    verdict_html,
)
from servo_daemon.report.document import Block, Code, Equation, Items, Provenance, Report, Section, Table, Text, Verdict
from servo_daemon.report.figures import Bars, Figure
from servo_daemon.report.plots import Drawing, Entry, axis_text, draw, row_limit

#: In the order in which they are run, in one scope.
_SCRIPTS: Final = ("decode.js", "format.js", "overlay.js", "figure.js", "zoom.js", "main.js")
_BUTTONS: Final = (
    ("in", "+", "zoom in"),
    ("out", "−", "zoom out"),
    ("left", "◂", "move left"),
    ("right", "▸", "move right"),
    ("whole", "whole", "show the whole range"),
)


@dataclass(frozen=True, slots=True)
class _Program:
    style: str
    script: str


@cache
def _program() -> _Program:
    """What every report carries: uPlot (the dashboard's copy, with its licence) and our own script and style."""
    vendor = files("servo_daemon") / "api" / "dashboard" / "vendor"
    own = files("servo_daemon.report") / "assets"
    licence = (vendor / "uPlot.LICENSE").read_text(encoding="utf-8")
    parts = "\n".join((own / name).read_text(encoding="utf-8") for name in _SCRIPTS)
    uplot = (vendor / "uPlot.iife.min.js").read_text(encoding="utf-8")
    script = f'/*\n{licence}*/\n{uplot}\n(() => {{\n"use strict";\n{parts}}})();\n'
    style = (vendor / "uPlot.min.css").read_text(encoding="utf-8") + (own / "report.css").read_text(encoding="utf-8")
    return _Program(style, script)


def _policy() -> str:
    program = _program()
    style, script = (
        base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in (program.style, program.script)
    )
    return (
        f"default-src 'none'; script-src 'sha256-{script}'; style-src 'sha256-{style}'; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )


def content_security_policy() -> str:
    """The header's value for an answer that is a report of this version of the program."""
    return f"{_policy()}; frame-ancestors 'none'"


class _Drawings:
    """The figures of one report, in their order, and the data they need."""

    def __init__(self, report: Report) -> None:
        blocks = [block for section in report.sections for block in section.blocks]
        self._limit = row_limit([block for block in blocks if isinstance(block, Figure)])
        self.specs: list[dict[str, Any]] = []

    def html(self, figure: Figure) -> str:
        drawing = draw(figure, self._limit)
        self.specs.append(drawing.spec)
        return _figure_html(figure, drawing, f"f{len(self.specs)}")


def _figure_html(figure: Figure, drawing: Drawing, name: str) -> str:
    title = text_html(figure.title)
    buttons = "".join(
        f'<button type="button" data-zoom="{action}" aria-label="{title}: {label}" title="{label}">{sign}</button>'
        for action, sign, label in _BUTTONS
    )
    caption = f"<figcaption>{text_html(figure.caption)}</figcaption>" if figure.caption else ""
    note = f'<p class="note">{text_html(drawing.note)}</p>' if drawing.note else ""
    return (
        f'<figure class="plot" id="{name}"><h3>{title}</h3>\n'
        f'<div class="above"><ul class="legend">{"".join(map(_legend_html, drawing.legend))}</ul>'
        f'<div class="buttons" role="group" aria-label="Zoom">{buttons}</div></div>\n'
        f'<p class="y-label">{text_html(axis_text(figure.y_axis))}</p>'
        f'<div class="canvas" role="img" tabindex="0" aria-label="{text_html(drawing.alternative)}"></div>'
        f'<p class="x-label">{text_html(axis_text(figure.x_axis))}<output aria-live="off"></output></p>\n'
        f"{caption}{note}</figure>"
    )


def _legend_html(entry: Entry) -> str:
    band = f'<i class="key band c{entry.colour}"></i>' if entry.band else ""
    return (
        f'<li><button type="button" aria-pressed="true"><i class="key {entry.style} c{entry.colour}"></i>{band}'
        f"{text_html(entry.name)}<output></output></button></li>"
    )


#: Blocks that need no drawing.
_PLAIN: Final[dict[type, Callable[[Any], str]]] = {
    Text: paragraphs_html,
    Items: items_html,
    Code: code_html,
    Verdict: verdict_html,
    Equation: equation_block_html,
    Table: table_html,
    Bars: bars_html,
}


def _block_html(block: Block, drawings: _Drawings) -> str:
    return drawings.html(block) if isinstance(block, Figure) else _PLAIN[type(block)](block)


def _section_html(number: int, section: Section, drawings: _Drawings) -> str:
    body = "\n".join(_block_html(block, drawings) for block in section.blocks)
    return f'<section id="s{number}"><h2>{text_html(section.heading)}</h2>\n{body}\n</section>'


def _contents_html(report: Report) -> str:
    if len(report.sections) < 3:
        return ""
    links = (f'<li><a href="#s{k}">{text_html(s.heading)}</a></li>' for k, s in enumerate(report.sections, start=1))
    return f'<nav aria-label="Contents"><ol>{"".join(links)}</ol></nav>'


def _provenance_html(provenance: Provenance) -> str:
    made = provenance.made.astimezone(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    files_html = "".join(
        f"<li>{text_html(c.name)} <code>{text_html(c.sha256)}</code></li>" for c in provenance.captures
    )
    captures = f"<dt>Captures, SHA-256</dt><dd><ul>{files_html}</ul></dd>" if files_html else ""
    return (
        f'<footer><h2>How this was made</h2><dl><dt>Command</dt><dd><code class="command">'
        f"{text_html(provenance.command)}</code></dd><dt>Program</dt><dd>servo-daemon {text_html(provenance.version)}"
        f"</dd><dt>Made</dt><dd>{made}</dd>{captures}</dl></footer>"
    )


def _data_text(specs: list[dict[str, Any]]) -> str:
    """JSON that no HTML parser can mistake for markup."""
    text = json.dumps({"figures": specs}, allow_nan=False, ensure_ascii=True, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def render_report(report: Report) -> str:
    """The document. Equal reports give equal text.

    Raises:
        ValueError: a logarithmic axis shows none of a figure's x.
    """
    drawings = _Drawings(report)
    sections = "\n".join(_section_html(k, s, drawings) for k, s in enumerate(report.sections, start=1))
    subtitle = f"<p>{text_html(report.subtitle)}</p>" if report.subtitle else ""
    program = _program()
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{_policy()}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="generator" content="servo-daemon {text_html(report.provenance.version)}">
<meta name="color-scheme" content="light dark">
<title>{text_html(report.title)}</title>
<link rel="icon" href="data:,">
<style>{program.style}</style>
</head>
<body>
<header><h1>{text_html(report.title)}</h1>{subtitle}</header>
{_contents_html(report)}
<noscript><p class="note">The figures need JavaScript; texts and tables do not.</p></noscript>
<main>
{sections}
</main>
{_provenance_html(report.provenance)}
<script type="application/json" id="data">{_data_text(drawings.specs)}</script>
<script>{program.script}</script>
</body>
</html>
"""
