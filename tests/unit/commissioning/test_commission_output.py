"""What `commission` tells of what hides in a drive: text and TOML."""

from __future__ import annotations

import tomllib
from typing import Any

import pytest

from servo_daemon.commands.commission.output import text, toml

LIMITS = {"voltage_V": 24.0, "current_A": 10.0, "speed_rad_s": 100.0, "travel_rad": 20.0}
FOUND = {
    "verdict": "found",
    "effects": ["backlash"],
    "causes": {"backlash": "Worn gear teeth."},
    "equivalent": {"backlash": ["shaft_compliance"]},
    "depends_on": [],
    "not_tried": [],
}
OPEN = FOUND | {"verdict": "unexplained", "effects": [], "depends_on": ["speed"], "not_tried": ["backlash"]}


def report(stop: dict[str, Any] | None, diagnosis: dict[str, Any] | None) -> dict[str, Any]:
    return {
        "drive": "axis1",
        "outcome": "unexplained" if stop is None else "stopped",
        "stop": stop,
        "motion_s": 12.0,
        "limits": LIMITS,
        "peaks": {"current_A": 1.0},
        "model": ["backlash"],
        "parameters": {"R": {"value": 1.0, "std": 0.01, "unit": "Ω", "status": "estimated"}},
        "diagnosis": diagnosis,
    }


@pytest.mark.parametrize(
    ("stop", "diagnosis", "said"),
    [
        (
            {"reason": "encoder_sign", "text": "the encoder has the wrong sign"},
            None,
            ["the encoder has the wrong sign"],
        ),
        (None, FOUND, ["found: backlash (or shaft_compliance): Worn gear teeth."]),
        (None, OPEN, ["names no cause; what is left follows speed", "was used up before backlash"]),
    ],
)
def test_text_and_toml_name_what_hides(
    stop: dict[str, Any] | None, diagnosis: dict[str, Any] | None, said: list[str]
) -> None:
    document = report(stop, diagnosis)
    for line in said:
        assert line in text(document, None)
        assert line in toml(document)
    assert tomllib.loads(toml(document))["drive"]["nominal"]["R"] == 1.0
