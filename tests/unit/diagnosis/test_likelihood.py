"""When a richer model that free runs prefer is not needed; fits are stood in for, the decision is real."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from servo_daemon.diagnosis.trial.likelihood import Whole, far_likelier, needs_no_effect
from servo_daemon.diagnosis.trial.trial import Trial
from servo_daemon.identification.output_error import OutputErrorFit


def trial(effects: tuple[str, ...], nrmse: float) -> Trial:
    return cast(Trial, SimpleNamespace(effects=effects, values={}, choice=SimpleNamespace(nrmse=nrmse)))


def fit(deviance: float | None, free: int, white: bool = True, at_best: float | None = None) -> OutputErrorFit:
    best = deviance if at_best is None else at_best
    problem = SimpleNamespace(free=range(free), counts=np.array([20_000, 20_000]))
    return cast(OutputErrorFit, SimpleNamespace(white=white, deviance=deviance, deviance_at_best=best, problem=problem))


LINEAR, WITH_HEAT = trial((), 1.10), trial(("winding_heating",), 1.0)


def fits(simple: OutputErrorFit | None, rich: OutputErrorFit | None) -> tuple[Whole, list[tuple[str, ...]]]:
    asked: list[tuple[str, ...]] = []

    def whole(of: Trial, _values: Mapping[str, float]) -> OutputErrorFit | None:
        asked.append(of.effects)
        return rich if of.effects else simple

    return whole, asked


def test_white_without_and_as_likely_needs_no_effect() -> None:
    whole, asked = fits(fit(1_000.0, 5), fit(998.0, 7))
    assert needs_no_effect(LINEAR, WITH_HEAT, whole)
    assert asked == [(), ("winding_heating",)]


@pytest.mark.parametrize(
    ("simple", "rich"),
    [
        (fit(1_000.0, 5, white=False), fit(998.0, 7)),
        (None, fit(998.0, 7)),
        (fit(1_000.0, 5), fit(896.0, 7)),  # as hidden heat is worth: 2 parameters cost 21, and 30 beside
        (fit(1_000.0, 5), None),
        (fit(1_000.0, 5), fit(998.0, 7, white=False)),
    ],
)
def test_the_search_goes_on_where_the_effect_may_be_needed(
    simple: OutputErrorFit | None, rich: OutputErrorFit | None
) -> None:
    assert not needs_no_effect(LINEAR, WITH_HEAT, fits(simple, rich)[0])


def test_what_is_plainly_worse_without_costs_no_fit() -> None:
    whole, asked = fits(fit(1_000.0, 5), fit(998.0, 7))
    assert not needs_no_effect(trial((), 2.1), WITH_HEAT, whole)
    assert asked == []


@pytest.mark.parametrize(
    ("simple", "rich", "far"),
    [
        (fit(1_000.0, 5), fit(896.0, 7), True),
        (fit(1_000.0, 5), fit(998.0, 7), False),
        (
            fit(None, 5, at_best=1_000.0),
            fit(896.0, 7),
            True,
        ),  # did not settle, with all it may gain
        (fit(None, 5, at_best=998.0), fit(960.0, 7), False),
        (fit(None, 5), fit(896.0, 7), False),
        (fit(1_000.0, 5), fit(None, 7, at_best=0.0), False),  # what it may come to is no evidence for the richer one
    ],
)
def test_far_likelier_than_the_simpler_one_at_its_best(simple: OutputErrorFit, rich: OutputErrorFit, far: bool) -> None:
    assert far_likelier(rich, simple) is far
