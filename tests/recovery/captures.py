"""Captures of the independent generator as a fit takes them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from servo_daemon.identification.output_error.problem.problem import Problem
from servo_daemon.identification.output_error.problem.setup import Recording
from servo_daemon.kalman.gaussian import coordinates_of
from servo_daemon.samples import F64, make_block
from tests.recovery.generator import Motor, Scenario, generate


def capture(motor: Motor, scenario: Scenario) -> Recording:
    """Voltage, current and angle as they are recorded."""
    made = generate(motor, scenario)
    signals = {"voltage_V": made.voltage_V, "current_A": made.current_A, "position_rad": made.position_rad}
    return Recording("capture", make_block(made.time_s, **signals))


@dataclass(frozen=True)
class Known:
    """A model with these parameters, as if it had been fitted to one recording."""

    problem: Problem
    values: Mapping[str, float]

    def coordinates(self, recording: int = 0) -> F64:
        assert recording == 0
        return coordinates_of(self.problem.plant.parameters, self.values)
