"""Dry friction over one step: it holds exactly, slides exactly, and reverses within the step.

Acary & Brogliato, *Numerical Methods for Nonsmooth Dynamical Systems*, 2008, ch. 10 (Moreau's time stepping), with the
instant of a reversal found by the speed's own exponential: a step may last many of the motor's time constants.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

from servo_daemon.plant.core import Core
from servo_daemon.plant.effects import Terms

#: Divides where there is no speed at all.
_NOTHING = 1e-300
#: A step that leaves more than this of a speed is short: a line and one torque for all states are then within 2 % of
#: what a friction makes that turns round (measured: four motors at 1 kHz), and what is more exact is seldom seen.
_SHORT = 0.9


def friction_over_step(
    speed: ca.SX | None, free: ca.SX, per_load: ca.SX, kept: ca.SX, forward: ca.SX, backward: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """Dry friction as the constant torque over a step that makes the speed at its end, and that which makes the angle.

    Where the motion does not reverse it is the level against it. Where it does, the level acts until the speed is zero,
    and from there on what would keep it zero, limited to its levels: sticking is exact, and a reversal within a step is
    no error of first order, which a larger model would take for Stribeck's effect. Of what acted before the reversal
    the end remembers what a speed leaves of itself: with ω = ω∞ + (ω₀ − ω∞) e^(−t/τ) and E = e^(−h/τ) the torque
    before counts for  E |ω₀| / (E |ω₀| + |ω(h)|)  of the speed. The angle is two integrals of a torque: what acts after
    a share ρ of the time counts for (1 − ρ)², and ρ is e |ω₀| / (e |ω₀| + |ω(h)|), e ≈ √E by its Padé
    approximant, for long steps better than the root itself.

    Of a short step (`_SHORT`) E is 1 and both torques are that of the speed.

    Args:
        speed: at the beginning; None: not known, and friction is that of the end (Moreau).
        free: speed at the end without friction.
        per_load: change of that speed per N·m.
        kept: E.
        forward, backward: levels against positive and negative motion.
    """
    if speed is None:
        friction = ca.fmax(ca.fmin(-free / per_load, forward), -backward)
        return friction, friction
    short = kept > _SHORT
    kept = ca.if_else(short, 1, ca.fmax(kept, 0))  # a winding slower than the shaft makes it swing beyond zero
    # Not fabs, whose slope at rest is neither side's: a shaft that stands must not seem to keep a speed.
    size = ca.if_else(speed >= 0, speed, -speed)
    sliding = ca.if_else(speed >= 0, forward, -backward)
    end = free + per_load * sliding
    reverses = speed * end <= 0
    afterwards = ca.fmax(ca.fmin((kept * speed - free) / per_load, forward), -backward)

    def before(size: ca.SX) -> ca.SX:
        return ca.if_else(reverses, size / ca.fmax(size + ca.fabs(end), _NOTHING), 1.0)

    root = (1 + 10 * kept + 5 * kept**2) / (5 + 10 * kept + kept**2)
    earlier = before(kept * size)
    friction = earlier * sliding + (1 - earlier) * afterwards
    turning = sliding - (1 - before(root * size)) ** 2 * (sliding - afterwards)
    return friction, ca.if_else(short, friction, turning)


def rubbing(core: Core, angle: int, friction: ca.SX, turning: ca.SX) -> ca.SX:
    """What dry friction does to the states: `turning` to the angle, `friction` to the speed; to a current both, the
    former the more the slower the winding is (`Core.sluggish`; without a current nothing).

    Args:
        angle: its row.
    """
    done = core.per_load * friction
    done[angle] = core.per_load[angle] * turning
    done[0] += core.per_load[0] * core.sluggish * (turning - friction)
    return done


def dry_levels(terms: Sequence[Terms]) -> tuple[ca.SX, ca.SX]:
    """The dry friction against positive and against negative motion: the sum of the levels, scaled."""
    levels = [term.dry_levels for term in terms]
    forward, backward = (sum((ca.SX(level[k]) for level in levels), start=ca.SX(0)) for k in range(2))
    for term in terms:
        forward, backward = forward * term.factor_dry, backward * term.factor_dry
    return forward, backward
