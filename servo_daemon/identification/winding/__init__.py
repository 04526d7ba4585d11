"""Captures whose voltage is a measurement: R, L and K from its balance, the rest from the motion."""

from servo_daemon.identification.winding.joined import (
    Winding,
    equivalents_of,
    joined_correlation,
    joined_parameters,
    one_meaning,
    winding_of,
)

__all__ = ["Winding", "equivalents_of", "joined_correlation", "joined_parameters", "one_meaning", "winding_of"]
