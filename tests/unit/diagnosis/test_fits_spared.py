"""Fits of a search that nothing can come of, and runs that need not be made again."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest

from servo_daemon.diagnosis.search import select
from servo_daemon.diagnosis.search.fitting import is_smooth
from servo_daemon.diagnosis.trial import full_data_fit
from servo_daemon.diagnosis.trial.data import Data, begun
from servo_daemon.diagnosis.trial.trial import FIRST_ITERATIONS, MOST_SAMPLES, Trial, fit_trial
from servo_daemon.diagnosis.verdict import adequacy
from servo_daemon.identification.output_error import OutputErrorFit, Recording
from servo_daemon.plant.build import build_plant
from tests.unit.identification.test_output_error import FULL, MOTOR, block_of, linear_recording

START = {**MOTOR, "J": 3.0 * MOTOR["J"]}


@pytest.fixture(scope="module")
def data() -> Data:
    return Data.of([Recording("a", block_of(linear_recording(5.0, noise=1e-3), *FULL))], {}, (), 0.5)


@pytest.mark.parametrize(
    ("effects", "smooth"),
    [
        (("winding_heating", "constant_load_torque", "measurement_delay"), True),
        (("coulomb_friction",), False),
        (("brush_voltage_drop",), False),
        (("gravity_load", "winding_heating"), False),
        (("shaft_compliance",), False),
        (("freewheel_drive",), False),
    ],
)
def test_what_sticks_blocks_swings_or_tips_over_makes_edges(effects: tuple[str, ...], smooth: bool) -> None:
    problem = SimpleNamespace(plant=build_plant(effects, "voltage"))
    assert is_smooth(cast(Trial, SimpleNamespace(effects=effects, problem=problem))) is smooth


def test_a_fit_that_stays_worse_than_its_rival_is_given_up(data: Data) -> None:
    best = fit_trial(data, (), MOTOR)
    assert best is not None
    point = replace(best.solution.point, value=-math.inf)
    out_of_reach = replace(best, solution=replace(best.solution, point=point))
    start = {**MOTOR, "J": 300.0 * MOTOR["J"], "K": 30.0 * MOTOR["K"]}
    free, given_up = (fit_trial(data, (), start, rival=rival) for rival in (None, out_of_reach))
    assert free is not None
    assert given_up is not None
    assert len(free.solution.iterations) > FIRST_ITERATIONS + 1
    assert len(given_up.solution.iterations) == FIRST_ITERATIONS + 1


def test_a_fit_that_overtakes_its_rival_goes_on(data: Data) -> None:
    rival = fit_trial(data, (), START, max_iterations=0)
    fits = [fit_trial(data, (), START, rival=r) for r in (None, rival)]
    assert fits[0] is not None
    assert fits[1] is not None
    assert fits[0].values == fits[1].values


def test_what_is_not_white_over_the_first_samples_is_not_fitted_to_all(
    data: Data, monkeypatch: pytest.MonkeyPatch
) -> None:
    block = block_of(linear_recording(1.2 * MOST_SAMPLES / 1000.0, noise=1e-3), *FULL)
    asked: list[int] = []

    def whole(of: Data, _trial: Trial, _values: Mapping[str, float], _below: float) -> OutputErrorFit:
        asked.append(len(of.recordings[0].block))
        return cast(OutputErrorFit, SimpleNamespace(white=white))

    monkeypatch.setattr(full_data_fit, "fit_whole", whole)
    trial = Trial((), {"R": 1.0}, {}, *cast(Any, (None, None, None, None)))
    white = False
    fits = full_data_fit.FullDataFits(replace(data, recordings=(Recording("a", block),)))
    assert fits.white(trial, {"R": 2.0}) is None
    assert asked == [MOST_SAMPLES, MOST_SAMPLES]  # from either start
    asked.clear()
    white = True
    fits = full_data_fit.FullDataFits(replace(data, recordings=(Recording("a", block),)))
    assert fits.white(trial, None) is not None
    assert asked == [MOST_SAMPLES, len(block)]
    assert fits.white(trial, None) is not None
    assert asked == [MOST_SAMPLES, len(block)]


def test_few_samples_are_all_the_first_ones() -> None:
    recordings = (Recording("a", block_of(linear_recording(0.5, noise=1e-3), *FULL)),)
    assert begun(recordings, MOST_SAMPLES) is recordings


def test_what_was_not_white_where_it_was_decided_is_fitted_in_free_runs_to_all(
    data: Data, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[bool] = []

    def fitted(_data: Data, _trial: Trial, full_fits: object, _start: object) -> OutputErrorFit:
        asked.append(full_fits is not None)
        raise LookupError

    monkeypatch.setattr(adequacy, "fit_full_data", fitted)
    selection: Any = SimpleNamespace(data=data, chosen=SimpleNamespace(effects=()), rounds=())
    for white in (True, False):
        with pytest.raises(LookupError):
            adequacy._published(selection, cast(Any, (SimpleNamespace(white=white), None)), cast(Any, None))
    assert asked == [True, False]


@pytest.mark.parametrize("noise_is_left", [True, False])
def test_everything_is_tried_unless_the_data_say_that_noise_is_left(
    monkeypatch: pytest.MonkeyPatch, noise_is_left: bool
) -> None:
    for name in ("late_without_current", "open_at_zero"):
        monkeypatch.setattr(select, name, lambda _: ())
    little = SimpleNamespace(name="resistance_step")
    monkeypatch.setattr(select, "_whatever", lambda *_, worth: (little,))
    search = _searched(current=True, noise_is_left=noise_is_left)
    assert select._thought_little_of(search, (), cast(Any, None), ()) == ([] if noise_is_left else [little])


@pytest.mark.parametrize(
    ("current", "added", "beyond", "worth"),
    [
        (False, (), True, -math.inf),
        (False, (), False, 0.0),
        (False, ("coulomb_friction",), True, 0.0),
        (True, (), True, 0.0),
    ],
)
def test_what_screening_saw_nothing_of_is_tried_without_a_current_and_beyond_the_noise(
    monkeypatch: pytest.MonkeyPatch, current: bool, added: tuple[str, ...], beyond: bool, worth: float
) -> None:
    for name in ("late_without_current", "open_at_zero"):
        monkeypatch.setattr(select, name, lambda _: ())
    asked: list[float] = []
    monkeypatch.setattr(select, "_whatever", lambda *_, worth: asked.append(worth) or ())  # type: ignore[func-returns-value]
    monkeypatch.setattr(select, "errs_beyond_noise", lambda *_: beyond)
    search = _searched(current=current, added=added)
    assert select._thought_little_of(search, (), cast(Any, None), ()) == []
    assert asked == [worth]


def _searched(*, current: bool, added: tuple[str, ...] = (), noise_is_left: bool = False) -> Any:
    """A search whose free runs leave coloured errors."""
    channels = ("current_A", "position_rad") if current else ("position_rad",)
    problem = SimpleNamespace(channels=channels, plant=SimpleNamespace(drive="voltage"))
    trial = SimpleNamespace(independent=0.3, problem=problem)
    return SimpleNamespace(current=trial, data=None, added=list(added), noise_is_left=noise_is_left)
