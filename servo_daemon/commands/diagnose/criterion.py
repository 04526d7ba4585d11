"""What text and report of `diagnose` say of the criterion that decided, where that is not the free run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: Why, in one sentence, by `judged_by`.
WHY = {
    "balance": "Judged by the current (or torque) that the measured motion needs: free runs say nothing of a "
    "motor that its controller holds where it would not stay by itself.",
    "predictions": "Judged by predictions of each sample from those before it: in a free run the process "
    "noise adds up to more than this effect makes.",
}
_ERROR_OF = {
    "free_runs": "Error of short free runs",
    "balance": "Error of the effort that the motion needs",
    "predictions": "Error of the predictions of the next sample",
}
#: On which data, by `measured_on`.
_TIMES = {"unseen": "held out from fit and choice", "choosing": "used for the choice, but not for the fit"}


def by_balance(document: Mapping[str, Any]) -> bool:
    """Whether the shaft's balance decided."""
    return bool(document["judged_by"] == "balance")


def by_predictions(document: Mapping[str, Any]) -> bool:
    """Whether predictions of the next sample decided."""
    return bool(document["judged_by"] == "predictions")


def why(document: Mapping[str, Any]) -> list[str]:
    """Why free runs did not decide; nothing where they did."""
    text, gain = WHY.get(document["judged_by"]), document["deviance_gain"]
    if text is None:
        return []
    return [text if gain is None else f"{text} Twice the logarithm of the likelihoods' ratio is {gain:.0f}."]


def error_heading(document: Mapping[str, Any]) -> str:
    """What the held-out errors are of."""
    return f"{_ERROR_OF[document['judged_by']]}, on data {_TIMES[document['measured_on']]}"


def measured_data(document: Mapping[str, Any]) -> str:
    """What the errors and the gain are measured on."""
    return "held-out data" if document["measured_on"] == "unseen" else "the data that decided"
