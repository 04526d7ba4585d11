"""Fits to the full data are made once, for whoever asks."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, cast

import pytest

from servo_daemon.diagnosis.trial import full_data_fit
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.trial import Trial
from servo_daemon.errors import NumericalError


def test_the_same_model_from_the_same_values_is_fitted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[Any, ...]] = []

    def fit_runs(data: object, trial: Trial, values: object, runs_s: object, below: float) -> str:
        asked.append((trial.effects, values, runs_s, below))
        if below < 0.0:
            raise NumericalError("left the range of numbers")
        return f"fit {len(asked)}"

    monkeypatch.setattr(full_data_fit, "fit_runs", fit_runs)
    full_fits = full_data_fit.FullDataFits(cast(Data, None))
    trial = Trial(("coulomb_friction",), {"Tc": 1.0}, {}, *cast(Any, (None, None, None, None)))
    first = full_fits.of(trial)
    assert full_fits.of(replace(trial)) is first
    assert full_fits.of(trial, {"Tc": 1.0}) is first
    assert full_fits.of(trial, {"Tc": 2.0}) is not first
    assert full_fits.of(replace(trial, effects=("cogging_torque",))) is not first
    assert full_fits.of(trial, below=10.0) is not first
    assert full_fits.of(trial, below=-1.0) is full_fits.of(trial, below=-1.0) is None
    assert len(asked) == 5
    assert asked[0] == (("coulomb_friction",), {"Tc": 1.0}, None, math.inf)
