"""What keeps a parameter from being published: each gate alone, and the hysteresis of all of them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from servo_daemon.parameters import LINEAR
from servo_daemon.tracking.plan.parameter_masks import Mask, ParameterMasks
from servo_daemon.tracking.validity.gates import LOST, QUALIFIED, UNCONFIRMED, Evidence, Qualification

NAMES = tuple(p.name for p in LINEAR)
ALL = np.ones(5, dtype=bool)
MASKS = ParameterMasks(LINEAR, ALL, ~ALL, ALL, ALL, ALL, np.zeros(5))


def all_but(name: str) -> Mask:
    return np.array([n != name for n in NAMES])


def evidence(**changes: Any) -> Evidence:
    """All five parameters of the motor, known and confirmed."""
    return replace(Evidence(MASKS, np.full(5, 0.01), ALL, ALL), **changes)


def qualified(*ticks: Evidence) -> set[str]:
    q = Qualification(5)
    for e in ticks:
        q.update(e)
    return {n for n, yes in zip(NAMES, q.qualified.tolist(), strict=True) if yes}


WIDE = np.full(5, (QUALIFIED + LOST) / 2)


@pytest.mark.parametrize(
    ("changes", "left"),
    [
        ({}, set(NAMES)),
        ({"excited": all_but("B")}, set(NAMES) - {"B"}),
        ({"confirmed": all_but("J")}, set(NAMES) - {"J"}),
        ({"settled": False}, set()),
        ({"relative_std": np.where(all_but("J"), 0.01, 0.1)}, set(NAMES) - {"J"}),
        ({"relative_std": np.where(all_but("J"), 0.01, np.nan)}, set(NAMES) - {"J"}),
        ({"masks": replace(MASKS, claimable=all_but("L"))}, set(NAMES) - {"L"}),
        ({"masks": replace(MASKS, covered=all_but("B")), "white": False}, set(NAMES) - {"B"}),
        ({"lags_alike": True}, set()),
        # R goes with K where they lie on one line, L with R where a current shows their quotient alone.
        ({"confirmed": all_but("K"), "correlation": lambda k, j: -0.9}, set(NAMES) - {"K", "R"}),
        ({"confirmed": all_but("K"), "correlation": lambda k, j: 0.5}, set(NAMES) - {"K"}),
        ({"confirmed": all_but("R"), "few_samples": True}, set(NAMES) - {"R", "L"}),
    ],
)
def test_what_qualifies(changes: dict[str, Any], left: set[str]) -> None:
    assert qualified(evidence(**changes)) == left


@pytest.mark.parametrize(
    ("changes", "left"),
    [
        ({"relative_std": WIDE}, set(NAMES)),
        ({"relative_std": WIDE, "excited": ~ALL, "confirmed": ~ALL, "settled": False}, set(NAMES)),
        ({"relative_std": np.full(5, 1.1 * LOST)}, set()),
        # What the model lacks: only what a regression confirms stays, and no L of which the samples see nothing.
        ({"confirmed": all_but("B"), "explained": False}, set(NAMES) - {"B"}),
        ({"confirmed": all_but("B"), "explained": False, "fresh": False}, set(NAMES)),
        ({"relative_std": WIDE, "white": False, "settles": True}, set(NAMES) - {"L"}),
        ({"white": False, "settles": True}, set(NAMES)),  # known as well as at first it qualifies anew
    ],
)
def test_what_stays_qualified(changes: dict[str, Any], left: set[str]) -> None:
    assert qualified(evidence(), evidence(**changes)) == left


def test_the_reasons() -> None:
    q = Qualification(5)
    assert q.why_not("J") is None
    q.update(evidence(confirmed=all_but("J")))
    assert q.why_not("J") == UNCONFIRMED and q.why_not("R") is None
    q.update(evidence(confirmed=all_but("J"), lags_alike=True))
    assert q.why_not("J") == q.why_not("R") == "the lags of winding and drive are not identifiable separately"
    q.update(evidence(confirmed=all_but("K"), excited=all_but("B"), correlation=lambda k, j: 1.0))
    assert q.why_not("R") == "it is not identifiable without K, which is not known"
    assert q.why_not("B") == "the motion does not show it"
