"""The HTML of everything that needs no script: texts, verdicts, equations, tables, bars."""

from __future__ import annotations

import re
from html import escape
from typing import Final

from servo_daemon.report.document import Cell, Code, Column, Equation, Items, Measured, Table, Text, Tone, Verdict
from servo_daemon.report.equations import equation_html
from servo_daemon.report.numbers import fixed_text, measured_text, number_text

_TONES: Final[dict[Tone, str]] = {"good": "Good", "warn": "Attention", "bad": "Problem", "neutral": "Result"}
#: Characters that HTML forbids even as references.
_FORBIDDEN: Final = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff\ufffe\uffff]")

CHOSEN_MARK: Final = ' <span class="chosen-mark" role="img" aria-label="chosen">◀</span>'


def row_start(chosen: bool) -> str:
    """The tag that opens a row of a table."""
    return '<tr class="chosen">' if chosen else "<tr>"


def text_html(text: str) -> str:
    """Any string as it may stand in an element or an attribute; what HTML cannot hold becomes U+FFFD."""
    return escape(_FORBIDDEN.sub("\ufffd", text))


def paragraphs_html(block: Text) -> str:
    """`<p>` for each paragraph."""
    parts = [part.strip() for part in re.split(r"\n\s*\n", block.text)]
    return "\n".join(f"<p>{text_html(part)}</p>" for part in parts if part)


def items_html(block: Items) -> str:
    """The list as `<ul>` or `<ol>`."""
    kind = "ol" if block.ordered else "ul"
    return f"<{kind}>{''.join(f'<li>{text_html(item)}</li>' for item in block.items)}</{kind}>"


def code_html(block: Code) -> str:
    """A box that scrolls by itself, with the keyboard too."""
    caption = f"<figcaption>{text_html(block.caption)}</figcaption>" if block.caption else ""
    label = text_html(block.caption or "text to copy")
    body = text_html(block.text.strip("\n"))
    return f'<figure class="code">{caption}<pre tabindex="0" role="region" aria-label="{label}">{body}</pre></figure>'


def verdict_html(block: Verdict) -> str:
    """The box, its tone in words for those who do not see its colour."""
    lines = "".join(f"<p>{text_html(line)}</p>" for line in block.lines)
    word = f'<span class="tone">{_TONES[block.tone]}</span>'
    return f'<div class="verdict {block.tone}">{word}<p class="headline">{text_html(block.headline)}</p>{lines}</div>'


def equation_block_html(block: Equation) -> str:
    """The equation, in a box that scrolls where it is wider than the page."""
    note = f'<p class="note">{text_html(block.note)}</p>' if block.note else ""
    return f'<div class="equation"><div class="scroll" tabindex="0">{equation_html(block.latex)}</div>{note}</div>'


def _cell_text(cell: Cell, column: Column) -> str:
    if isinstance(cell, str):
        return cell
    if isinstance(cell, Measured):
        return measured_text(cell.value, cell.std, column.digits)
    return number_text(cell, column.digits) if column.decimals is None else fixed_text(cell, column.decimals)


def table_html(table: Table) -> str:
    """A real table: heading cells with scopes, units under the headings, numbers to the right."""
    kinds = [' class="text"' if column.text else "" for column in table.columns]
    head = "".join(
        f'<th scope="col"{kind}>{text_html(column.heading)}'
        + (f' <span class="unit">{text_html(column.unit)}</span>' if column.unit else "")
        + "</th>"
        for column, kind in zip(table.columns, kinds, strict=True)
    )
    rows = []
    for k, row in enumerate(table.rows):
        texts = [text_html(_cell_text(cell, column)) for cell, column in zip(row, table.columns, strict=True)]
        mark = CHOSEN_MARK if k in table.chosen else ""
        first = f'<th scope="row"{kinds[0]}>{texts[0]}{mark}</th>'
        rest = "".join(f"<td{kind}>{text}</td>" for text, kind in zip(texts[1:], kinds[1:], strict=True))
        rows.append(f"{row_start(k in table.chosen)}{first}{rest}</tr>")
    caption = text_html(table.caption)
    note = f'<p class="note">{text_html(table.note)}</p>' if table.note else ""
    return (
        f'<div class="table"><div class="scroll" role="region" aria-label="{caption}" tabindex="0">'
        f"<table><caption>{caption}</caption><thead><tr>{head}</tr></thead>\n<tbody>{chr(10).join(rows)}</tbody></table>"
        f"</div>{note}</div>"
    )
