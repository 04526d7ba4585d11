"""Fits of a search that nothing can come of, and runs that need not be made again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest

from servo_daemon.diagnosis.trial import full_data_fit
from servo_daemon.diagnosis.trial.data import Data, begun
from servo_daemon.diagnosis.trial.trial import MOST_SAMPLES, Trial
from servo_daemon.diagnosis.verdict import adequacy
from servo_daemon.identification.output_error import OutputErrorFit, Recording
from tests.unit.identification.test_output_error import FULL, MOTOR, block_of, linear_recording

START = {**MOTOR, "J": 3.0 * MOTOR["J"]}


@pytest.fixture(scope="module")
def data() -> Data:
    return Data.of([Recording("a", block_of(linear_recording(5.0, noise=1e-3), *FULL))], {}, (), 0.5)


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
