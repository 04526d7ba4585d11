"""Prometheus' text exposition format, version 0.0.4: families of samples in, text out. Knows nothing of servos.

https://prometheus.io/docs/instrumenting/exposition_formats/
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Final, Literal

CONTENT_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"

Kind = Literal["gauge", "counter"]
_NAME: Final = re.compile(r"[a-zA-Z_:][a-zA-Z0-9_:]*")


class Exposition:
    """Collects samples by family and renders them, each family once and whole, in the order of first mention."""

    def __init__(self) -> None:
        self._families: dict[str, tuple[Kind, str, list[str]]] = {}

    def add(self, name: str, kind: Kind, help_text: str, value: float | int | bool | None, **labels: str) -> None:
        """One sample. None, NaN and infinities are left out: an absent sample says "not known".

        Raises:
            ValueError: not a metric name, or a name that already stands for another kind.
        """
        if value is None or not math.isfinite(value):
            return
        if _NAME.fullmatch(name) is None:
            raise ValueError(f"{name!r} is not a metric name")
        family = self._families.setdefault(name, (kind, help_text, []))
        if family[0] != kind:
            raise ValueError(f"{name} is a {family[0]}, not a {kind}")
        family[2].append(f"{name}{_labels(labels)} {_number(value)}")

    def render(self) -> str:
        """The text, ending in a newline."""
        lines: list[str] = []
        for name, (kind, help_text, samples) in self._families.items():
            lines.append(f"# HELP {name} {_escape(help_text)}")
            lines.append(f"# TYPE {name} {kind}")
            lines += samples
        return "\n".join(lines) + "\n"


def _number(value: float | int | bool) -> str:
    return str(int(value)) if isinstance(value, bool | int) else repr(float(value))


def _escape(text: str) -> str:
    return text.replace("\\", "\\\\").replace("\n", "\\n")


def _escape_label(text: str) -> str:
    return _escape(text).replace('"', '\\"')


def _labels(labels: Mapping[str, str]) -> str:
    if not labels:
        return ""
    inside = ",".join(f'{key}="{_escape_label(value)}"' for key, value in labels.items())
    return "{" + inside + "}"


_UNIT_WORDS: Final = {
    "Ω": "ohm",
    "H": "henry",
    "N": "newton",
    "m": "meter",
    "A": "ampere",
    "V": "volt",
    "kg": "kilogram",
    "s": "second",
    "rad": "radian",
    "K": "kelvin",
    "J": "joule",
    "W": "watt",
    "Hz": "hertz",
    "°C": "celsius",
    "%": "percent",
}
_POWERS: Final = {"²": "square_", "³": "cubic_"}


def unit_words(unit: str | None) -> str:
    """An SI unit as part of a metric name: "N·m·s/rad" is "newton_meter_second_per_radian", "" is "".

    Raises nothing: what is not known is spelled with the letters that a metric name may have.
    """
    if not unit or unit == "1":
        return ""
    over, *under = ("_".join(_word(part) for part in side.split("·") if part != "1") for side in unit.split("/"))
    return "_per_".join([over, *under]).strip("_")


def _word(part: str) -> str:
    power = _POWERS.get(part[-1:], "")
    base = part[:-1] if power else part
    return power + _UNIT_WORDS.get(base, re.sub(r"[^a-zA-Z0-9]+", "_", base).strip("_"))
