"""Captures, the texts behind them, and the motions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from servo_daemon.errors import BadInputError
from servo_daemon.simulate import (
    PAPER_MOTOR,
    Motion,
    make_settings,
    parse_effect,
    parse_effects,
    simulate_capture,
)


def test_capture_says_how_it_was_made_and_what_is_true() -> None:
    block, metadata = simulate_capture(
        effects=["coulomb_friction:Tc=0.25"], seconds=2.0, rate_hz=500.0, seed=3, ageing=["R=+40%"], J_m=0.008,
        command="servo-daemon simulate --seconds 2",
    )  # fmt: skip
    assert len(block) == 1000
    assert metadata["seed"] == "3"
    assert metadata["rate_hz"] == "500"
    assert metadata["model"] == "coulomb_friction"
    assert metadata["counts_per_rev"] == "8192"
    assert metadata["command"] == "servo-daemon simulate --seconds 2"
    assert float(metadata["truth_R"]) == PAPER_MOTOR["R"]
    assert float(metadata["truth_end_R"]) == pytest.approx(1.4 * PAPER_MOTOR["R"], rel=1e-3)
    assert float(metadata["truth_Tc"]) == 0.25
    assert float(metadata["truth_J_d"]) == pytest.approx(PAPER_MOTOR["J"] - 0.008)
    assert [key for key in metadata if key.startswith("truth_end")] == ["truth_end_R"]
    assert not any("\n" in value for value in metadata.values())


def test_what_ages_the_load_ages_the_inertia_in_the_metadata() -> None:
    _, metadata = simulate_capture(seconds=0.5, ageing=["J_d=+0.001@0.1s"], J_m=0.008)
    assert float(metadata["truth_end_J"]) == pytest.approx(PAPER_MOTOR["J"] + 0.001)
    assert float(metadata["truth_end_J_d"]) == pytest.approx(PAPER_MOTOR["J"] - 0.007)


def test_a_capture_has_at_least_one_sample() -> None:
    assert len(simulate_capture(seconds=1e-6)[0]) == 1


def test_effect_texts() -> None:
    assert parse_effect("coulomb_friction") == ("coulomb_friction", {})
    assert parse_effect(" gravity_load : Tg = 0.5 , phi_g=-1e-1 ") == ("gravity_load", {"Tg": 0.5, "phi_g": -0.1})
    names, own = parse_effects({"gravity_load": {"Tg": 0.5}, "coulomb_friction": {}})
    assert (names, own) == (("gravity_load", "coulomb_friction"), {"Tg": 0.5})


@pytest.mark.parametrize(
    "effects, why",
    [
        (["colomb_friction"], "unknown effect 'colomb_friction'.*coulomb_friction"),
        (["coulomb_friction:Tx=1"], "unknown parameter 'Tx'.*Tc"),
        (["coulomb_friction:Tc"], "unknown parameter 'Tc'|Tc"),
        (["coulomb_friction:Tc=high"], "Tc = 'high' is not a number"),
        (["coulomb_friction:Tc=nan"], "outside"),
        (["coulomb_friction:Tc=-1"], "Tc = -1 N·m is outside"),
        (["coulomb_friction:Tc=1,Tc=2"], "Tc is given twice"),
        (["coulomb_friction", "coulomb_friction"], "named twice"),
        ([7], "not a text"),
        ({"coulomb_friction": 3}, "not a table"),
    ],
)
def test_wrong_effects_are_refused_by_name(effects: Any, why: str) -> None:
    with pytest.raises(BadInputError, match=why):
        make_settings(effects=effects)


@pytest.mark.parametrize(
    "arguments, why",
    [
        ({"rate_hz": 0.0}, "rate"),
        ({"rate_hz": math.nan}, "rate"),
        ({"seconds": -1.0}, "seconds"),
        ({"seed": -1}, "seed"),
        ({"supply_V": 0.0}, "supply_V"),
        ({"motor": {"Q": 1}}, "unknown parameter 'Q'"),
        ({"motor": {"R": "x"}}, "R = 'x'"),
        ({"motor": {"L": 0}}, "L = 0"),
        ({"J_m": -1.0}, "J_m"),
        ({"motion": "dance"}, "unknown motion 'dance'"),
        ({"dither_rms_V": -1.0}, "dither_rms_V"),
        ({"peak_speed_rad_s": math.inf}, "peak_speed_rad_s"),
        ({"sensors": {"noise": 1}}, "unknown sensor setting 'noise'"),
        ({"sensors": {"jitter_s": -1}}, "jitter_s"),
        ({"sensors": {"jitter_s": 6e-4}}, "jitter_s"),
        ({"sensors": {"current_noise_A": "loud"}}, "not a number"),
        ({"sensors": {"channels": ["smell"]}}, "smell"),
        ({"sensors": {"channels": []}}, "channels"),
    ],
)
def test_wrong_settings_are_refused_by_name(arguments: dict[str, Any], why: str) -> None:
    with pytest.raises(BadInputError, match=why):
        make_settings(**arguments)


def test_too_long_a_capture_is_refused() -> None:
    with pytest.raises(BadInputError, match="the most"):
        simulate_capture(seconds=1e9)


def test_mixed_motion_steps_fifty_degrees_and_is_continuous_elsewhere() -> None:
    t = np.arange(0, 64, 1e-3)
    reference = Motion(peak_speed_rad_s=8.0).reference(t)
    assert np.rad2deg(reference[1500]) == pytest.approx(50)
    jumps = np.abs(np.diff(reference))
    assert np.sum(jumps > 0.1) == 4 * 4  # four steps in each of four programmes
    assert np.all(jumps[jumps < 0.1] < 8.0 * 1e-3 * 1.5)
    np.testing.assert_allclose(reference[:16000], reference[16000:32000], rtol=0, atol=1e-9)
    assert np.max(np.abs(reference)) < 2.6  # within one turn of a potentiometer


def test_other_motions() -> None:
    t = np.linspace(0, 10, 100)
    assert not Motion("rest").reference(t).any()
    np.testing.assert_allclose(Motion("speed", peak_speed_rad_s=3.0).reference(t), 3 * t)
    assert set(np.rint(np.rad2deg(Motion("steps").reference(t)))) == {0, 50, -50}


@pytest.mark.parametrize("rate_hz", [20.0, 100.0, 1000.0])
def test_dither_has_its_size_and_stays_below_the_sample_rate(rate_hz: float) -> None:
    motion = Motion(dither_rms_V=1.4, rate_hz=rate_hz)
    t = np.arange(round(8 * rate_hz)) / rate_hz
    dither = motion.dither(t)
    assert np.std(dither) == pytest.approx(1.4, rel=1e-6)
    assert np.max(np.abs(dither)) < 3.4 * 1.4
    power = np.abs(np.fft.rfft(dither)) ** 2
    frequency = np.fft.rfftfreq(len(t), 1 / rate_hz)
    assert np.sum(power[frequency > 0.4 * rate_hz + 0.2]) < 1e-9 * np.sum(power)
    assert not Motion(dither_rms_V=0.0).dither(t).any()
