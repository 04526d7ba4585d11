"""What a diagnosis says in sentences; the text and the report use the same."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from servo_daemon.commands.diagnose.criterion import why

#: What an unmodelled torque or voltage follows, as a reader says it.
_FOLLOWS = {
    "speed": "the speed",
    "direction": "the direction of motion",
    "angle": "the angle",
    "travel": "the position along the travel",
    "current": "the current",
    "load": "the load",
    "time": "time",
    "step": "a step",
    "moments": "a few moments",
    "temperature": "the heat of the winding",
    "frequency": "a fixed frequency",
}
#: Of what is left.
_BY_ITSELF = (
    "What is left is far larger than steps of encoder and converters and coloured noise leave, but it follows neither "
    "speed, angle, current nor time: a load that moves by itself, behind play or on a spring, does that."
)
_COLOURED = (
    "What is left is not white, but it follows neither speed, angle, current nor time: steps of encoder and converters "
    "and coloured noise do that."
)


def model_name(effects: Sequence[str]) -> str:
    """'linear motor + coulomb_friction'."""
    return " + ".join(["linear motor", *effects])


def headline(document: Mapping[str, Any]) -> str:
    """The verdict in one sentence."""
    remaining, baseline = document["remaining"], "the " + model_name(document["baseline"]["model"])
    if document["verdict"] == "found":
        return "Found: " + ", ".join(e["name"].replace("_", " ") for e in document["effects"])
    if document["verdict"] == "unexplained":
        on = dict.fromkeys(_FOLLOWS.get(x["on"], x["on"]) for x in remaining["dependences"])
        follows = ", ".join(on) or "neither speed, angle, current nor time"
        return f"Unexplained: something is missing that has no name here; it follows {follows}"
    if not _anything_known(document):
        return "Nothing can be said: these data do not determine even one parameter of the motor"
    if remaining["white"]:
        return f"Nothing is missing: {baseline} explains these data to their noise"
    return f"Nothing is missing: no model here explains these data better than {baseline}"


def verdict_lines(document: Mapping[str, Any]) -> list[str]:
    """What supports the verdict, and what there was no time for."""
    return [*_supporting(document), *_unfinished(document["unfinished"])]


def _unfinished(what: Mapping[str, Any] | None) -> list[str]:
    if what is None:
        return []
    return [
        f"Not finished: {what['budget_s']:g} s of processor time were allowed, and nothing was left for "
        f"{', '.join(what['not_tried'])}. This is the best so far."
    ]


def _supporting(document: Mapping[str, Any]) -> list[str]:
    if document["verdict"] == "found":
        return [_gain_line(document), *why(document), *remaining_lines(document)]
    if document["verdict"] == "unexplained":
        return [
            "No effect of the library predicts the validation data significantly better.",
            *remaining_lines(document),
        ]
    return [*_unseen(document), *([] if document["remaining"]["white"] else [_COLOURED])]


def _anything_known(document: Mapping[str, Any]) -> bool:
    parameters = document["baseline"]["parameters"].values()
    return bool(document["combinations"]) or any(p["status"] in ("estimated", "fixed") for p in parameters)


def _unseen(document: Mapping[str, Any]) -> list[str]:
    """Where the motion is too poor for an absence to mean much."""
    open_ones = [n for n, p in document["baseline"]["parameters"].items() if p["status"] == "undetermined"]
    if not open_ones or document["combinations"]:
        return []
    return [
        f"These data do not determine {', '.join(open_ones)}: what the motion does not excite it cannot show to be "
        "missing. Record reversals and several speeds."
    ]


def _gain_line(document: Mapping[str, Any]) -> str:
    gain, baseline = document["gain"], "the " + model_name(document["baseline"]["model"])
    if gain is None or gain["error_removed"] is None:
        return f"The gain over {baseline} could not be measured: noise alone would leave as much error."
    unseen = gain["measured_on"] == "unseen"
    where = "held-out data" if unseen else "the validation data"
    short = "" if unseen else " These data are too short to hold a part out: record more."
    return (
        f"On {where} this removes {percent(gain['error_removed'])}{_interval(gain)} of the error of "
        f"{baseline} that is not noise.{short}"
    )


def _interval(gain: Mapping[str, Any]) -> str:
    """' (95 %: 91 % … 95 %)'; an open end has no number; nothing where both are open."""
    low, high = gain["ci95"] or (None, None)
    if low is not None and high is not None:
        return f" (95 %: {percent(low)} … {percent(high)})"
    if low is not None:
        return f" (95 %: at least {percent(low)})"
    return "" if high is None else f" (95 %: at most {percent(high)})"


def remaining_lines(document: Mapping[str, Any]) -> list[str]:
    """What is left, and what it follows."""
    remaining = document["remaining"]
    if remaining["white"]:
        return ["What is left is noise."]
    if not remaining["dependences"]:
        return [_unnamed(document) if document["verdict"] == "unexplained" else _COLOURED]
    return [dependence_line(x) for x in remaining["dependences"]]


def _unnamed(document: Mapping[str, Any]) -> str:
    """Of what is left and follows nothing: what fits it best, though it predicts no better."""
    from servo_daemon.diagnosis.search.evidence import OVERWHELMING_BIC

    tried = [c for c in document["candidates"] if c["delta_bic"] is not None]
    best = min(tried, key=lambda c: float(c["delta_bic"]), default=None)
    if best is None or best["delta_bic"] > OVERWHELMING_BIC:
        return _BY_ITSELF
    name, gain = best["name"].replace("_", " "), best["delta_bic"]
    return (
        f"What is left is not noise: {name} fits it far better (ΔBIC {gain:,.0f}), but predicts free runs that were "
        "not fitted no better. A motion that shows more of it would decide: `excite` plans one."
    )


def dependence_line(x: Mapping[str, Any]) -> str:
    """'Left: a torque of 0.0031 N·m rms (1.2 % of the working torque) that follows the angle, 14 times a turn.'"""
    detail = x["detail"]
    more = ""
    if "harmonic" in detail:
        more = f", {detail['harmonic']:g} times a turn"
    elif "frequency_hz" in detail:
        more = f", {detail['frequency_hz']:.4g} Hz"
    elif "time_s" in detail:
        more = f" at {detail['time_s']:.4g} s"
    share = "" if x["relative"] is None else f" ({percent(x['relative'])} of the working {x['series']})"
    return (
        f"Left: a {x['series']} of {x['size']:.3g} {x['unit']} rms{share} that follows "
        f"{_FOLLOWS.get(x['on'], x['on'])}{more}."
    )


def change_text(values: Sequence[float | None]) -> str:
    """'3.9 % higher in the last than in the first'; nothing where that is no ratio."""
    first, last = values[0], values[-1]
    if first is None or last is None or len(values) < 2 or first * last <= 0 or first == last:
        return ""
    change = last / first - 1.0
    return f"{percent(abs(change))} {'higher' if change > 0 else 'lower'} in the last than in the first"


def percent(share: float) -> str:
    """Two digits, and near 100 % as many as tell it from 100: '93 %', '0.42 %', '99.4 %', '99.97 %'."""
    value = 100.0 * share
    left = 100.0 - abs(value)
    if 0.005 <= left < 1.0:
        return f"{value:.{-math.floor(math.log10(left))}f} %"
    return f"{value:.0f} %" if abs(value) >= 10.0 else f"{float(f'{value:.2g}'):g} %"
