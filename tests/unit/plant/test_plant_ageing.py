"""Ageing texts and what they do to the true parameters."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.errors import BadInputError
from servo_daemon.parameters import LINEAR
from servo_daemon.plant.ageing import Ageing, ageing_texts, parse_ageing, parse_profile
from servo_daemon.plant.build import build_plant
from servo_daemon.samples import F64

START = np.array([p.nominal for p in LINEAR])
NAMES = [p.name for p in LINEAR]


def aged(*texts: str, t: F64, seconds: float | None = None, J_m: float | None = None, seed: int = 0) -> dict[str, F64]:
    values = Ageing(LINEAR, START, parse_ageing(texts, seconds, seed), J_m).values(np.asarray(t, dtype=float))
    return dict(zip(NAMES, values.T / START[:, None], strict=True))


@pytest.mark.parametrize(
    "text, at, factor",
    [
        ("R=+40%", [0, 50, 100], [1, 1.2, 1.4]),  # over the whole capture, 100 s
        ("R=+40%/300s", [0, 150, 300, 1e6], [1, 1.2, 1.4, 1.4]),  # held afterwards
        ("R=−40 % / 5 min", [0, 150, 300], [1, 0.8, 0.6]),  # a typographic minus, spaces, minutes
        ("R=+40%/min", [30, 60], [1.2, 1.4]),
        ("R=+40%/300s:linear", [150], [1.2]),
        ("R=+40%/300s@60s", [0, 60, 210, 360], [1, 1, 1.2, 1.4]),
        ("R=+40%/300s:exp", [0, 300, 3e5], [1, 1 + 0.4 * (1 - np.exp(-1)), 1.4]),
        ("R=+30%@12s", [0, 11.999, 12, 1e5], [1, 1, 1.3, 1.3]),
        ("R=+30%@12s:step", [11.999, 12], [1, 1.3]),
        ("R=+40%@20s:linear", [20, 60, 100], [1, 1.2, 1.4]),  # from 20 s to the end
        ("R=+0.04937@0s", [0], [1.1]),  # absolute, Ω
        ("R=+1e-1", [100], [1 + 0.1 / START[0]]),
    ],
)
def test_forms(text: str, at: list[float], factor: list[float]) -> None:
    result = aged(text, t=np.array(at), seconds=100.0)
    np.testing.assert_allclose(result["R"], factor, rtol=1e-12)
    for other in "LKJB":
        np.testing.assert_array_equal(result[other], 1.0)


def test_load_inertia_adds_to_the_inertia() -> None:
    J = START[3]
    np.testing.assert_allclose(aged("J_d=+0.003@10s", t=np.array([9.0, 10.0]))["J"] * J, [J, J + 0.003], rtol=1e-12)
    relative = aged("J_d=+50%@10s", t=np.array([9.0, 10.0]), J_m=J - 0.002)["J"] * J
    np.testing.assert_allclose(relative, [J, J + 0.001], rtol=1e-12)
    walked = aged("J_d=5%/sqrt(min)", t=np.linspace(0, 600, 50), J_m=J - 0.002)["J"] * J
    assert np.all(walked > J - 0.002)  # a load that wanders stays a load
    assert np.ptp(walked) > 1e-6


def test_profiles_of_one_parameter_add_up() -> None:
    np.testing.assert_allclose(aged("R=+10%@1s", "R=+20%@2s", t=np.array([0.0, 1.0, 2.0]))["R"], [1, 1.1, 1.3])


@pytest.mark.parametrize("text", ["K=5%/sqrt(min):walk", "K=5%/sqrt(min)", "K=5%/min:walk", "K=5 %/sqrt( 60 s )"])
def test_a_walk_has_the_spread_it_says(text: str) -> None:
    after = [np.log(aged(text, t=np.array([0.0, 60.0, 240.0]), seed=s)["K"]) for s in range(400)]
    assert np.all(np.array(after)[:, 0] == 0)
    np.testing.assert_allclose(np.std(after, axis=0)[1:], [0.05, 0.10], rtol=0.12)  # 5 % · √minutes


def test_a_walk_depends_on_its_seed_and_not_on_how_it_is_asked() -> None:
    t = np.linspace(0, 5000, 777)
    whole = aged("K=5%/sqrt(min)", t=t)["K"]
    parts = np.concatenate([aged("K=5%/sqrt(min)", t=part)["K"] for part in np.array_split(t, 13)])
    np.testing.assert_array_equal(whole, parts)
    assert not np.array_equal(whole, aged("K=5%/sqrt(min)", t=t, seed=1)["K"])
    two = aged("K=5%/sqrt(min)", "R=5%/sqrt(min)", t=t)
    assert abs(np.corrcoef(np.diff(two["K"]), np.diff(two["R"]))[0, 1]) < 0.2


def test_values_stay_within_bounds() -> None:
    wild = aged("B=300%/sqrt(s)", t=np.linspace(0, 3e4, 1000))["B"] * START[4]
    assert np.all(np.isfinite(wild))
    assert wild.min() >= LINEAR[4].lower
    assert wild.max() <= LINEAR[4].upper
    assert wild.max() / wild.min() > 1e6


@pytest.mark.parametrize(
    "text, why",
    [
        ("R", "form"),
        ("R=", "form"),
        ("R=+40", "outside|form|end"),  # absolute 40 Ω over the capture needs an end
        ("R=40%", r"\+ or -"),
        ("R=+40%/0s", "greater than zero"),
        ("R=+40%/parsec", "form"),
        ("R=+40%:sawtooth", "form"),
        ("R=+40%", "needs a time"),
        ("R=+40%:exp", "needs a time"),
        ("R=+40%:step", "moment"),
        ("R=+40%/3s@1s:step", "moment"),
        ("K=5%:walk", "pace"),
        ("K=5%/sqrt(min):exp", "random walk"),
        ("R=+1e999%/3s", "too large"),
        ("=+40%", "form"),
        ("R=+nan%/3s", "form"),
    ],
)
def test_nonsense_is_refused(text: str, why: str) -> None:
    with pytest.raises(BadInputError, match=why) as caught:
        parse_profile(text)
    assert text in str(caught.value)


def test_a_change_that_would_start_after_the_end_is_refused() -> None:
    with pytest.raises(BadInputError, match="after the end"):
        parse_profile("R=+40%@20s:linear", seconds=10.0)


@pytest.mark.parametrize(
    "text, why",
    [
        ("Q=+40%/3s", "no such parameter"),
        ("Tc=+40%/3s", "no such parameter"),  # not in this model
        ("R=-100%/3s", "R would become 0"),
        ("K=-0.4/3s", "K would become"),
        ("J_d=+40%/3s", "J_m"),
        ("J_d=-0.1/3s", "J would become"),
    ],
)
def test_impossible_changes_are_refused_by_name(text: str, why: str) -> None:
    with pytest.raises(BadInputError, match=why):
        aged(text, t=np.zeros(1))


def test_effects_age_too() -> None:
    model = build_plant(("coulomb_friction",))
    start = np.array([p.nominal for p in model.parameters])
    ageing = Ageing(model.parameters, start, parse_ageing(["Tc=+50%/10s"]))
    assert ageing.values(np.array([10.0]))[0, 5] == pytest.approx(1.5 * start[5])
    assert ageing.changing == ("Tc",)


def test_tables_and_lists_mean_the_same() -> None:
    assert ageing_texts({"R": "+1%/s", "J_d": ["+1e-3@1s", "+1e-3@2s"]}) == ("R=+1%/s", "J_d=+1e-3@1s", "J_d=+1e-3@2s")
    assert ageing_texts(["R=+1%/s"]) == ageing_texts("R=+1%/s") == ("R=+1%/s",)
    for wrong in ({"R": 5}, {"R": ["+1%", 7]}, [3], 3):
        with pytest.raises(BadInputError, match="not a text"):
            ageing_texts(wrong)  # type: ignore[arg-type]
