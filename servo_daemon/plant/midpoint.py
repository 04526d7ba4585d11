"""What of a step is to be evaluated at its midpoint, which is only known after a first guess."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

from servo_daemon.plant.dry import dry_levels
from servo_daemon.plant.effects import Terms


def factors_follow_motion(core: ca.SX, terms: Sequence[Terms]) -> bool:
    """Whether R, K or B as scaled depends on current, speed or angle, whose midpoint needs a guess.

    Args:
        core: symbols of the core's states, of which the terms are made.
    """
    names = ("factor_R", "factor_K", "factor_B", "viscous", "moment_K")
    factors = ca.vertcat(*[ca.SX(getattr(term, name)) for term in terms for name in names])
    return bool(terms) and bool(ca.depends_on(factors, core))


def guess_needs_friction(core: ca.SX, terms: Sequence[Terms]) -> bool:
    """Whether what acts at the midpoint depends on current or speed there, which dry friction changes to first order
    within a step (the angle only to second).

    Args:
        core: as for `factors_follow_motion`; the angle is the last.
    """
    if not terms:
        return False
    names = ("load_torque", "voltage_drop", "factor_dry", "viscous", "dry_drop")
    acting = [ca.SX(getattr(term, name)) for term in terms for name in names] + list(dry_levels(terms))
    return bool(ca.depends_on(ca.vertcat(*acting), core[:-1]))
