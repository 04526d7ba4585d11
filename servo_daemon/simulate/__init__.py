"""Simulation: the plant with servo, sensors and ageing as a source of samples."""

from servo_daemon.simulate.capture import simulate_capture
from servo_daemon.simulate.drive import SimulatedDrive, drive_info
from servo_daemon.simulate.motion import Motion
from servo_daemon.simulate.settings import (
    DEFAULT_AGEING,
    DEFAULT_J_M,
    DEFAULT_NOMINAL,
    PAPER_MOTOR,
    Sensors,
    Settings,
    make_settings,
    parse_effect,
    parse_effects,
)

__all__ = [
    "DEFAULT_AGEING",
    "DEFAULT_J_M",
    "DEFAULT_NOMINAL",
    "PAPER_MOTOR",
    "Motion",
    "Sensors",
    "Settings",
    "SimulatedDrive",
    "drive_info",
    "make_settings",
    "parse_effect",
    "parse_effects",
    "simulate_capture",
]
