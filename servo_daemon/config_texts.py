"""What a configuration writes as text with a unit: how fast parameters drift, limits relative to nominal values,
spans of time."""

from __future__ import annotations

import math
import re

NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_UNIT = r"s|min|h|d"
DRIFT = re.compile(rf"\s*({NUMBER})\s*%\s*/\s*(?:sqrt\s*)?(?:({_UNIT})|\(\s*({_UNIT})\s*\))\s*")
RELATIVE = re.compile(rf"\s*([+-]?{NUMBER})\s*%\s*")
SPAN = re.compile(rf"\s*({NUMBER})\s*([dwy])\s*")
#: Units of time as texts name them, s; a year is a Julian one.
UNIT_S = {"ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0, "w": 604_800.0, "y": 31_557_600.0}


def parse_drift(text: str) -> float:
    """'10 %/h' as the intensity of a random walk of log(parameter), in 1/√s: 1 σ after one hour is 10 %.

    Raises:
        ValueError: not of the form '10 %/h' (s, min, h, d; '%/sqrt(min)' means the same).
    """
    match = DRIFT.fullmatch(text)
    if match is None:
        raise ValueError(f"{text!r} is not a drift such as '10 %/h' (units s, min, h, d)")
    percent = float(match[1])
    if not math.isfinite(percent):
        raise ValueError(f"{text!r} is not finite")
    return percent / 100.0 / math.sqrt(UNIT_S[match[2] or match[3]])


def parse_days(text: str) -> float:
    """'180 d', '26 w' or '0.5 y' in days.

    Raises:
        ValueError: not of this form, or not positive.
    """
    match = SPAN.fullmatch(text)
    days = 0.0 if match is None else float(match[1]) * (UNIT_S[match[2]] / UNIT_S["d"])
    if not 0.0 < days < math.inf:
        raise ValueError(f"{text!r} is not a time such as '180 d' (units d, w, y)")
    return days


def is_limit(value: object) -> bool:
    """Whether an alarm can have this limit: a number in the parameter's unit, or "+30 %" of its nominal value."""
    if isinstance(value, str):
        return RELATIVE.fullmatch(value) is not None and math.isfinite(share(value))
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def share(text: str) -> float:
    """The share that "+30 %" is: 0.3."""
    match = RELATIVE.fullmatch(text)
    if match is None:
        raise ValueError(f"{text!r} is not a share such as '+30 %'")
    return float(match[1]) / 100.0
