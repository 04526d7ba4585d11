"""Motors outside the range, told from those within by where a motor lies and not by what a learner makes of it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from servo_daemon.learning.examples.drawing import CORE, TrainingSpec
from servo_daemon.learning.examples.targets import Baseline
from servo_daemon.learning.examples.training import FAULTY, FOREIGN, HEALTHY
from servo_daemon.learning.model.novelty import MOST_NOVEL, Looks, Novelty
from servo_daemon.samples import F64
from servo_daemon.simulate import PAPER_MOTOR

SPEC = TrainingSpec(dict(PAPER_MOTOR))
#: What the regression is off by depends on so many features, a little on each.
FEATURES, SCALE = 40, 0.1


def drawn(rng: np.random.Generator, kind: NDArray[np.int64], beyond: tuple[float, float]) -> tuple[Looks, F64]:
    """Windows whose regression is off by three of its standard deviations, and the truth; foreign motors lie outside
    with one parameter."""
    n = len(kind)
    away = np.log(SPEC.spread) * rng.uniform(-1.0, 1.0, (n, len(CORE)))
    which, far = rng.integers(len(CORE), size=n), np.log(SPEC.spread * rng.uniform(*beyond, n))
    rows = np.flatnonzero(kind == FOREIGN)
    away[rows, which[rows]] = (far * rng.choice((-1.0, 1.0), n))[rows]
    z = rng.normal(size=(n, FEATURES)) + 3.0 * (kind == FAULTY)[:, None]
    off = z @ np.random.default_rng(1).normal(size=(FEATURES, len(CORE))) * 3.0 / np.sqrt(FEATURES)
    nominal = np.log([SPEC.nominal[name] for name in CORE])
    centre = np.column_stack([nominal + away - SCALE * off, np.zeros(n)])
    looks = Looks(z, Baseline(centre, np.full((n, len(CORE) + 1), SCALE), np.ones(n)))
    return looks, np.column_stack([np.exp(nominal + away), np.zeros(n)])


@pytest.fixture(scope="module")
def novelty() -> Novelty:
    rng = np.random.default_rng(0)
    kind = rng.choice((HEALTHY, FAULTY, FOREIGN), 3000)
    looks, truth = drawn(rng, kind, (1.4, 5.0))
    calibration, _ = drawn(rng, np.full(500, HEALTHY), (1.0, 1.0))
    return Novelty().fit(SPEC, looks, truth, kind, calibration)


def shares(novelty: Novelty, kind: int, beyond: tuple[float, float]) -> F64:
    looks, _ = drawn(np.random.default_rng(2), np.full(1000, kind), beyond)
    return novelty.share(novelty.judge(looks)[0])


def test_a_motor_a_little_outside_is_told_where_the_regression_is_off_by_as_much(novelty: Novelty) -> None:
    """Beyond by 1.5 to 2 times is 0.4 to 0.7, the regression off by 0.3: but what it is off by can be seen."""
    assert (shares(novelty, FOREIGN, (1.5, 2.0)) < MOST_NOVEL).mean() > 0.9
    assert (shares(novelty, HEALTHY, (1.0, 1.0)) < MOST_NOVEL).mean() < 0.06


def test_faults_are_told_beside_it(novelty: Novelty) -> None:
    assert (shares(novelty, FAULTY, (1.0, 1.0)) < MOST_NOVEL).mean() > 0.95
    looks, _ = drawn(np.random.default_rng(3), np.full(200, FOREIGN), (3.0, 5.0))
    assert (novelty.judge(looks)[1] == FOREIGN).mean() > 0.9
