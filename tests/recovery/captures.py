"""Captures of the independent generator as a fit takes them."""

from __future__ import annotations

from servo_daemon.estimators.output_error.setup import Recording
from servo_daemon.samples import make_block
from tests.recovery.generator import Motor, Scenario, generate


def capture(motor: Motor, scenario: Scenario) -> Recording:
    """Voltage, current and angle as they are recorded."""
    made = generate(motor, scenario)
    signals = {"voltage_V": made.voltage_V, "current_A": made.current_A, "position_rad": made.position_rad}
    return Recording("capture", make_block(made.time_s, **signals))
