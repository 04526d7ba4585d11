"""What a `diagnosis.json` leaves open: causes that its data could not tell apart, and the values it found."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from servo_daemon.commands.diagnose.document import SCHEMA
from servo_daemon.errors import BadInputError

#: At most so many causes are distinguished at once: each is fitted to each other.
_MOST = 4


@dataclass(frozen=True, slots=True)
class Tied:
    """An open question.

    Attributes:
        model: effects that are settled.
        between: causes that are not; empty: none were tied.
        values: parameters as the diagnosis has them, natural units.
        notes: for the user.
    """

    model: tuple[str, ...]
    between: tuple[str, ...]
    values: Mapping[str, float]
    notes: tuple[str, ...]


def read_tied(path: Path, configured: Sequence[str]) -> Tied:
    """From the document of `diagnose`.

    Raises:
        BadInputError: it cannot be read, or is no diagnosis.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise BadInputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        raise BadInputError(f"{path}: not a JSON document: {error}") from error
    try:
        return _tied(str(path), document, configured)
    except KeyError as error:
        raise BadInputError(f"{path}: not a diagnosis.json: it has no {error}") from error
    except (TypeError, AttributeError, IndexError, ValueError, OverflowError) as error:
        raise BadInputError(f"{path}: not a diagnosis.json: {error}") from error


def _tied(path: str, document: Mapping[str, Any], configured: Sequence[str]) -> Tied:
    if not isinstance(document, Mapping):
        raise TypeError(f"a {type(document).__name__} where an object should be")
    if document.get("schema") != SCHEMA:
        raise ValueError(f"schema {document.get('schema')}, this version reads {SCHEMA}")
    found = document["effects"]
    values = _values(document["baseline"]["parameters"])
    if document.get("extended"):
        values |= _values(document["extended"]["parameters"])
    names = [str(e["name"]) for e in found]
    model = (*(c for c in configured if c not in names), *names)
    for effect in found:
        # each entry is a list of names that together do as well; one name alone can take the effect's place
        others = [str(group[0]) for group in effect.get("equivalent", []) if len(group) == 1]
        if others:
            name = str(effect["name"])
            between = (name, *others)[:_MOST]
            rest = tuple(m for m in model if m != name)
            return Tied(rest, between, values, (f"{path}: {', '.join(between)} fit its data equally well",))
    note = f"{path}: no causes are tied there: the plan determines the parameters of its model"
    return Tied(model, (), values, (note,))


def _values(parameters: Mapping[str, Any]) -> dict[str, float]:
    return {str(k): float(p["value"]) for k, p in parameters.items() if isinstance(p["value"], int | float)}
