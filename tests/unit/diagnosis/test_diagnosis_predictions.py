"""Which times and models predictions are judged on."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from servo_daemon.diagnosis.search.fitting import Candidate
from servo_daemon.diagnosis.search.select import Selection
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.full_data_fit import FullDataFits
from servo_daemon.diagnosis.trial.split import HELD_OUT
from servo_daemon.diagnosis.verdict import predictions
from servo_daemon.diagnosis.verdict.predicted import times_of
from servo_daemon.diagnosis.verdict.predictions import _MOST_SAMPLES, _begun, _simplest
from servo_daemon.identification.output_error import OutputErrorFit, Recording
from servo_daemon.samples import make_block


def recording(samples: int) -> Recording:
    t = np.arange(samples) / 1000.0
    turned = 2 * np.pi * t
    block = make_block(t, voltage_V=np.sin(turned), current_A=np.sin(2 * turned), position_rad=np.cos(turned))
    return Recording("capture", block)


def data(*samples: int) -> Data:
    return Data.of([recording(n) for n in samples], {}, (), 0.5)


def test_a_decision_needs_no_more_than_so_many_samples_and_divides_those_anew() -> None:
    much = data(2 * _MOST_SAMPLES, _MOST_SAMPLES)
    few = _begun(much, ())
    for begin, whole in zip(few.recordings, much.recordings, strict=True):
        assert begin.seen is not None
        assert whole.seen is not None
        assert (begin.seen == whole.seen[: len(begin.block)]).all(), "what was held out is held out"
    assert [len(r.block) for r in few.recordings] == [_MOST_SAMPLES * 2 // 3, _MOST_SAMPLES // 3]
    assert len(few.split.part) == _MOST_SAMPLES / 500
    short = data(10_000)
    assert _begun(short, ()) is short


def test_what_a_recording_begins_with_is_never_held_out() -> None:
    both = data(5000, 5000)
    held = times_of(both, (), HELD_OUT)
    assert [len(h) for h in held] == [5000, 5000]
    assert all((h[:400] == -1).all() for h in held)
    runs = {int(k) for h in held for k in h} - {-1}
    assert runs
    assert runs <= set(both.split.of(HELD_OUT).tolist())


@dataclass
class Fit:
    deviance: float
    free: int

    @property
    def deviance_at_best(self) -> float:
        return self.deviance

    @property
    def problem(self) -> SimpleNamespace:
        return SimpleNamespace(free=range(self.free), counts=np.array([20_000.0, 20_000.0]))


@pytest.mark.parametrize(("richer_by", "taken"), [(40.0, "coulomb_friction"), (400.0, "stribeck_friction")])
def test_of_two_that_contain_each_other_the_simpler_one(richer_by: float, taken: str) -> None:
    pairs = [("stribeck_friction", Fit(-1000.0 - richer_by, 8)), ("coulomb_friction", Fit(-1000.0, 6))]
    likely = [
        (cast(Candidate, SimpleNamespace(name=name)), cast(OutputErrorFit, cast(object, fit))) for name, fit in pairs
    ]
    assert _simplest(likely)[0].name == taken


@pytest.mark.parametrize("known", [True, False])
def test_what_is_far_likelier_and_not_known_has_no_name(monkeypatch: pytest.MonkeyPatch, known: bool) -> None:
    """A sensor's gain of 1.2 made 0.20 ± 0.11 of a load-dependent friction likelier by 198."""
    fit = SimpleNamespace(white=True, deviance=-1000.0, deviance_at_best=0.0, problem=SimpleNamespace(channels=()))
    best = SimpleNamespace(name="load_dependent_friction", trial=None, start={})
    # 3 σ, squared, is what chance makes; 21 was a step of R beside a winding's heat, which it was
    others = [
        (SimpleNamespace(name=name), SimpleNamespace(deviance=deviance, deviance_at_best=deviance))
        for name, deviance in (("drive_lag", -995.0), ("resistance_step", -979.0))
    ]
    errors = SimpleNamespace(errors=None, expected=SimpleNamespace(nrmse=0.0))
    replaced = {
        "_begun": lambda data, _effects: data,
        "FullDataFits": lambda _data: SimpleNamespace(of=lambda _trial: fit),
        "_likely": lambda *_: [(best, fit), *others],
        "_fitted": lambda *_: fit,
        "predictions_of_both": lambda *_: (errors, errors),
        "error_removed": lambda *_: (0.09, (0.07, 0.12)),
        "_score": lambda *_: None,
        "_marked": lambda *_: (),
        "longest_missing": lambda *_: None,
        "is_determined": lambda _name, _fit: known,
    }
    for name, value in replaced.items():
        monkeypatch.setattr(predictions, name, value)
    base = SimpleNamespace(effects=(), problem=SimpleNamespace(plant=SimpleNamespace(drive="voltage")))
    data, fits = SimpleNamespace(full=None), SimpleNamespace(of=lambda _trial: fit)
    finding = predictions.found_by_predictions(
        cast(Data, data), cast(Selection, SimpleNamespace(base=base)), (), cast(FullDataFits, fits)
    )
    assert (finding is not None) == known
    if finding is not None:
        assert [(e.name, e.equivalent) for e in finding.effects] == [(best.name, ("drive_lag",))]
