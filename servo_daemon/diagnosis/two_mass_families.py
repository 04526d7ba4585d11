"""Candidates with a second inertia: it is driven by the measured motion of the first, and what it pulls back is missing.

With a rigid load the fit has J = J_m + J_l; behind a gap or a spring the load's own acceleration α_l differs from the
motor's, and d_T = J_l (α_l − dω/dt). J_l is the coefficient, gap and spring are scanned.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import casadi as ca
import numpy as np

from servo_daemon.diagnosis.basis import Basis, Context, Family, positive
from servo_daemon.plant.compiled import SampleLoop
from servo_daemon.samples import F64

#: Gaps as what the working torque crosses in this time, s; springs' frequencies with the motor held, Hz, and damping.
_CROSSING_S = np.geomspace(1.5e-3, 2e-2, 8)
_FREQUENCIES_HZ, _DAMPING = np.geomspace(4.0, 120.0, 10), (0.05, 0.3)
#: Of a stiff contact, for the start values only, rad/s.
_CONTACT_RAD_S, _CONTACT_DAMPING = 500.0, 0.1


@cache
def _gap_loop(count: int) -> SampleLoop:
    """Loads behind gaps of several widths, in rigid contact without rebound. Sample: θ, ω after the step, h."""
    state, gaps, row = ca.SX.sym("state", 2 * count), ca.SX.sym("gaps", count), ca.SX.sym("row", 3)
    angle, speed = state[:count], state[count:]
    free = angle + speed * row[2]
    ahead, behind = row[0] + gaps / 2, row[0] - gaps / 2
    pressed = ca.logic_or(free >= ahead, free <= behind)
    new_angle = ca.fmax(ca.fmin(free, ahead), behind)
    # A flank that recedes from the load does not hold it back.
    pushed = ca.if_else(free >= ahead, ca.fmin(speed, row[1]), ca.fmax(speed, row[1]))
    new_speed = ca.if_else(pressed, pushed, speed)
    step = ca.Function("step", [state, gaps, row], [ca.vertcat(new_angle, new_speed), (new_speed - speed) / row[2]])
    return SampleLoop(step)


def _backlash(c: Context) -> Iterator[Basis]:
    m = c.motion
    strength = float(np.std(m.omega_rate))
    gaps = strength * _CROSSING_S**2
    theta, omega = m.at_sample["position_rad"], m.at_sample["velocity_rad_s"]
    rows = np.ascontiguousarray(
        np.stack([np.append(theta[1:], theta[-1]), np.append(omega[1:], omega[-1]), m.h], axis=1)
    )
    begin = np.concatenate([np.full(len(gaps), theta[0]), np.full(len(gaps), omega[0])])
    load = _gap_loop(len(gaps)).run(begin, gaps, rows)
    for k, gap in enumerate(gaps.tolist()):

        def start(b: F64, gap: float = gap) -> dict[str, float] | None:
            if not positive(b[0]):
                return None
            J_l = min(b[0], 0.9 * m.p["J"])
            return {"gap": gap, **_spring(m.p["J"] - J_l, J_l, _CONTACT_RAD_S, _CONTACT_DAMPING)}

        yield Basis("backlash", (c.torque(f"gap {gap}", load[:, k] - m.omega_rate),), start, 4)


def _spring(J_m: float, J_l: float, frequency: float, damping: float) -> dict[str, float]:
    """Spring and damper of a resonance, both inertias free."""
    reduced = J_m * J_l / (J_m + J_l)
    return {"k_s": reduced * frequency**2, "c_s": 2 * damping * frequency * reduced, "J_l": J_l}


def _compliance(c: Context) -> Iterator[Basis]:
    from scipy.signal import lfilter

    m = c.motion
    period = float(np.median(m.h))
    for f in _FREQUENCIES_HZ[0.15 / period > _FREQUENCIES_HZ].tolist():
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
