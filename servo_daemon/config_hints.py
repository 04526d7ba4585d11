"""What helps where a configuration has a key that is not known: its line, and the key that was probably meant."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence
from typing import Any, get_args

from pydantic import BaseModel

#: Parameters as data sheets and papers call them. K_t and K_e are one K in SI units.
_SYMBOLS = {
    **dict.fromkeys(("kt", "km", "ke", "kb", "kv", "torque_constant"), "K"),
    **dict.fromkeys(("ra", "rm", "resistance"), "R"),
    **dict.fromkeys(("la", "lm", "inductance"), "L"),
    **dict.fromkeys(("jr", "inertia"), "J"),
    **dict.fromkeys(("dm", "damping", "friction", "viscous_friction"), "B"),
}
_TABLE = re.compile(r"\s*(\[\[?)\s*([\w.\-\"' ]+?)\s*\]\]?\s*(#.*)?")


def meant(key: str, known: Iterable[str]) -> str | None:
    """The known key that was probably meant; None: none is like it."""
    names = list(known)
    by_lower = {name.lower(): name for name in names}
    symbol = _SYMBOLS.get(key.lower().replace("_", "")) or _SYMBOLS.get(key.lower())
    if symbol in names:
        return symbol
    if key.lower() in by_lower:
        return by_lower[key.lower()]
    like = difflib.get_close_matches(key.lower(), by_lower, 1)
    return by_lower[like[0]] if like else None


def did_you_mean(key: str, known: Iterable[str]) -> str:
    """To follow a message: " (did you mean 'K'?)"; empty where nothing is like it."""
    name = meant(key, known)
    return "" if name is None else f" (did you mean '{name}'?)"


def keys_at(model: type[BaseModel], place: Sequence[str | int]) -> tuple[str, ...]:
    """Keys of the section that holds the last part of a place such as ("drive", 0, "limits", "R_maxx")."""
    for part in place[:-1]:
        field = model.model_fields.get(str(part))
        found = None if field is None else _section(field.annotation)
        model = model if found is None else found
    return tuple(model.model_fields)


def _section(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((found for part in get_args(annotation) if (found := _section(part)) is not None), None)


def line_of(text: str, place: Sequence[str | int]) -> int | None:
    """The line, from 1, of a key in TOML text, where its table has a header of its own; else None.

    Args:
        place: as in `keys_at`.
    """
    here: list[str | int] = []
    count: dict[str, int] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        header = _TABLE.fullmatch(line)
        if header is not None:
            names = [part.strip(" \"'") for part in header[2].split(".")]
            if header[1] == "[[":
                count[names[0]] = count.get(names[0], -1) + 1
            here = [names[0], *([count[names[0]]] if names[0] in count else []), *names[1:]]
            if list(place) in (here, names):
                return number
        elif here == list(place[:-1]) and re.match(rf"\s*[\"']?{re.escape(str(place[-1]))}[\"']?\s*[=.]", line):
            return number
    return None
