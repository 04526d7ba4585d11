"""Values that stand to their nominal ones as an angle in another scale makes them, and values that do not."""

from __future__ import annotations

from dataclasses import replace

import pytest

from servo_daemon.conditioning.angle_scale import angle_hint
from servo_daemon.config import parse_config
from servo_daemon.pipeline.drive_warnings import DriveWarnings
from servo_daemon.published.snapshot import Estimate, ParameterEstimate

TRUE = {"R": 0.039, "K": 0.025, "J": 4e-4, "B": 1.5e-3}


def scaled(f: float, names: str = "RKJB") -> dict[str, float | None]:
    """As found with an angle that is f times too small."""
    return {n: v * {"R": 1.0, "K": f, "J": f * f, "B": f * f}[n] for n, v in TRUE.items() if n in names}


@pytest.mark.parametrize(
    ("f", "names", "gear", "said"),
    [
        (0.5, "RKJB", 2.0, "gear_ratio = 2 right"),
        (0.1, "RK", 10.0, "gear_ratio = 10 right"),
        (1 / 7, "JB", 7.0, "gear_ratio = 7 right"),
        (3.0, "RKJB", 1 / 3, "gear_ratio = 0.333333 right"),
        (4.0, "RKJB", 1.0, "told 4 times too large"),
        (0.5, "RKJB", 1.0, "told 2 times too small"),
        (9.0, "RKJB", 1.0, "behind a gear of 8.57 turns"),
    ],
)
def test_an_angle_in_another_scale_is_told(f: float, names: str, gear: float, said: str) -> None:
    hint = angle_hint(scaled(f, names), {n: 1.05 * v for n, v in TRUE.items()}, gear)
    assert hint is not None and said in hint


@pytest.mark.parametrize(
    ("found", "gear"),
    [
        (scaled(1.0), 1.0),
        (scaled(1.0), 2.0),
        (scaled(1.0), 1.1),
        ({**scaled(0.5), "J": TRUE["J"]}, 2.0),  # another K, and the same inertia
        ({**scaled(1.0), "K": 2.0 * TRUE["K"]}, 1.0),
        ({**scaled(1.0), "J": 30.0 * TRUE["J"]}, 1.0),  # a load
        (scaled(2.0, "K"), 1.0),
        ({"K": None, "J": 0.0}, 2.0),
        ({}, 2.0),
    ],
)
def test_other_values_say_nothing_of_it(found: dict[str, float | None], gear: float) -> None:
    assert angle_hint(found, TRUE, gear) is None
    assert angle_hint(scaled(0.5), {}, 2.0) is None


def test_the_daemon_says_it_once_and_as_long_as_it_shows() -> None:
    table = {"name": "a", "driver": "simulated", "nominal": {"K": 0.025}, "signals": {"gear_ratio": 2.0}}
    warnings = DriveWarnings(parse_config({"drive": [table]}).drive[0])

    def estimate(K: float, std: float, status: str = "tracking") -> Estimate:
        p = ParameterEstimate("K", K, std, "", 0.025, status)  # type: ignore[arg-type]
        return Estimate(1.0, 1, 1e3, (), (p,), {}, {}, {}, None)

    unsure, _ = warnings.update(estimate(0.0125, 0.005))
    assert "scale_hint" not in unsure.health
    shown, told = warnings.update(estimate(0.0125, 1e-4))
    assert [kind for kind, _, _ in told] == ["scale_suspected"]
    assert "gear_ratio = 2 right" in str(shown.health["scale_hint"])
    again, told = warnings.update(replace(estimate(0.0126, 1e-4), time_s=2.0))
    assert told == [] and "scale_hint" in again.health
    right, told = warnings.update(estimate(0.025, 1e-4))
    assert told == [] and "scale_hint" not in right.health
