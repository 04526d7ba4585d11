"""What counts as evidence for a name, without a fit."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from servo_daemon.diagnosis.compare import Advantage
from servo_daemon.diagnosis.dependence import _moments
from servo_daemon.diagnosis.evidence import convinces, is_what_it_is_called, noticeable, overwhelming, worth_a_name


def test_stribeck_friction_is_larger_at_rest() -> None:
    falling, rising = {"Tc": 1.0, "Ts": 1.6}, {"Tc": 1.12, "Ts": 0.22}
    assert is_what_it_is_called(["stribeck_friction"], falling)
    assert not is_what_it_is_called(["gravity_load", "stribeck_friction"], rising)
    assert is_what_it_is_called(["coulomb_friction"], {"Tc": 1.0})


def trial(**values: float) -> Any:
    return SimpleNamespace(values=values)


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
    ],
)
def test_statistical_evidence_and_a_gain(gain: float, low: float, bic: float, convincing: bool) -> None:
    a = Advantage(gain=gain, low=low, high=2 * gain, delta_bic=bic)
    assert convinces(a) is convincing
    assert overwhelming(a) is (convincing and low < 0)


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
        )

    assert _moments("torque", missing(noise)) == []
    assert _moments("torque", missing(np.sin(np.arange(20_000) / 50.0))) == []
    (found,) = _moments("torque", missing(dropping))
    assert found.on == "moments"
    assert 7.0 <= found.detail["time_s"] <= 7.1
    assert found.share > 0.9
