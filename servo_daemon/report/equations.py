"""LaTeX to MathML, which every current browser draws by itself.

latex2mathml translates; it passes some input through as markup (`\\text{<b>}`, `\\href`), so that its answer is taken
apart and only elements and attributes of mathematics are let through.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from html import escape
from typing import Final

_NAMESPACE: Final = "{http://www.w3.org/1998/Math/MathML}"
_ELEMENTS: Final = frozenset(
    {
        "math",
        "mrow",
        "mi",
        "mn",
        "mo",
        "mtext",
        "mspace",
        "mfrac",
        "msqrt",
        "mroot",
        "msub",
        "msup",
        "msubsup",
        "munder",
        "mover",
        "munderover",
        "mmultiscripts",
        "mprescripts",
        "mtable",
        "mtr",
        "mtd",
        "mstyle",
        "mpadded",
        "mphantom",
        "menclose",
    }
)
_ATTRIBUTES: Final = frozenset(
    {
        "display",
        "displaystyle",
        "scriptlevel",
        "mathvariant",
        "stretchy",
        "fence",
        "form",
        "separator",
        "movablelimits",
        "accent",
        "accentunder",
        "largeop",
        "symmetric",
        "lspace",
        "rspace",
        "minsize",
        "maxsize",
        "width",
        "height",
        "depth",
        "linethickness",
        "columnalign",
        "rowalign",
        "columnspacing",
        "rowspacing",
        "columnlines",
        "rowlines",
        "notation",
    }
)


def _write(element: ET.Element, attributes: str = "") -> str:
    name = element.tag.removeprefix(_NAMESPACE)
    text = element.text or ""
    if name not in _ELEMENTS or text.startswith("\\"):
        raise ValueError(f"<{name}>{text} is not mathematics")
    for key, value in element.attrib.items():
        if key in _ATTRIBUTES:
            attributes += f' {key}="{escape(value)}"'
    inside = "".join(_write(child) + escape(child.tail or "", quote=False) for child in element)
    return f"<{name}{attributes}>{escape(text, quote=False)}{inside}</{name}>"


def equation_html(latex: str) -> str:
    """`<math>` with the source as its `alttext`; `<code>` with the source where it cannot be translated."""
    from latex2mathml.converter import convert

    source = escape(latex)
    try:
        return _write(ET.fromstring(convert(latex, display="block")), f' alttext="{source}"')
    except Exception:  # its dozen errors have no common base, and some input meets an IndexError inside it
        return f"<code>{source}</code>"
