"""Numbers as they are read: a true minus sign, as many digits as they deserve, powers of ten written out."""

from __future__ import annotations

import math

NOTHING = "–"
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
#: Powers of ten that are written without an exponent.
_PLAIN = range(-3, 6)


def _exponent(size: float) -> int:
    """The power of ten of the first digit, 0 for zero."""
    return math.floor(math.log10(size)) if size > 0 else 0


def _fixed(value: float, decimals: int) -> str:
    text = f"{abs(value):.{max(0, decimals)}f}"
    return f"−{text}" if value < 0 and float(text) != 0 else text


def _power(exponent: int) -> str:
    return f"×10{str(exponent).translate(_SUPERSCRIPT)}"


def number_text(value: float | None, digits: int = 4) -> str:
    """A number with so many significant digits: "0.4937", "−12.30", "9.751×10⁻³⁰", "∞", "–" for what is not known.

    An int is written in full, and so is what stands before the point.
    """
    if value is None or math.isnan(value):
        return NOTHING
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    if isinstance(value, int):
        return f"{value:,}".replace(",", "\u202f").replace("-", "−")
    if value == 0:
        return "0"
    exponent = _exponent(float(f"{abs(value):.{digits - 1}e}"))  # of the rounded one: 9.9996 is 10.00
    if exponent in _PLAIN:
        return _fixed(value, digits - 1 - exponent)
    return _fixed(value / 10.0**exponent, digits - 1) + _power(exponent)


def fixed_text(value: float | None, decimals: int) -> str:
    """A number with so many decimals, "−0.042"; what is not finite as `number_text` says it."""
    return number_text(value) if value is None or not math.isfinite(value) else _fixed(value, decimals)


def measured_text(value: float | None, std: float | None, digits: int = 4) -> str:
    """Value ± std, std with two significant digits and the value with the same decimals; a common power of ten.

    "0.4937 ± 0.0012", "(9.751 ± 0.012)×10⁻³", "0.49 ± ∞" where nothing determines it.
    """
    if value is None or not math.isfinite(value) or std is None or math.isnan(std):
        return number_text(value, digits)
    if math.isinf(std):
        return f"{number_text(value, 2)} ± ∞"
    exponent = _exponent(max(abs(value), std))
    common = 0 if exponent in range(-2, 5) else exponent
    scale = 10.0**common
    spread = float(f"{std / scale:.1e}")
    decimals = min(12, 1 - _exponent(spread)) if spread > 0 else digits - 1
    text = f"{_fixed(value / scale, decimals)} ± {_fixed(spread, decimals)}"
    return text if common == 0 else f"({text}){_power(common)}"
