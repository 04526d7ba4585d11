"""Fits of a search that nothing can come of, and runs that need not be made again."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest

from servo_daemon.diagnosis.search import unscreened as search
from servo_daemon.diagnosis.search.fitting import is_smooth
from servo_daemon.diagnosis.trial import full_data_fit
from servo_daemon.diagnosis.trial.data import Data, begun
from servo_daemon.diagnosis.trial.full_data_fit import FullDataFits
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


@pytest.mark.parametrize(
    ("decided_white", "again_white", "fitted_with"),
    [
        (True, True, []),  # from where it was decided the whole is white at once
        (True, False, [True]),
        (False, False, [False]),
    ],
)
def test_what_was_not_white_where_it_was_decided_is_fitted_in_free_runs_to_all(
    data: Data, monkeypatch: pytest.MonkeyPatch, decided_white: bool, again_white: bool, fitted_with: list[bool]
) -> None:
    asked: list[bool] = []
    begun: list[object] = []
    fit: Any = SimpleNamespace(white=again_white)

    def fitted(_data: Data, _trial: Trial, full_fits: object, _start: object) -> OutputErrorFit:
        asked.append(full_fits is not None)
        return cast(OutputErrorFit, fit)

    def published(_data: Data, _trial: Trial, found: object) -> OutputErrorFit:
        assert found is fit
        raise LookupError

    monkeypatch.setattr(adequacy, "fit_full_data", fitted)
    monkeypatch.setattr(adequacy, "_straight", published)
    monkeypatch.setattr(FullDataFits, "of", lambda _self, _trial, values: begun.append(values) or fit)
    selection: Any = SimpleNamespace(data=data, chosen=SimpleNamespace(effects=()), rounds=())
    decided: Any = SimpleNamespace(white=decided_white, values={"R": 2.0})
    with pytest.raises(LookupError):
        adequacy._published(selection, (decided, cast(Any, None)), cast(Any, None))
    assert asked == fitted_with
    assert begun == [decided.values] * decided_white


@pytest.mark.parametrize("noise_is_left", [True, False])
def test_everything_is_tried_unless_the_data_say_that_noise_is_left(
    monkeypatch: pytest.MonkeyPatch, noise_is_left: bool
) -> None:
    for name in ("late_signals", "open_at_zero"):
        monkeypatch.setattr(search, name, lambda _: ())
    little = SimpleNamespace(name="resistance_step")
    monkeypatch.setattr(search, "whatever", lambda *_, worth: (little,))
    asked = _asked(current=True, first=False, noise_is_left=noise_is_left)
    assert search.unscreened(asked, (), (), not_asked) == ([] if noise_is_left else [little])


@pytest.mark.parametrize(
    ("current", "first", "beyond", "white", "worth", "late"),
    [
        (False, True, True, False, -math.inf, True),
        (False, True, False, False, 0.0, True),
        (False, False, True, False, 0.0, True),
        (True, True, True, False, 0.0, True),
        (True, True, False, False, 0.0, False),
        (True, True, True, True, 0.0, False),
    ],
)
def test_what_screening_saw_nothing_of_is_tried_beyond_the_noise(
    monkeypatch: pytest.MonkeyPatch, current: bool, first: bool, beyond: bool, white: bool, worth: float, late: bool
) -> None:
    """Everything where no current is measured, what is late in any case."""
    monkeypatch.setattr(search, "late_signals", lambda _: [SimpleNamespace(name="drive_lag")])
    monkeypatch.setattr(search, "open_at_zero", lambda _: ())
    worths: list[float] = []
    monkeypatch.setattr(search, "whatever", lambda *_, worth: worths.append(worth) or ())  # type: ignore[func-returns-value]
    monkeypatch.setattr(search, "errs_beyond_noise", lambda *_: beyond)
    asked = _asked(current=current, first=first)
    found = search.unscreened(asked, (), (), lambda *_: cast(Any, SimpleNamespace(white=white)))
    assert [p.name for p in found] == ["drive_lag"] * late
    assert worths == [worth]


def not_asked(*_: object) -> None:
    """A fit that nobody needs."""
    raise AssertionError


def _asked(*, current: bool, first: bool, noise_is_left: bool = False) -> search.Asked:
    """A model whose free runs leave coloured errors."""
    channels = ("current_A", "position_rad") if current else ("position_rad",)
    problem = SimpleNamespace(channels=channels, plant=SimpleNamespace(drive="voltage"))
    trial: Any = SimpleNamespace(independent=0.3, problem=problem, values={})
    return search.Asked(cast(Any, None), trial, cast(Any, None), first=first, noise_is_left=noise_is_left)
