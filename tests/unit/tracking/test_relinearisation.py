"""Re-linearisations of the start are spread over ticks: none holds up its own drive, whatever the blocks are."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.config import DriveConfig
from servo_daemon.kalman.ekf import Ekf
from servo_daemon.kalman.records import Innovations
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.samples import F64, SampleBlock
from servo_daemon.simulate import DEFAULT_NOMINAL, SimulatedDrive, make_settings
from servo_daemon.tracking.restart import maximum_likelihood, relinearisation
from servo_daemon.tracking.restart.simplex import SimplexSearch
from servo_daemon.tracking.samples.filtering import Fit

#: In a tick, of 200 Hz here: as many for each sample as at 1 kHz.
STEPS = 5_000
RATE_HZ, SECONDS, TICK = 200.0, 21.0, 20


@pytest.fixture(scope="module")
def recording() -> SampleBlock:
    """Of a motor with dry friction that the model lacks: its filter is in doubt of its start."""
    settings = make_settings(seed=5, rate_hz=RATE_HZ, effects=["coulomb_friction:Tc=0.25"])
    return SimulatedDrive(settings).next_block(round(SECONDS * RATE_HZ))


def pipeline() -> Pipeline:
    return Pipeline(DriveConfig(nominal=dict(DEFAULT_NOMINAL)))


def test_no_tick_takes_more_steps_than_its_share_and_blocks_do_not_matter(
    recording: SampleBlock, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps: list[int] = []
    update, predict_held = Ekf.update, Ekf.predict_held

    def counted(self: Ekf, samples: F64, *, again: bool = False) -> Innovations:
        steps[-1] += len(samples) if again else 0
        return update(self, samples, again=again)

    def counted_held(self: Ekf, samples: F64) -> Innovations:
        steps[-1] += len(samples)
        return predict_held(self, samples)

    monkeypatch.setattr(Ekf, "update", counted)
    monkeypatch.setattr(Ekf, "predict_held", counted_held)
    for module in (maximum_likelihood, relinearisation):
        monkeypatch.setattr(module, "STEPS_A_TICK", STEPS)
    one, other, found, same = pipeline(), pipeline(), [], []
    for k in range(0, len(recording), TICK):
        steps.append(0)
        found += one.process(recording.slice(k, k + TICK))
    ticks = list(steps)
    for k in range(0, len(recording), 777):
        same += other.process(recording.slice(k, min(k + 777, len(recording))))
    assert found == same
    first, likeliest = ticks[:100], ticks[100:]
    for part in (first, likeliest):  # neither would have gone into one tick, or into two
        assert sum(s > STEPS / 2 for s in part) > 3
    kept = 17.0 * RATE_HZ  # at most: one pass more where a tick has room for less than one, one more to come up to date
    assert max(ticks) <= STEPS + 2 * kept


def test_the_simplex_stops_after_every_evaluation_and_comes_to_the_minimum() -> None:
    asked: list[F64] = []

    def cost(x: F64) -> float:
        asked.append(x.copy())
        return float((x[0] - 1.0) ** 2 + 10.0 * (x[1] + 2.0 + x[0] ** 2 / 10.0) ** 2)

    simplex = np.array([[0.0, 0.0], [1.5, 0.0], [0.0, -1.5]])
    search = SimplexSearch(cost, simplex, exact=1e-4, cost_exact=1e-6, most=200)
    for k, _ in enumerate(search.steps()):
        assert len(asked) == k + 1
    assert np.abs(search.best - [1.0, -2.1]).max() < 1e-3
    few = SimplexSearch(cost, simplex, exact=1e-4, cost_exact=1e-6, most=10)
    assert sum(1 for _ in few.steps()) == 10


def test_a_search_that_leads_where_no_filter_runs_is_given_up(
    recording: SampleBlock, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []

    def overflown(*_: object, **__: object) -> Innovations:
        asked.append(len(asked))
        return Innovations(np.full((9, 2), np.nan), np.full((9, 2), -1.0), np.zeros((9, 2)))

    monkeypatch.setattr(maximum_likelihood.MaximumLikelihoodRestart, "_predicted", overflown)
    one = pipeline()
    one.process(recording.slice(0, 3000), rows=False)
    assert len(asked) == 1 and one.current() is not None
    assert Fit(1.0).with_more(overflown()).cost == np.inf
