"""Commissioning: a motor is moved, small first, until its parameters are known; a supervisor stops it on any doubt."""

from servo_daemon.commissioning.limits import MotionLimits
from servo_daemon.commissioning.run import Ask, Commissioning, commission, unknown_in
from servo_daemon.commissioning.stop import Stop

__all__ = ["Ask", "Commissioning", "MotionLimits", "Stop", "commission", "unknown_in"]
