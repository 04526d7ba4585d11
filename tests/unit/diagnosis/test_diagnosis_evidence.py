"""What counts as evidence for a name, without a fit."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from servo_daemon.diagnosis.screening.dependence import _moments
from servo_daemon.diagnosis.screening.screen import ScreenedCandidate
from servo_daemon.diagnosis.search import select
from servo_daemon.diagnosis.search.candidates import Proposal, late_signals, proposals
from servo_daemon.diagnosis.search.evidence import (
    are_what_they_are_called,
    at_odds,
    convinces,
    needless,
    noticeable,
    overwhelming,
    worth_a_name,
)
from servo_daemon.diagnosis.trial.compare import Advantage
from servo_daemon.diagnosis.trial.trial import _lifted
from servo_daemon.diagnosis.verdict.adequacy import contradicts
from servo_daemon.identification.output_error.precision.parameters import FittedParameter
from servo_daemon.kalman.gaussian import to_coordinate
from servo_daemon.plant.build import build_plant
from servo_daemon.plant.effects import effects_by_name


def test_stribeck_friction_is_larger_at_rest() -> None:
    falling, rising = {"Tc": 1.0, "Ts": 1.6}, {"Tc": 1.12, "Ts": 0.22}
    assert are_what_they_are_called(["stribeck_friction"], falling)
    assert not are_what_they_are_called(["gravity_load", "stribeck_friction"], rising)
    assert are_what_they_are_called(["coulomb_friction"], {"Tc": 1.0})


def trial(**values: float) -> Any:
    return SimpleNamespace(values=values)


@pytest.mark.parametrize(("unseen", "delta_bic", "kept"), [(False, -70.0, 1), (True, -70.0, 0), (True, -2530.0, 1)])
def test_what_is_fitted_although_screening_saw_nothing_must_speak_against_it(
    monkeypatch: pytest.MonkeyPatch, unseen: bool, delta_bic: float, kept: int
) -> None:
    """As friction that grows with the load, which is always tried where no current is measured."""
    found = Advantage(0.1, 0.05, 0.15, delta_bic)
    candidate: Any = SimpleNamespace(name="load_dependent_friction", trial=None, against=found)
    search: Any = SimpleNamespace(data=None, current=None, base=None)
    anything: Any = None
    monkeypatch.setattr(select, "fitted", lambda *_: [candidate])
    for always in ("noticeable", "worth_a_name"):
        monkeypatch.setattr(select, always, lambda *_: True)
    proposal = Proposal(candidate.name, (candidate.name,), {}, {}, far=True, unseen=unseen)
    assert len(select._worthy(search, anything, [proposal], anything)) == kept


def test_a_load_of_no_inertia_is_no_load() -> None:
    missing: Any = SimpleNamespace(size={"torque": 1.0, "voltage": 10.0})
    spring = {"k_s": 100.0, "c_s": 0.1, "gap": 0.01}
    assert noticeable("backlash", trial(J=0.01, J_l=0.002, **spring), missing)
    assert not noticeable("shaft_compliance", trial(J=4e-5, J_l=4e-9, **spring), missing)
    assert noticeable("coulomb_friction", trial(Tc=0.01), missing)
    assert not noticeable("coulomb_friction", trial(Tc=0.001), missing)
    assert noticeable("torque_ripple", trial(k_rip=0.01), missing)
    assert not noticeable("torque_ripple", trial(k_rip=0.0006), missing)


def test_what_takes_a_ten_thousandth_is_no_cause() -> None:
    def model(nrmse: float) -> Any:
        return SimpleNamespace(choice=SimpleNamespace(nrmse=nrmse))

    base, friction = model(0.118), model(0.0013)
    assert worth_a_name(friction, base, base)
    assert not worth_a_name(model(0.0012), friction, base)
    assert worth_a_name(model(0.0012), friction, friction)


@pytest.mark.parametrize(
    ("gain", "low", "bic", "convincing"),
    [
        (0.25, -0.003, -1974.0, True),  # few runs decide, and one of them begins in the gap
        (0.25, -0.003, -300.0, False),
        (0.05, 0.01, -30.0, True),
        (0.05, 0.01, -10.0, False),
        (0.02, 0.01, -500.0, False),  # what an integrator's error earns
        (0.43, -0.0006, -527.0, True),  # it moves in 3 of 12 runs: one resample in a hundred holds none of these
    ],
)
def test_statistical_evidence_and_a_gain(gain: float, low: float, bic: float, convincing: bool) -> None:
    a = Advantage(gain=gain, low=low, high=2 * gain, delta_bic=bic)
    assert convinces(a) is convincing
    assert overwhelming(a) is (convincing and bic < -1000.0)


def test_a_simpler_model_stands_where_nothing_speaks_for_the_richer_one() -> None:
    def lost(gain: float, low: float, bic: float) -> bool:
        return needless(Advantage(gain=gain, low=low, high=2 * abs(gain), delta_bic=bic))

    assert lost(0.005, -0.01, -5.0)
    assert lost(0.018, -0.022, 248.0)  # Coulomb friction and a load, written as friction by direction
    assert not lost(0.018, -0.022, -248.0)
    assert not lost(0.018, 0.004, 248.0)
    assert not lost(0.4, 0.3, -5000.0)


def test_runs_that_run_away_are_told_from_a_wrong_model() -> None:
    def odd(gain: float, low: float, bic: float) -> bool:
        return at_odds(Advantage(gain=gain, low=low, high=1.0, delta_bic=bic))

    assert odd(-0.5, -0.9, -3147.0)  # a rotor between two detents
    assert not odd(-0.5, -0.9, 300.0)
    assert not odd(0.8, 0.5, -3147.0)


def test_what_stands_in_an_effects_place_begins_nearest_to_it() -> None:
    by_direction = effects_by_name()["asymmetric_friction"].as_simpler
    values = {"Tc": 0.18, "Tc_neg": 0.0, "B": 1.0, "B_neg": 1.1}
    assert by_direction(values, ("coulomb_friction",)) == pytest.approx({"Tc": 0.09})
    both = ("coulomb_friction", "constant_load_torque")
    assert by_direction(values, both) == pytest.approx({"Tc": 0.09, "TL": 0.09})
    assert effects_by_name()["load_torque_step"].as_simpler({"dTL": 0.3}, both) == {"TL": 0.3}


def test_two_estimates_that_cannot_both_be_right() -> None:
    def estimate(value: float, std: float | None, unit: str = "N·m") -> FittedParameter:
        return FittedParameter(value, std, unit, "estimated", False)

    def contradict(long: FittedParameter, short: FittedParameter) -> bool:
        return contradicts({"Tc": long}, {"Tc": short})

    assert contradict(estimate(1.0, 0.003), estimate(1.03, 0.004))
    assert not contradict(estimate(1.0, 0.003), estimate(1.03, 0.02))  # the shorter runs do not say
    assert not contradict(estimate(1.0, 0.003), estimate(1.005, 0.003))  # no simulation is exact to that
    assert not contradict(estimate(1.0, None), estimate(2.0, 0.003))


def test_a_cause_whose_size_the_user_gives_is_fitted_whatever_screening_sees() -> None:
    """The weight of a pendulum is known; beside a motor that the linear fit has biased nothing of it shows."""
    plant = build_plant(())
    motor = {p.name: p.nominal for p in plant.parameters}
    problem = SimpleNamespace(plant=plant, channels=("current_A", "position_rad"))
    current: Any = SimpleNamespace(effects=(), values=motor, problem=problem)
    coordinates = np.array([to_coordinate(p, p.nominal) for p in plant.parameters])
    missing: Any = SimpleNamespace(augmented=SimpleNamespace(plant=plant), coordinates=coordinates)
    screened = (
        ScreenedCandidate("quadratic_drag", 0.4, {"c2": 1e-3}, 0.4, {}),
        ScreenedCandidate("gravity_load", 0.0, {"Tg": 0.1, "phi_g": 0.0}, -0.01, {}),
    )
    assert [p.name for p in proposals(current, screened, missing)] == ["quadratic_drag"]
    given = proposals(current, screened, missing, given={"Tg": 0.48})
    assert [p.name for p in given] == ["quadratic_drag", "gravity_load"]


def test_without_a_current_dry_friction_and_what_is_late_are_always_fitted() -> None:
    plant = build_plant(())
    motor = {p.name: p.nominal for p in plant.parameters} | {"R": 1.0, "L": 4e-3}
    problem = SimpleNamespace(
        plant=plant, channels=("position_rad", "velocity_rad_s"), free=plant.parameter_names, sample_period_s=1e-3
    )
    current: Any = SimpleNamespace(effects=(), values=motor, problem=problem)
    coordinates = np.array([to_coordinate(p, p.nominal) for p in plant.parameters])
    missing: Any = SimpleNamespace(augmented=SimpleNamespace(plant=plant), coordinates=coordinates)
    screened = (
        ScreenedCandidate("quadratic_drag", 0.4, {"c2": 1e-3}, 0.4, {}),
        ScreenedCandidate("coulomb_friction", 0.0, {"Tc": 0.1}, -0.01, {}),
    )
    proposed = proposals(current, screened, missing)
    always = ["coulomb_friction", "load_dependent_friction"]
    assert [p.name for p in proposed] == ["quadratic_drag", *always]
    assert (proposed[2].start["mu"], proposed[2].other["mu"], proposed[2].far) == (0.2, 0.03, True)
    seen = (ScreenedCandidate("load_dependent_friction", 0.5, {"mu": 0.1}, 0.5, {}), *screened)
    assert [p.start.get("mu") for p in proposals(current, seen, missing)] == [0.1, None, None]
    late = list(late_signals(current))
    assert [(p.name, p.start.get("channel")) for p in late] == [
        ("measurement_delay", 1.0),
        ("measurement_delay", 2.0),
        ("drive_lag", None),
    ]
    # Begun where the fitted L/R is theirs, of which a fifth is left, or as it was.
    assert late[0].start["t_d"] == late[2].start["t_lag"] == pytest.approx(4e-3)
    assert late[0].start["L"] == pytest.approx(0.8e-3)
    assert late[0].other["L"] == motor["L"]
    # A late sensor goes no further back than so many steps: the rest stays with L.
    problem.sample_period_s = 4e-4
    (begun, *_) = late_signals(current)
    assert begun.start["t_d"] == pytest.approx(6 * 4e-4)
    assert begun.start["L"] == pytest.approx(4e-3 - 6 * 4e-4)
    problem.channels = ("current_A", "position_rad")
    # A current tells L/R: all begin a sample late, and L as it is.
    late = list(late_signals(current))
    assert [p.name for p in late] == ["measurement_delay", "measurement_delay", "drive_lag"]
    assert {p.start.get("t_d", p.start.get("t_lag")) for p in late} == {4e-4}
    assert {p.start["L"] for p in late} == {motor["L"]} and not any(p.far for p in late)
    assert [p.name for p in proposals(current, screened, missing)] == ["quadratic_drag"]


def test_what_was_driven_to_nothing_is_lifted_to_where_it_is_seen() -> None:
    problem: Any = SimpleNamespace(sample_period_s=1e-3, free=("R", "L", "K", "J", "B"))
    motor = {"R": 2.0, "L": 1e-8, "K": 0.3, "J": 1e-3, "B": 1e-7}
    assert _lifted(motor, problem) == pytest.approx({"L": 0.1 * 1e-3 * 2.0, "B": 0.01 * 0.3**2 / 2.0})
    assert _lifted({**motor, "L": 1e-3, "B": 1e-3}, problem) == {}
    problem.free = ("R", "K", "J")
    assert _lifted(motor, problem) == {}


def test_what_comes_at_moments_is_told_from_noise() -> None:
    rng = np.random.default_rng(3)
    noise = 0.01 * rng.normal(size=20_000)
    dropping = noise.copy()
    dropping[7000:7100] += 0.8

    def missing(series: Any) -> Any:
        return SimpleNamespace(
            series={"torque": series},
            std={"torque": np.full(len(series), 0.02)},
            size={"torque": 1.0},
            time_s=np.arange(len(series)) / 1000.0,
            seen=np.ones(len(series), dtype=bool),
        )

    assert _moments("torque", missing(noise)) == []
    assert _moments("torque", missing(np.sin(np.arange(20_000) / 50.0))) == []
    (found,) = _moments("torque", missing(dropping))
    assert found.on == "moments"
    assert 7.0 <= found.detail["time_s"] <= 7.1
    assert found.share > 0.9
