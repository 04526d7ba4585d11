"""What text and report of `diagnose` say where the shaft's balance was the judge, and no free run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: Why, in one sentence.
WHY = (
    "Judged by the current (or torque) that the measured motion needs: in a free run nothing can be told of a motor "
    "that its controller holds where it would not stay by itself."
)


def by_balance(document: Mapping[str, Any]) -> bool:
    """Whether this document was judged so."""
    return bool(document["judged_by"] == "balance")


def error_heading(document: Mapping[str, Any]) -> str:
    """What the held-out errors are of."""
    if by_balance(document):
        return "Error of the effort that the motion needs, on times that neither fit nor choice has seen"
    return "Error of short free runs that neither fit nor choice has seen"
