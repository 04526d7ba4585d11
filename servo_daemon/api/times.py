"""Times as the API writes and reads them: UTC, ISO 8601 with Z, milliseconds."""

from __future__ import annotations

import math
import re
from datetime import UTC, datetime
from typing import Final

import numpy as np

from servo_daemon.config_texts import UNIT_S
from servo_daemon.numerics import milliseconds
from servo_daemon.samples import F64

_RELATIVE: Final = re.compile(r"-\s*(\d+(?:\.\d+)?)\s*(ms|s|min|h|d)")
_DURATION: Final = re.compile(r"(\d+(?:\.\d+)?)\s*(s|min|h|d|w|y)")
#: An offset whose plus sign was not percent-encoded arrives with a blank in its place.
_LOST_PLUS: Final = re.compile(r" (\d\d:?\d\d)$")
#: Years 1 to 9999, which is what datetime can hold.
_EPOCH_MIN_S, _EPOCH_MAX_S = -62_135_596_800.0, 253_402_300_799.0

ACCEPTED: Final = "an ISO 8601 time, seconds since 1970, 'now', or a time ago such as -10min (ms, s, min, h, d)"
DURATIONS: Final = "a number with its unit such as 30min or 1y (s, min, h, d, w, y)"


def iso_utc_list(epoch_s: F64) -> list[str]:
    """The same for an array of finite times, shape (n,)."""
    shown_ms = milliseconds(epoch_s).astype("datetime64[ms]")
    return [text + "Z" for text in np.datetime_as_string(shown_ms).tolist()]


def parse_duration(text: str) -> float:
    """Seconds, greater than 0, at most ten thousand years.

    Raises:
        ValueError: not of the form in `DURATIONS`.
    """
    match = _DURATION.fullmatch(text.strip())
    seconds = float(match[1]) * UNIT_S[match[2]] if match else 0.0
    if not 0.0 < seconds <= 10_000 * UNIT_S["y"]:
        raise ValueError(f"{text!r} is not {DURATIONS}")
    return seconds


def parse_time(text: str, now_s: float) -> float:
    """UTC seconds since the epoch for any of the forms in `ACCEPTED`; a time without an offset is UTC.

    Raises:
        ValueError: none of them.
    """
    text = text.strip()
    if text == "now":
        return now_s
    if match := _RELATIVE.fullmatch(text):
        return now_s - float(match[1]) * UNIT_S[match[2]]
    number = _number(text)
    if number is None:
        try:
            moment = datetime.fromisoformat(_LOST_PLUS.sub(r"+\1", text))
        except ValueError:
            raise ValueError(f"{text!r} is not {ACCEPTED}") from None
        return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
    if not _EPOCH_MIN_S <= number <= _EPOCH_MAX_S:
        raise ValueError(f"{text!r} is not a time between the years 1 and 9999")
    return number


def _number(text: str) -> float | None:
    """The text as seconds, None where it is no finite number. "-600" is refused: 600 of what, and since when?"""
    if re.fullmatch(r"\d{4}-?\d\d-?\d\d", text):  # 20261121 is a date in ISO's short form
        return None
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) and not text.startswith("-") else None
