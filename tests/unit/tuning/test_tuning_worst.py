"""The worst case over a region against brute force: no random motor of the region may be worse than what was found."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest

from servo_daemon.samples import F64
from servo_daemon.tuning.knowledge import NEEDED, CascadeGains, Known, MotorKnowledge
from servo_daemon.tuning.laws import Gains, StateGains, controller
from servo_daemon.tuning.margins import MarginArrays, margins
from servo_daemon.tuning.sampled import sampled_motor
from servo_daemon.tuning.worst import MEASURES, Box, Ellipsoid, Region, region_of, worst_case
from tests.recovery.generator.motors import PAPER, RE40, Motor

T = 1e-3
LOOPS: dict[str, tuple[Motor, Gains]] = {
    "paper-speed": (PAPER, CascadeGains(1.6, 112.0, filter_hz=158.0)),
    "paper-cascade": (PAPER, CascadeGains(1.2, 85.0, 18.0, filter_hz=120.0)),
    "re40-two-integrals": (RE40, CascadeGains(0.07, 6.0, 24.0, 300.0, filter_hz=200.0)),
    "paper-lqr": (PAPER, StateGains(454.0, 3.65, 0.39, 11200.0, (0.17,), 0.6, 196.0)),
}


def knowledge(motor: Motor, covariance: F64, uncertain: tuple[str, ...] = NEEDED) -> MotorKnowledge:
    known = {name: Known(getattr(motor, name), "estimate", None) for name in NEEDED}
    return MotorKnowledge(known, uncertain, covariance)


def correlated(seed: int, size: float, n: int = 5) -> F64:
    """A covariance with strong correlations and very different directions."""
    rng = np.random.default_rng(seed)
    directions, _ = np.linalg.qr(rng.normal(size=(n, n)))
    return size**2 * directions @ np.diag(np.geomspace(1.0, 1e-4, n)) @ directions.T


def evaluator(gains: Gains) -> Callable[[F64], MarginArrays]:
    loop = controller(gains, T)
    return lambda motors: margins(sampled_motor(motors, T, 1.0), loop)


def inside(region: Region, n: int, seed: int) -> F64:
    """Random points of the region, half of them on its surface."""
    rng = np.random.default_rng(seed)
    dimension = len(region.names)
    if isinstance(region, Box):
        u = rng.uniform(-1, 1, (n, dimension))
        u[: n // 2] = np.sign(u[: n // 2])
        return region.motors(u)
    direction = rng.normal(size=(n, dimension))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    radius = np.where(np.arange(n) < n // 2, 1.0, rng.uniform(size=n) ** (1 / dimension))
    return region.motors(direction * radius[:, None])


def check_against_brute_force(gains: Gains, region: Region, seed: int) -> None:
    worst = worst_case(evaluator(gains), region).margins
    every = evaluator(gains)(inside(region, 4000, seed))
    assert worst.stable and every.stable.all()
    assert worst.phase_margin_deg is not None and worst.delay_margin_s is not None
    assert worst.sensitivity_peak is not None and worst.gain_margin_dB is not None
    assert worst.phase_margin_deg <= np.degrees(every.phase_rad.min()) + 0.05
    assert worst.delay_margin_s <= every.delay_s.min() * 1.002
    assert worst.sensitivity_peak >= (1 / every.distance).max() * 0.998
    assert worst.gain_margin_dB <= 20 * np.log10(every.up.min()) + 0.02
    if worst.gain_reduction_margin_dB is not None:
        assert worst.gain_reduction_margin_dB <= -20 * np.log10(every.down.max()) + 0.02


@pytest.mark.first_is_fast
@pytest.mark.parametrize("name", LOOPS)
@pytest.mark.parametrize("seed", [1, 2])
def test_no_motor_of_the_ellipsoid_is_worse(name: str, seed: int) -> None:
    motor, gains = LOOPS[name]
    region = region_of(knowledge(motor, correlated(seed, 0.05)))
    assert isinstance(region, Ellipsoid)
    check_against_brute_force(gains, region, seed)


@pytest.mark.parametrize("name", LOOPS)
def test_no_motor_of_the_box_is_worse(name: str) -> None:
    motor, gains = LOOPS[name]
    region = region_of(knowledge(motor, np.zeros((0, 0)), ()), dict.fromkeys(NEEDED, 0.1))
    assert isinstance(region, Box)
    check_against_brute_force(gains, region, 5)


@pytest.mark.parametrize("name", LOOPS)
def test_where_it_is_the_worst_lies_in_the_region_and_is_as_bad(name: str) -> None:
    motor, gains = LOOPS[name]
    covariance = correlated(3, 0.04)
    of = knowledge(motor, covariance)
    region = region_of(of)
    assert region is not None
    worst = worst_case(evaluator(gains), region)
    inverse = np.linalg.inv(covariance)
    for measure in MEASURES:
        x = np.log([worst.at[measure][name] for name in NEEDED])
        away = x - of.log_values
        assert away @ inverse @ away <= 11.0705 * (1 + 1e-6), "chi-square, 5 degrees of freedom, 95 %"
    m = evaluator(gains)(np.log([[worst.at["phase_margin_deg"][name] for name in NEEDED]])).of(0)
    assert m.phase_margin_deg == pytest.approx(worst.margins.phase_margin_deg)
    m = evaluator(gains)(np.log([[worst.at["sensitivity_peak"][name] for name in NEEDED]])).of(0)
    assert m.sensitivity_peak == pytest.approx(worst.margins.sensitivity_peak)


def test_correlations_matter() -> None:
    """R and K up together, or against each other: the same stds, other margins."""
    motor, gains = LOOPS["paper-speed"]
    found = []
    for correlation in (0.99, -0.99):
        covariance = np.diag([0.1**2, 1e-8, 0.1**2, 1e-8, 1e-8])
        covariance[0, 2] = covariance[2, 0] = correlation * 0.1**2
        region = region_of(knowledge(motor, covariance))
        assert region is not None
        found.append(worst_case(evaluator(gains), region).margins.sensitivity_peak)
    assert None not in found and abs(found[0] / found[1] - 1) > 0.05  # type: ignore[operator]


def test_a_larger_region_is_never_better() -> None:
    motor, gains = LOOPS["paper-cascade"]
    peaks = []
    for size in (0.0, 0.02, 0.06, 0.15):
        region = region_of(knowledge(motor, correlated(7, size)))
        assert region is not None
        peaks.append(worst_case(evaluator(gains), region).margins.sensitivity_peak or 0.0)
    assert all(small < large for small, large in itertools.pairwise(peaks))


def test_an_unstable_motor_in_the_region_is_found() -> None:
    motor, gains = LOOPS["paper-cascade"]
    region = region_of(knowledge(motor, np.diag([0.4**2] * 5)))
    assert region is not None
    worst = worst_case(evaluator(gains), region)
    assert not worst.margins.stable and worst.margins.phase_margin_deg is None
    at = np.log([[worst.at["phase_margin_deg"][name] for name in NEEDED]])
    assert not evaluator(gains)(at).stable[0]


def test_only_the_uncertain_parameters_move() -> None:
    region = region_of(knowledge(PAPER, correlated(2, 0.1, 2), ("R", "J")))
    assert region is not None and region.names == ("R", "J")
    moved = region.motors(region.spread(np.random.default_rng(0).uniform(size=(50, 2)))) - region.motors(
        np.zeros((1, 2))
    )
    assert np.ptp(moved[:, [1, 2, 4]]) == 0 and np.ptp(moved[:, 0]) > 0 < np.ptp(moved[:, 3])
    assert "chi-square, 2 d.o.f." in region.described


def test_nothing_known_claims_nothing() -> None:
    assert region_of(knowledge(PAPER, np.zeros((0, 0)), ())) is None
