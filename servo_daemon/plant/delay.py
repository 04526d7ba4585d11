"""A late sensor: what it shows was t_d before, by samples kept and the exact solution between them.

With samples every h the wanted instant lies m = ⌊t_d/h⌋ whole steps and a rest r before the present one. Every step
computes the channel at r before its end (the core's own solution over h − r), and what was found so m steps ago is
shown. The states hold these values less the present one, so that they begin at zero wherever the motor stands:
`LATE[k]` is the value of k steps ago. Delays beyond the states there are show the oldest.
"""

from __future__ import annotations

import casadi as ca

from servo_daemon.plant.effects.base import Delay

#: Shortest stretch that is solved, s.
SHORTEST_S = 1e-9
#: A rest that lacks so little of a whole step (its share) counts as negative, and the solution goes on beyond the
#: step's end: jitter must not make a delay of two samples one of one step and a rest in one sample, of two in the next.
_NEARLY_WHOLE = 0.03


def rest_of_step(delay: Delay, h: ca.SX, kept: int) -> tuple[ca.SX, ca.SX]:
    """(m, r): whole steps and rest of the delay, of at most `kept` values."""
    steps = ca.fmin(delay.seconds / ca.fmax(h, SHORTEST_S), kept - 2 * _NEARLY_WHOLE)
    whole = ca.floor(steps + _NEARLY_WHOLE)
    return whole, (steps - whole) * h


def next_late(kept: ca.SX, whole: ca.SX, now: ca.SX, then: ca.SX, late: ca.SX) -> ca.SX:
    """The states after the step.

    Args:
        kept: states before it, shape (k,): the first is what is shown, less the channel's value; the others the values
            found in this and earlier steps, the same way.
        whole: m.
        now, then: the channel at the step's beginning and end.
        late: the channel at r before its end.
    """
    values = [late, *(kept[k] + now for k in range(1, kept.numel() - 1))]
    shown = values[0]
    for k, value in enumerate(values[1:], start=1):
        shown = ca.if_else(whole >= k, value, shown)
    return ca.vertcat(shown, *values) - then
