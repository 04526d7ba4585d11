"""Dry friction over one step: it holds exactly, slides exactly, and reverses within the step.

Acary & Brogliato, *Numerical Methods for Nonsmooth Dynamical Systems*, 2008, ch. 10 (Moreau's time stepping), with the
instant of a reversal found to second order.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

from servo_daemon.plant.effects import Terms

#: rad/s: divides where there is no speed at all.
_NO_SPEED = 1e-300


def friction_over_step(speed: ca.SX | None, free: ca.SX, per_load: ca.SX, forward: ca.SX, backward: ca.SX) -> ca.SX:
    """Dry friction as the mean torque over a step.

    Where the motion does not reverse it is the level against it. Where it does, the level acts until the speed is zero
    (found by linear interpolation), and from there on what would keep it zero, limited to its levels: sticking is
    exact, and a reversal within a step is no error of first order, which a larger model would take for Stribeck's
    effect.

    Args:
        speed: at the beginning; None: not known, and friction is that of the end (Moreau).
        free: speed at the end without friction.
        per_load: change of that speed per N·m.
        forward, backward: levels against positive and negative motion.
    """
    if speed is None:
        return ca.fmax(ca.fmin(-free / per_load, forward), -backward)
    # Not fabs, whose slope at rest is neither side's: a shaft that stands must not seem to keep a speed.
    size = ca.if_else(speed >= 0, speed, -speed)
    sliding = ca.if_else(speed >= 0, forward, -backward)
    end = free + per_load * sliding
    reverses = speed * end <= 0
    before = ca.if_else(reverses, size / ca.fmax(size + ca.fabs(end), _NO_SPEED), 1.0)
    afterwards = ca.fmax(ca.fmin((speed - free) / per_load, forward), -backward)
    return before * sliding + (1 - before) * afterwards


def dry_levels(terms: Sequence[Terms]) -> tuple[ca.SX, ca.SX]:
    """The dry friction against positive and against negative motion: the sum of the levels, scaled."""
    levels = [term.dry_levels for term in terms]
    forward, backward = (sum((ca.SX(level[k]) for level in levels), start=ca.SX(0)) for k in range(2))
    for term in terms:
        forward, backward = forward * term.factor_dry, backward * term.factor_dry
    return forward, backward
