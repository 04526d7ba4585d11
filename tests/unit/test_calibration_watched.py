"""What a threshold is compared with, on its own scale, and that the program computes as without."""

from __future__ import annotations

import json
import math
import pickle

import numpy as np
import pytest

from servo_daemon.diagnosis.search import evidence
from servo_daemon.diagnosis.trial import compare, likelihood
from servo_daemon.diagnosis.trial.compare import Advantage
from tests.recovery.calibration.watched import Notes, Watched, watching


def threshold() -> tuple[Watched, Notes]:
    notes = Notes(2.0)
    return Watched.of(2.0, notes), notes


def test_comparisons_of_either_side_and_any_kind() -> None:
    w, notes = threshold()
    statistic = 3.0
    assert statistic > w
    assert w < 4
    assert not w <= 1.5
    assert np.float64(5.0) >= w
    assert (np.array([1.0, 6.0]) > w).tolist() == [False, True]
    assert (w > np.array([1.0, 6.0])).tolist() == [True, False]
    assert notes.seen == [3.0, 4.0, 1.5, 5.0, 1.0, 6.0, 1.0, 6.0]


def test_what_is_computed_from_a_threshold_is_noted_on_its_scale() -> None:
    w, notes = threshold()
    statistic, array_scalar = 7.0, np.float64(7.0)
    assert statistic > 3.0 * w  # 7/3
    assert array_scalar > np.float64(3.0) * w
    assert statistic > 1.0 - w / 4.0  # (1 − 7) · 4
    assert statistic > w**2  # √7
    assert statistic > -w
    assert statistic > 8.0 / w  # 8/7
    assert statistic > w + 1.0
    assert notes.seen == pytest.approx([7 / 3, 7 / 3, -24.0, 7**0.5, -7.0, 8 / 7, 6.0])


def test_otherwise_it_is_a_number() -> None:
    w, notes = threshold()
    assert np.array([w, w]).dtype == np.float64
    assert (np.full(2, w) * np.array([1.0, 2.0])).tolist() == [2.0, 4.0]
    assert (np.array([1.0, 2.0]) * w).tolist() == [2.0, 4.0]
    assert np.maximum(np.array([1.0, 3.0]), w).tolist() == [2.0, 3.0]
    assert math.sqrt(w) == math.sqrt(2.0)
    assert json.dumps([w]) == "[2.0]"
    assert type(pickle.loads(pickle.dumps(w))) is float
    assert notes.seen == []
    other = Watched.of(3.0, Notes(3.0))
    assert other > w
    assert notes.seen == []


def test_the_thresholds_of_a_package_are_watched_while_it_lasts() -> None:
    advantage = Advantage(gain=0.05, low=0.01, high=0.1, delta_bic=-50.0)
    before = evidence.convinces(advantage), evidence.LEAST_GAIN
    with watching("servo_daemon.diagnosis") as notes:
        assert evidence.convinces(advantage) == before[0]
        assert isinstance(evidence.LEAST_GAIN, Watched)
        assert isinstance(likelihood._LIKELIER, Watched)
        assert not isinstance(compare._RESAMPLES, Watched)  # a count, no threshold
    assert type(evidence.LEAST_GAIN) is float
    assert before[1] == evidence.LEAST_GAIN
    assert notes["diagnosis.search.evidence.LEAST_GAIN"].seen == [0.05]
    assert notes["diagnosis.search.evidence.LEAST_BIC"].seen == [-50.0]
    assert notes["diagnosis.search.evidence.LEAST_OWN"].seen == []
