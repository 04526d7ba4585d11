"""Candidates with a second inertia, driven by the measured motion of the first: what it pulls back is missing.

With a rigid load the fit has J = J_m + J_l; behind a gap or a spring the load's own acceleration α_l differs from the
motor's, and d_T = J_l (α_l − dω/dt). J_l is the coefficient, gap and spring are scanned.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import casadi as ca
import numpy as np

from servo_daemon.diagnosis.screening.basis import Basis, Context, Family, positive
from servo_daemon.plant.compiled import SampleLoop
from servo_daemon.samples import F64

#: Gaps as what the working torque crosses in this time, s; springs' frequencies with the motor held, Hz, and damping.
_CROSSING_S = np.geomspace(2e-3, 2e-2, 6)
_FREQUENCIES_HZ, _DAMPING = np.geomspace(4.0, 120.0, 10), (0.05, 0.3)
#: The load on its teeth with the motor held, rad/s, and its damping; steps of the integration in a sample.
_CONTACTS_RAD_S, _CONTACT_DAMPING, _SUBSTEPS = np.array([200.0, 450.0]), 0.15, 4


@cache
def _gap_loop(count: int) -> SampleLoop:
    """Loads behind gaps and stiff springs, whose teeth press and never pull. Constants: gaps | contact frequencies.
    Sample: θ, ω at both ends of the step, h. Output: mean acceleration of the load."""
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
    mean = (speed - state[count:]) / row[4]
    return SampleLoop(ca.Function("step", [state, const, row], [ca.vertcat(angle, speed), mean]))


def _backlash(c: Context) -> Iterator[Basis]:
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

        yield Basis("backlash", (c.torque(f"gap {k}", load[:, k] - m.omega_rate),), start, 4)


def _compliance(c: Context) -> Iterator[Basis]:
    from scipy.signal import lfilter

    m = c.motion
    period = float(np.median(m.h))
    for f in [f for f in _FREQUENCIES_HZ.tolist() if f < 0.15 / period]:
        for zeta in _DAMPING:
            w, c2 = 2 * np.pi * f, 2 / period
            # (2ζws + w²)/(s² + 2ζws + w²) − 1 = −s²/(…) by Tustin's rule
            A = np.array([c2**2 + 2 * zeta * w * c2 + w**2, 2 * w**2 - 2 * c2**2, c2**2 - 2 * zeta * w * c2 + w**2])
            pulled = lfilter(-(c2**2) * np.array([1.0, -2.0, 1.0]) / A[0], A / A[0], m.omega_rate)

            def start(b: F64, w: float = w, zeta: float = zeta) -> dict[str, float] | None:
                if not positive(b[0]):
                    return None
                J_l = min(b[0], 0.9 * m.p["J"])
                return {"k_s": J_l * w**2, "c_s": 2 * zeta * w * J_l, "J_l": J_l}

            yield Basis("shaft_compliance", (c.torque(f"spring {f} {zeta}", pulled),), start, 3)


FAMILIES: dict[str, Family] = {"backlash": _backlash, "shaft_compliance": _compliance}
