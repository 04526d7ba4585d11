"""Planning an experiment: the motion that says most, within what the drive may do.

    from servo_daemon.experiment import Request, Sensors, complete_limits, plan_motion
    limits, notes = complete_limits(motor, voltage_V=24.0, current_A=10.0)
    plan = plan_motion(Request(motor, (), ("coulomb_friction",), ("L",), (), limits, Sensors(4096, 0.02, 0.02)))
    plan.reference, plan.blocks, plan.worst

A plan is a mixture in time of motions out of a family: the exact design that is D-optimal for parameters (half of it
for the weakest), or T-optimal for two models (Atkinson & Fedorov 1975), on average over several motors that may be the
true one.
"""

from servo_daemon.experiment.answer import ExpectedError, ExpectedStd, expected_errors, expected_stds
from servo_daemon.experiment.limits import Limits, Peaks, complete_limits
from servo_daemon.experiment.loop import Reference, ServoGains, suitable_gains
from servo_daemon.experiment.plan import Block, MotionPlan
from servo_daemon.experiment.request import NOTHING, Request, Sensors, plan_motion

__all__ = [
    "NOTHING",
    "Block",
    "ExpectedError",
    "ExpectedStd",
    "Limits",
    "MotionPlan",
    "Peaks",
    "Reference",
    "Request",
    "Sensors",
    "ServoGains",
    "complete_limits",
    "expected_errors",
    "expected_stds",
    "plan_motion",
    "suitable_gains",
]
