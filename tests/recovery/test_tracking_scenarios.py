"""The scenarios' own tools: faults do what they say, and a wrong value with a small std is caught."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.recovery.generator import PAPER, Recording, Scenario, generate
from tests.recovery.tracking import faults
from tests.recovery.tracking.cases import CASES, Case
from tests.recovery.tracking.faults import Fault, Where
from tests.recovery.tracking.follow import NAMES, Told, Track
from tests.recovery.tracking.scenarios import judge

pytestmark = pytest.mark.usefixtures("generator_built")


@pytest.fixture(scope="module")
def recording() -> Recording:
    return generate(PAPER, Scenario("prbs", seconds=10.0, seed=1))


def hurt(recording: Recording, fault: Fault, begin: int = 5000) -> Recording:
    return fault(recording, Where(PAPER, begin, 3))


@pytest.mark.parametrize(("run", "pieces"), [(1, 1600), (50, 40)])
def test_a_fifth_of_the_samples_is_missing(recording: Recording, run: int, pieces: int) -> None:
    left = hurt(recording, faults.missing(0.2, run), 0)
    assert len(left.time_s) == pytest.approx(8000, abs=150 if run == 1 else 1500)
    holes = np.count_nonzero(np.diff(left.time_s) > 1.5e-3)
    assert holes == pytest.approx(pieces, rel=0.35)
    assert np.isin(left.time_s, recording.time_s).all()


def test_current_freezes_and_comes_back(recording: Recording) -> None:
    shown = hurt(recording, faults.frozen_current(2.0)).current_A
    assert len(set(shown[5000:7000])) == 1
    assert (shown[:5000] == recording.current_A[:5000]).all() and (shown[7010:] == recording.current_A[7010:]).all()
    assert len(set(hurt(recording, faults.frozen_current(None)).current_A[5000:])) == 1


def test_other_faults(recording: Recording) -> None:
    assert np.count_nonzero(hurt(recording, faults.no_voltage(0.05)).voltage_V == 0.0) >= 50
    spiky = hurt(recording, faults.spikes("current_A"), 0).current_A
    hit = spiky != recording.current_A
    assert 1 <= np.count_nonzero(hit) <= 12 and (np.abs(spiky[hit]) == PAPER.current_limit_A).all()
    moved = hurt(recording, faults.slip(50)).position_rad - recording.position_rad
    assert (moved[:5000] == 0).all() and moved[5000:] == pytest.approx(50 * 2 * np.pi / PAPER.counts_per_rev)
    offset = hurt(recording, faults.current_offset(0.02), 0).current_A - recording.current_A
    assert offset == pytest.approx(0.02 * PAPER.rated_current_A)


def perfect(recording: Recording) -> tuple[Case, Track]:
    """A case whose R steps in the middle, and a tracker that knows everything to 1 %, a tenth of it off."""
    time_s = np.arange(0.05, 10.0, 0.1)
    truth = {n: np.full(len(recording.time_s), getattr(PAPER, n)) for n in NAMES}
    truth["R"] = np.where(recording.truth.time_s >= 5.0, 1.3, 1.0) * PAPER.R
    case = Case("prbs", recording, truth=truth, change_s=5.0, stepped="R")
    now = np.array([getattr(PAPER, n) for n in NAMES]) * np.ones((len(time_s), 5))
    now[:, 0] *= np.where(time_s >= 5.0, 1.3, 1.0)
    told = (Told(5.6, "parameter_jump", "", {"parameter": "R"}),)
    status = np.full(now.shape, "tracking")
    return case, Track(NAMES, time_s, 1.001 * now, 0.01 * now, status, np.ones(len(time_s), bool), told)


def test_a_right_track_is_not_blamed(recording: Recording) -> None:
    case, track = perfect(recording)
    row = judge(("R +30 %", "paper", 10.0, 1, None), case, track)
    assert row.worst == pytest.approx(0.1, rel=0.1) and (row.beyond == 0).all() and (row.share == 1).all()
    assert row.wrong_jumps == ()
    assert row.recognised_s == pytest.approx(0.6) and row.after == pytest.approx(0.001)
    assert row.not_white_s is None and row.white == 1.0


def test_a_wrong_value_with_a_small_std_is_caught_while_tracking_only(recording: Recording) -> None:
    case, track = perfect(recording)
    value = track.value.copy()
    value[:20, 2] *= 1.05
    row = judge(("R +30 %", "paper", 10.0, 1, None), case, replace(track, value=value))
    assert row.worst[2] == pytest.approx(5.1, rel=0.02) and row.beyond[2] == pytest.approx(20 / 50)
    status = track.status.copy().astype("<U12")
    status[:20, 2] = "unexcited"
    row = judge(("R +30 %", "paper", 10.0, 1, None), case, replace(track, value=value, status=status))
    assert row.worst[2] < 1 and row.beyond[2] == 0 and row.share[2] == pytest.approx(0.8)


def test_an_event_of_another_parameter_recognises_nothing(recording: Recording) -> None:
    case, track = perfect(recording)
    told = (Told(5.6, "parameter_jump", "", {"parameter": "J"}), Told(5.7, "filter_started", "", {}))
    row = judge(("R +30 %", "paper", 10.0, 1, None), case, replace(track, told=told))
    assert row.recognised_s is None and row.wrong_jumps == ("J@5.6",)


@pytest.mark.parametrize("name", list(CASES))
def test_every_case_has_a_truth_for_what_the_daemon_publishes(name: str) -> None:
    case = CASES[name](PAPER, 4.0, 1)
    extra = {"constant_load_torque": ("TL",), "coulomb_friction": ("Tc",)}
    assert tuple(case.truth) == (*NAMES, *(p for effect in case.model for p in extra[effect]))
    assert all(len(values) == len(case.recording.truth.time_s) for values in case.truth.values())


def test_a_picture_is_drawn(recording: Recording, tmp_path: Path) -> None:
    from tests.recovery.tracking.plots import plot_case

    case, track = perfect(recording)
    path = plot_case(tmp_path, "R +30 %", "paper", case, track)
    assert path.name == "r-30.png" and 5_000 < path.stat().st_size < 120_000
