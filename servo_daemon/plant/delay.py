"""A late sensor shows what was t_d before: by what each of the last steps did, however long each was.

For each of the last `LATE_STEPS` steps the states keep how much the channel changed in it, how much another state of
the core did, and its length (`LATE`). The wanted instant lies in one of them, whichever that is: time stamps may jitter
and samples be missing, and nothing is decided by the sample rate. Within a step the core moves as its two exponentials
let it; at a share σ of the step, with Z = A h, the rates r at its beginning and φ_k(Zσ) = α_k I + β_k Zσ (`flow.py`),

    current, speed   (i, ω)(σ) = (i, ω)(0) + σ φ_1(Zσ) r h                   r from both changes until the end
    angle            θ(σ) = θ(0) + ω(0) h σ + a σ² α_2(σ) + b σ³ β_2(σ)      a, b from the changes of θ and ω

which is exact for whatever input and load were held. Changes begin at zero wherever the motor stands. Delays beyond the
steps there are show the oldest value; a step before the first counts as long as the last.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import casadi as ca

from servo_daemon.plant import flow
from servo_daemon.plant.effects.base import LATE_STEPS, Delay, Terms

#: Shortest step, s. A kept length below half of it is none.
SHORTEST_S = 1e-9
#: To which lengths are known, s.
_RESOLUTION_S = 1e-12

_Phi = tuple[flow.MatrixFunction, flow.MatrixFunction, flow.MatrixFunction]


@dataclass(frozen=True)
class Step:
    """What a late channel did in a step: its change, the other one's (of current and angle: the speed's; of the speed:
    the current's), and the step's length, s."""

    change: ca.SX
    other: ca.SX
    length: ca.SX


def kept(states: ca.SX) -> list[Step]:
    """The last steps, the newest first, from the states `LATE`, shape (3 · LATE_STEPS,)."""
    parts = (states[k * LATE_STEPS : (k + 1) * LATE_STEPS] for k in range(3))
    return [Step(*values) for values in zip(*map(ca.vertsplit, parts), strict=True)]


def with_newest(states: ca.SX, newest: Step) -> ca.SX:
    """The states `LATE` after a step; the oldest is forgotten."""
    steps = [newest, *kept(states)[:-1]]
    return ca.vertcat(*[s.change for s in steps], *[s.other for s in steps], *[s.length for s in steps])


def behind(steps: Sequence[Step], seconds: ca.SX, speed: ca.SX, rates: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """What the channel was so many seconds before, less what it is now: as if it were current, angle or speed.

    Args:
        speed: present speed, rad/s.
        rates: A, shape (2, 2), 1/s: the core's homogeneous equations of current and speed.
    """
    # Rounded, for then nothing has a derivative by them, which would be half of all derivatives.
    rounded = [ca.floor(s.length / _RESOLUTION_S + 0.5) * _RESOLUTION_S for s in steps]
    lengths = [ca.fmax(ca.if_else(r > SHORTEST_S / 2, r, rounded[0]), SHORTEST_S) for r in rounded]
    begun = [sum(lengths[:k], start=ca.SX(0)) for k in range(1, len(steps))]
    # Sums over flags rather than a chain of choices: their derivatives are the flags.
    past = [ca.SX(1), *(ca.if_else(seconds > age, 1.0, 0.0) for age in begun), ca.SX(0)]
    here = [a - b for a, b in pairwise(past)]
    change, other, length = (
        _sum(here, [s.change for s in steps]),
        _sum(here, [s.other for s in steps]),
        _sum(here, lengths),
    )
    age, back, faster = (
        _sum(past[1:], values) for values in (lengths, [s.change for s in steps], [s.other for s in steps])
    )
    share, Z = ca.fmax(1 - (seconds - age) / length, 0.0), rates * length
    phi, at = flow.phi_matrix(Z), flow.phi_matrix(Z * share)
    current = _by_both(share, Z, (phi[1], at[1]), ca.vertcat(change, other))[0]
    velocity = _by_both(share, Z, (phi[1], at[1]), ca.vertcat(other, change))[1]
    steadily = (speed - faster - other) * length
    angle = steadily * share + _by_speeds(share, (phi, at), change - steadily, other * length)
    begin = -back - change
    return begin + current, begin + angle, begin + velocity


def _sum(weights: Sequence[ca.SX], values: Sequence[ca.SX]) -> ca.SX:
    return ca.dot(ca.vertcat(*weights[: len(values)]), ca.vertcat(*values))


def _by_both(share: ca.SX, Z: ca.SX, phi1: tuple[flow.MatrixFunction, flow.MatrixFunction], changes: ca.SX) -> ca.SX:
    """Changes of current and speed since the step's beginning, from those until its end.

    Args:
        phi1: at the end and at the share.
    """
    end, here = phi1
    # φ⁻¹ is the adjugate over the determinant; the adjugate of α I + β Z is (α + β tr Z) I − β Z.
    inverse = flow.MatrixFunction(end.alpha + end.beta * ca.trace(Z), -end.beta)
    determinant = end.alpha**2 + end.alpha * end.beta * ca.trace(Z) + end.beta**2 * ca.det(Z)
    rates = flow.apply(inverse, Z, changes) / determinant
    return share * flow.apply(here, Z * share, rates)


def _by_speeds(share: ca.SX, phi: tuple[_Phi, _Phi], change: ca.SX, faster: ca.SX) -> ca.SX:
    """The angle's change since then beyond that at the speed then, from those of angle and speed (as rad in the step)
    until its end."""
    (_, first, second), (_, _, here) = phi
    determinant = second.alpha * first.beta - second.beta * first.alpha
    a = (change * first.beta - second.beta * faster) / determinant
    b = (second.alpha * faster - change * first.alpha) / determinant
    return a * share**2 * here.alpha + b * share**3 * here.beta


def of_channel(delay: Delay, current: ca.SX, angle: ca.SX, speed: ca.SX) -> ca.SX:
    """That of the late channel: 0 current, 1 angle, 2 speed."""
    return ca.if_else(delay.channel < 0.5, current, ca.if_else(delay.channel < 1.5, angle, speed))


def delay_of(terms: Sequence[Terms]) -> Delay | None:
    """The late channel, where there is one."""
    return next((term.delay for term in terms if term.delay is not None), None)
