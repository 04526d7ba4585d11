"""LaTeX symbols of parameters as plain characters, for table cells and legends, which hold text only."""

from __future__ import annotations

import re

_LETTERS = {r"\omega": "ω", r"\varphi": "φ", r"\mu": "μ", r"\Delta": "Δ", r"\theta": "θ"}
_SUBSCRIPTS = str.maketrans("0123456789aehijklmnoprstuvx,", "₀₁₂₃₄₅₆₇₈₉ₐₑₕᵢⱼₖₗₘₙₒₚᵣₛₜᵤᵥₓ,")


def symbol_text(latex: str) -> str:
    r"""'T_c^-' as 'T_c⁻', '\omega_s' as 'ωₛ'; a subscript that has no characters of its own stays behind '_'."""
    text = re.sub(r"\\text\{(\w+)\}", r"\1", latex)
    for name, letter in _LETTERS.items():
        text = text.replace(name, letter)
    text = re.sub(r"_\{([^{}]*)\}|_(\w)", lambda m: _subscript(m[1] or m[2]), text)
    return text.replace("^-", "⁻").replace("{", "").replace("}", "").replace(" ", "")


def _subscript(text: str) -> str:
    lowered = text.translate(_SUBSCRIPTS)
    return lowered if not re.search(r"[A-Za-z]", lowered) else f"_{text}"
