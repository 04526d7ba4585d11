"""The refresh beside a filter: in the shadow until proven, gated, and of use where the filter is wrong."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from servo_daemon.kalman.gaussian import Gaussian
from servo_daemon.learning.examples.drawing import CORE
from servo_daemon.learning.model.model import LearnedModel
from servo_daemon.learning.refresh import refresh as refresh_module
from servo_daemon.learning.refresh.refresh import GATE, PseudoMeasurement, Refresh, RefreshEstimate
from servo_daemon.samples import Quality, SampleBlock
from servo_daemon.simulate import PAPER_MOTOR, SimulatedDrive, make_settings
from tests.learned_models import Once, small_model


@pytest.fixture(scope="module")
def model(once: Once) -> LearnedModel:
    return small_model(once)


@pytest.fixture(scope="module")
def recording() -> SampleBlock:
    return SimulatedDrive(make_settings(rate_hz=500.0)).next_block(9000)


def believed(factor: float, std: float) -> Gaussian:
    """A filter that takes every parameter for `factor` times its true value."""
    mean = np.log([factor * PAPER_MOTOR[n] for n in CORE])
    return Gaussian(CORE, mean, np.diag(np.full(5, std**2)))


def applied(prior: Gaussian, pseudo: PseudoMeasurement) -> Gaussian:
    """What `Tracker.assimilate` does in the filter, on the parameters alone, in Joseph's form."""
    at = [prior.names.index(n) for n in pseudo.names]
    P = prior.covariance.copy()
    P[at, at] += np.square(pseudo.widen_std)
    S = P[np.ix_(at, at)] + pseudo.covariance
    gain = np.linalg.solve(S, P[at]).T
    mean = prior.mean + gain @ (pseudo.mean - prior.mean[at])
    left = np.eye(len(P))
    left[:, at] -= gain
    P = left @ P @ left.T + gain @ pseudo.covariance @ gain.T
    return Gaussian(prior.names, mean, (P + P.T) / 2)


def run(model: LearnedModel, block: SampleBlock, belief: Gaussian | None, *, piece: int = 50) -> list[RefreshEstimate]:
    refresh, out = Refresh(model, every_s=2.0), []
    for k in range(0, len(block), piece):
        found = refresh.update(block.slice(k, min(k + piece, len(block))), lambda belief=belief: belief)
        if found is not None:
            out.append(found)
            if found.pseudo is not None and belief is not None:
                belief = applied(belief, found.pseudo)
    return out


def test_a_window_every_few_seconds_and_its_estimate(model: LearnedModel, recording: SampleBlock) -> None:
    found = run(model, recording, None)
    assert len(found) == 8  # the tenth of a second of a piece is late each time
    assert np.diff([e.time_s for e in found]) == pytest.approx(2.0, abs=0.11)
    good = [e for e in found if not e.declined]
    assert len(good) >= 6
    for e in good:
        assert e.mode == "shadow"
        assert e.pseudo is None
        for n in CORE:
            assert abs(e.value[n] / PAPER_MOTOR[n] - 1) < max(0.15, 4 * e.std[n] / PAPER_MOTOR[n]), n


def test_it_does_not_matter_how_samples_arrive(model: LearnedModel, recording: SampleBlock) -> None:
    first, second = run(model, recording, None, piece=10), run(model, recording, None, piece=10)
    assert first == second


def test_a_filter_that_is_far_off_is_brought_back(model: LearnedModel, recording: SampleBlock) -> None:
    """Nominal values three times wrong, and the filter sure of them: the first windows only watch, then it is moved."""
    belief = believed(3.0, 0.05)
    refresh = Refresh(model, every_s=2.0)
    modes, errors = [], []
    for k in range(0, len(recording), 50):
        found = refresh.update(recording.slice(k, k + 50), lambda belief=belief: belief)
        if found is None:
            continue
        modes.append(found.mode)
        if found.pseudo is not None:
            belief = applied(belief, found.pseudo)
            assert np.linalg.eigvalsh(belief.covariance).min() > 0
        errors.append(float(np.abs(belief.mean - np.log([PAPER_MOTOR[n] for n in CORE])).max()))
    assert modes[0] == "shadow"
    assert modes[-1] == "trusted"
    assert errors[0] == pytest.approx(np.log(3.0))
    assert errors[-1] < 0.15


def test_a_filter_that_is_right_is_left_alone(model: LearnedModel, recording: SampleBlock) -> None:
    found = run(model, recording, believed(1.0, 1e-3))
    for e in found:
        if e.pseudo is not None:
            after = applied(believed(1.0, 1e-3), e.pseudo)
            assert np.abs(after.mean - believed(1.0, 1e-3).mean).max() < 2e-3
            assert not e.pseudo.widen_std.any()


def test_a_window_of_another_world_is_declined(model: LearnedModel, recording: SampleBlock) -> None:
    """The current with the wrong sign: no estimate, a reason, nothing to apply."""
    assert recording.current_A is not None
    found = run(model, dataclasses.replace(recording, current_A=-recording.current_A), believed(1.0, 0.1))
    assert found
    assert all(e.declined and e.pseudo is None and not e.value for e in found)


def test_standing_still_and_wrong_rates_are_declined(model: LearnedModel, recording: SampleBlock) -> None:
    still = SimulatedDrive(make_settings(rate_hz=500.0, motion="rest")).next_block(3000)
    assert all(e.declined for e in run(model, still, None))
    slow = recording.select(np.arange(len(recording)) % 2 == 0)
    assert all("Hz" in e.declined for e in run(model, slow, None))


def test_a_restart_of_the_device_begins_a_new_window(model: LearnedModel, recording: SampleBlock) -> None:
    refresh = Refresh(model, every_s=2.0)
    assert refresh.update(recording.slice(0, 900), lambda: None) is None
    quality = recording.quality[:900].copy()
    quality[0] = int(Quality.TIME_RESTART)
    again = dataclasses.replace(recording.slice(0, 900), quality=quality)
    assert refresh.update(again, lambda: None) is None
    assert refresh.update(recording.slice(900, 1100), lambda: None) is not None


def test_only_what_the_filter_estimates_is_measured(model: LearnedModel, recording: SampleBlock) -> None:
    whole = believed(3.0, 1.0)
    part = Gaussian(("J", "B", "R", "L", "K", "TL"), np.append(whole.mean[[3, 4, 0, 1, 2]], 0.0), np.eye(6))
    found = [e.pseudo for e in run(model, recording, part) if e.pseudo is not None]
    assert found
    assert all(set(p.names) == set(CORE) for p in found)
    assert all(np.linalg.eigvalsh(p.covariance).min() > 0 for p in found)


class _Proven:
    """Stands for `ChampionChallengerTest`: the model is trusted, and nothing of the filter's is refuted."""

    trusted, refuted = True, frozenset[str]()

    def judge(self, *_: object) -> None: ...

    def believe(self, *_: object) -> None: ...

    def forget(self) -> None: ...


def test_what_is_too_far_off_does_not_enter_unless_the_filter_is_refuted(
    model: LearnedModel, recording: SampleBlock, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between two that contradict each other the balances decide, not the one that is learned."""
    monkeypatch.setattr(refresh_module, "ChampionChallengerTest", _Proven)
    near, far = (run(model, recording, believed(factor, 0.1)) for factor in (1.0, 3.0))
    assert any(e.pseudo is not None for e in near)
    outcomes = [e for e in far if not e.declined]
    assert outcomes
    for e in outcomes:
        assert e.pseudo is None
        assert e.reason.startswith("gated")
        assert e.distance is not None
        assert e.distance**2 > GATE


def test_a_filter_that_knows_all_of_it_better_is_left_alone(
    model: LearnedModel, recording: SampleBlock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(refresh_module, "ChampionChallengerTest", _Proven)
    found = [e for e in run(model, recording, believed(1.0, 1e-3)) if not e.declined]
    assert found
    assert all(e.pseudo is None and "knows all of it better" in e.reason for e in found)


class _Unproven(_Proven):
    """The same, and the model is not trusted."""

    trusted = False


def test_what_has_not_proven_itself_does_not_enter(
    model: LearnedModel, recording: SampleBlock, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However near to the filter's values it is."""
    monkeypatch.setattr(refresh_module, "ChampionChallengerTest", _Unproven)
    found = [e for e in run(model, recording, believed(1.0, 0.1)) if not e.declined]
    assert found
    assert all(e.pseudo is None and e.reason.startswith("shadow") for e in found)
    assert any(e.distance is not None and e.distance**2 <= GATE for e in found)
