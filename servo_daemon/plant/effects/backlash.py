"""Backlash: the load follows through a gap."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import casadi as ca
import numpy as np

from servo_daemon.parameters import Parameter
from servo_daemon.plant.columns.screening import Basis, Context, positive
from servo_daemon.plant.compiled import SampleLoop
from servo_daemon.plant.effects.base import TWIST, Effect, Shaft, Signals, Terms
from servo_daemon.plant.effects.shaft_compliance import C_S, J_L, K_S, SHAFT
from servo_daemon.samples import F64

GAP = Parameter(
    "gap", "g", "rad", 0.01, 1e-09, 10.0, "log", "whole free angle between the flanks", "start value", held="live"
)

#: Gaps that are tried, as what the working torque crosses in this time, s.
_CROSSING_S = np.geomspace(2e-3, 2e-2, 6)
#: The load on its teeth with the motor held, rad/s, and its damping; steps of the integration in a sample.
_CONTACTS_RAD_S, _CONTACT_DAMPING, _SUBSTEPS = np.array([200.0, 450.0]), 0.15, 4
#: Radians of the contact in a step below which the semi-implicit Euler method is stable: a² + 4 ζ a < 4.
_FOLLOWED = 2.0 * (np.hypot(1.0, _CONTACT_DAMPING) - _CONTACT_DAMPING)


def _terms(s: Signals) -> Terms:
    return Terms(shaft=Shaft(s.p["J_l"], s.p["k_s"], s.p["c_s"], s.p["gap"]))


@cache
def _gap_loop(count: int) -> SampleLoop:
    """Loads behind gaps and stiff springs, whose teeth press and never pull. Constants: gaps | contact frequencies.
    Sample: θ, ω at both ends of the step, h. Output: mean acceleration of the load. Over a step too long to follow the
    teeth, where samples are missing, the load goes on with the motor."""
    state, const, row = ca.SX.sym("state", 2 * count), ca.SX.sym("const", 2 * count), ca.SX.sym("row", 5)
    gap, w = const[:count], const[count:]
    angle, speed, dt = state[:count], state[count:], row[4] / _SUBSTEPS
    for k in range(_SUBSTEPS):
        at = (k + 0.5) / _SUBSTEPS
        motor, motor_speed = row[0] + at * (row[1] - row[0]), row[2] + at * (row[3] - row[2])
        twist = motor - angle
        over = ca.sign(twist) * ca.fmax(ca.fabs(twist) - gap / 2, 0.0)
        press = w**2 * over + ca.if_else(over != 0, 2 * _CONTACT_DAMPING * w * (motor_speed - speed), 0.0)
        press = ca.if_else(over * press > 0, press, 0.0)
        speed = speed + press * dt
        angle = angle + speed * dt
    lost = w * dt > _FOLLOWED
    angle, speed = ca.if_else(lost, row[1], angle), ca.if_else(lost, row[3], speed)
    mean = (speed - ca.if_else(lost, row[2], state[count:])) / row[4]
    return SampleLoop(ca.Function("step", [state, const, row], [ca.vertcat(angle, speed), mean]))


def _screening(c: Context) -> Iterator[Basis]:
    m = c.motion
    gaps, w = (g.ravel() for g in np.meshgrid(float(np.std(m.omega_rate)) * _CROSSING_S**2, _CONTACTS_RAD_S))
    theta, omega = m.at_sample["position_rad"], m.at_sample["velocity_rad_s"]
    ends = [theta, np.append(theta[1:], theta[-1]), omega, np.append(omega[1:], omega[-1]), m.h]
    begin = np.concatenate([np.full(len(gaps), theta[0]), np.full(len(gaps), omega[0])])
    load = _gap_loop(len(gaps)).run(begin, np.concatenate([gaps, w]), np.ascontiguousarray(np.stack(ends, axis=1)))
    for k in range(len(gaps)):

        def start(b: F64, k: int = k) -> dict[str, float] | None:
            if not positive(b[0]):
                return None
            J_l = min(b[0], 0.9 * m.p["J"])
            k_s = J_l * float(w[k]) ** 2
            return {"gap": float(gaps[k]), "k_s": k_s, "c_s": 2 * _CONTACT_DAMPING * k_s / float(w[k]), "J_l": J_l}

        yield Basis((c.torque(f"gap {k}", load[:, k] - m.omega_rate),), start, 4)


EFFECT = Effect(
    name="backlash",
    cause="Worn gear teeth, a key or a claw coupling have play: the load follows only after the gap is crossed.",
    equation=r"J_l\dot\omega_l = k_s\left(\delta \mp \tfrac{g}{2}\right) + c_s\dot\delta \text{ where flanks press},"
    r"\ \delta = \theta - \theta_l",
    parameters=(GAP, K_S, C_S, J_L),
    terms=_terms,
    hides={K_S.name: SHAFT, J_L.name: SHAFT},
    # Within a gap the load is where no sensor sees it, and a filter that has taken it for pressed against the wrong
    # flank is sure of what it makes of that (k_s 96 % off at 300 std).
    never_sure={GAP.name: SHAFT},
    screening=_screening,
    ladder=260,
    simpler=(("shaft_compliance",),),
    states=TWIST,
    substeps=2,
)
