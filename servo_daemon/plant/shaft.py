"""A second inertia behind the motor's: through a spring and damper, with or without a gap.

The step is split (Strang): half a step of the two inertias moving freely and exchanging momentum through the shaft, the
whole step's change of current and speed by everything else with the angles standing, and the other half. Each part is
exact, so none of them gains energy, and the whole is stable however stiff the spring and however long the step is; its
error is of second order in h. A motor that sticks is where it was after the two halves.

The states are relative, so that they begin at zero wherever the motor stands and however fast it turns: twist
δ = θ − θ_l and its rate δ' = ω − ω_l. With f = J_l/(J + J_l) the two inertias' common motion is that of θ − f δ, and

    μ δ'' = −k_s δ − c_s δ',   μ = J J_l/(J + J_l)

With a gap the teeth press and never pull: between the flanks δ' is constant, at a flank the twist counts from there,
and they part where the force falls to zero. One meeting in half a step is resolved, not a rattle within it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca

from servo_daemon.plant import flow
from servo_daemon.plant.core import Core
from servo_daemon.plant.effects.base import Shaft

#: A twist rate below this is none: the time until teeth meet is then longer than any step.
_NO_RATE = 1e-30
#: Longer than any step, s.
_FOR_EVER_S = 1e9


@dataclass(frozen=True)
class Meeting:
    """When teeth touch in half a step: free for `before`, in contact for `touching`, free for `after` (s); `flank` is
    the twist of the flank that they touch."""

    before: ca.SX
    touching: ca.SX
    after: ca.SX
    flank: ca.SX


@dataclass(frozen=True)
class TwoInertias:
    """The two inertias with what is between them, over half a step of length `half` (s)."""

    shaft: Shaft
    J: ca.SX
    half: ca.SX

    @property
    def share(self) -> ca.SX:
        """f = J_l/(J + J_l)."""
        return self.shaft.J_l / (self.J + self.shaft.J_l)

    def _in_contact(self, z: ca.SX, flank: ca.SX | float, seconds: ca.SX) -> ca.SX:
        """(δ', δ) after so many seconds on the spring."""
        mu = self.J * self.share
        Z = ca.vertcat(ca.horzcat(-self.shaft.c_s / mu, -self.shaft.k_s / mu), ca.horzcat(1, 0)) * seconds
        offset = ca.vertcat(0, flank)
        return flow.apply(flow.phi_matrix(Z)[0], Z, z - offset) + offset

    def _force(self, z: ca.SX, flank: ca.SX) -> ca.SX:
        return self.shaft.k_s * (z[1] - flank) + self.shaft.c_s * z[0]

    def meeting(self, z: ca.SX) -> Meeting | None:
        """When teeth touch, beginning with (δ', δ); None without a gap."""
        if self.shaft.gap is None:
            return None
        edge = self.shaft.gap / 2
        outside = ca.if_else(z[1] < 0, -1, 1)
        pressed = ca.logic_and(ca.fabs(z[1]) > edge, outside * self._force(z, outside * edge) > 0)
        side = ca.if_else(pressed, outside, ca.if_else(z[0] < 0, -1, 1))
        until = (edge - side * z[1]) / ca.fmax(ca.fabs(z[0]), _NO_RATE)
        before = ca.if_else(pressed, 0, ca.fmax(ca.fmin(until, self.half), 0))
        flank, left = side * edge, self.half - before
        met = ca.vertcat(z[0], z[1] + before * z[0])
        touching = ca.fmin(self._release(side * ca.vertcat(met[0], met[1] - flank)), left)
        # Apart again they may reach the other flank: the twist waits there for the next half step.
        parted = side * self._in_contact(met, flank, touching)
        across = (parted[1] + edge) / ca.fmax(-parted[0], _NO_RATE)
        return Meeting(before, touching, ca.fmax(ca.fmin(left - touching, across), 0), flank)

    def _release(self, z: ca.SX) -> ca.SX:
        """When the force of a contact ends that begins with (δ', δ), δ > 0 pressing: its first zero, s. It swings and
        decays like the twist, F'' = −(c_s F' + k_s F)/μ."""
        mu = self.J * self.share
        force = self.shaft.k_s * z[1] + self.shaft.c_s * z[0]
        decay = self.shaft.c_s / (2 * mu)
        slope = self.shaft.k_s * z[0] - decay * force  # F' + F c_s/(2 μ)
        square = self.shaft.k_s / mu - decay**2
        swings = square > 0
        omega = ca.sqrt(ca.fmax(ca.fabs(square), _NO_RATE))
        swinging = (math.pi - ca.atan2(omega * ca.fmax(force, 0), slope)) / omega
        # Overdamped: it ends only if the flanks part fast enough.
        ratio = -omega * force / ca.if_else(slope < 0, slope, -1)
        ends = ca.logic_and(slope < 0, ratio < 1)
        creeping = ca.if_else(ends, ca.atanh(ca.if_else(ends, ratio, 0)) / omega, _FOR_EVER_S)
        # At the flank rounding may leave no force yet.
        return ca.if_else(ca.logic_or(force > 0, z[0] > 0), ca.if_else(swings, swinging, creeping), 0)

    def over_half(self, x: ca.SX, z: ca.SX, meeting: Meeting | None, *, inhomogeneous: bool) -> tuple[ca.SX, ca.SX]:
        """Core states (…, ω, θ) and (δ', δ) after half a step: affine, given the meeting.

        Args:
            inhomogeneous: whether the flank's place counts (for a state), or not (for a derivative by something).
        """
        n = x.numel()
        if meeting is None:
            z1 = self._in_contact(z, 0, self.half)
        else:
            met = ca.vertcat(z[0], z[1] + meeting.before * z[0])
            parted = self._in_contact(met, meeting.flank if inhomogeneous else 0, meeting.touching)
            z1 = ca.vertcat(parted[0], parted[1] + meeting.after * parted[0])
        common = x[n - 2] - self.share * z[0]
        omega = common + self.share * z1[0]
        theta = x[n - 1] + self.half * common + self.share * (z1[1] - z[1])
        return ca.vertcat(x[: n - 2], omega, theta), z1


def standing(core: Core, x: ca.SX, z: ca.SX) -> Core:
    """The core's change of current and speed with the angles standing, over n + 2 states.

    Args:
        x, z: core states and (δ', δ) before it.
    """
    n = x.numel()

    def change(column: ca.SX) -> ca.SX:
        return ca.vertcat(column[: n - 1], 0, column[n - 2], 0)

    free = ca.vertcat(core.free[: n - 1], x[n - 1], z[0] + core.free[n - 2] - x[n - 2], z[1])
    return Core(free, change(core.per_input), change(core.per_load), change(core.per_slope))


def after_second_half(two: TwoInertias, core: Core, predicted: ca.SX) -> Core:
    """`standing` followed by the second half step, its meeting of the teeth that of the predicted state."""
    n = predicted.numel() - 2
    meeting = two.meeting(predicted[n:])

    def through(column: ca.SX, inhomogeneous: bool) -> ca.SX:
        return ca.vertcat(*two.over_half(column[:n], column[n:], meeting, inhomogeneous=inhomogeneous))

    return Core(
        through(core.free, True),
        through(core.per_input, False),
        through(core.per_load, False),
        through(core.per_slope, False),
    )
