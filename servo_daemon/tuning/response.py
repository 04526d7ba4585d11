"""What a loop does with its reference: bandwidth, step response, and the voltage that a step asks for."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from servo_daemon.samples import F64
from servo_daemon.tuning.margins import grid, return_ratio
from servo_daemon.tuning.sampled import MEAN_SPEED, SPEED, Controller, SampledMotor, closed_loop, voltage_row

#: Points of a step response at most; a slow loop at a high rate is shown at every q-th sample.
_POINTS = 4000
#: Band around the final value in which a step counts as settled.
SETTLED = 0.02


@dataclass(frozen=True, slots=True)
class Response:
    """To a small step of the reference, at the estimate. None: never, within the time that was looked at.

    Attributes:
        bandwidth_hz: where the response to the reference has first fallen by 3 dB.
        settling_s: until it stays within 2 %. rise_s: from 10 to 90 %. overshoot_percent: beyond the final value.
        peak_V: largest voltage per unit of the step (V per rad/s or V per rad).
    """

    bandwidth_hz: float | None
    settling_s: float | None
    rise_s: float | None
    overshoot_percent: float | None
    peak_V: float


def bandwidth_hz(motor: SampledMotor, controller: Controller) -> float | None:
    """−3 dB of the reference's response, of the first motor, Hz; None: not below Nyquist's frequency."""
    omega = grid(motor.period_s)
    size = reference_response(motor, controller, omega)
    below = np.flatnonzero((size[1:] < math.sqrt(0.5)) & (size[:-1] >= math.sqrt(0.5)))
    if not len(below):
        return None
    k = int(below[0])
    share = (np.log(size[k]) + 0.5 * math.log(2.0)) / np.log(size[k] / size[k + 1])
    return float(np.exp(np.log(omega[k]) + share * np.log(omega[k + 1] / omega[k])) / (2 * np.pi))


def reference_response(motor: SampledMotor, controller: Controller, omega: F64) -> F64:
    """|angle or speed over its reference| of the first motor, shape (len(omega),)."""
    z = np.exp(1j * omega * motor.period_s)
    w, _ = motor.response(z)
    _, _, per_r = controller.response(z)
    out = w[0] * per_r / (1.0 + return_ratio(motor, controller, omega)[0])
    if controller.position:
        out = out * motor.period_s * z / (z - 1.0)
    return np.asarray(np.abs(out))


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """A unit step of the reference: time (s), speed or angle, and voltage, each shape (n,)."""

    time_s: F64
    shown: F64
    voltage_V: F64


def step(motor: SampledMotor, controller: Controller, duration_s: float) -> Step:
    """The first motor's response to a unit step at time 0."""
    A, B = closed_loop(motor, controller)
    n = max(2, math.ceil(duration_s / motor.period_s))
    every = max(1, math.ceil(n / _POINTS))
    augmented = np.eye(A.shape[1] + 1)  # the reference is a state that stays 1
    augmented[:-1, :-1], augmented[:-1, -1] = A[0], B[0]
    states = _powers(np.linalg.matrix_power(augmented, every), n // every + 1)
    row = voltage_row(motor, controller)
    voltage = states[:, :-1] @ row + controller.D_r
    if every > 1:  # the peak of the voltage is at the beginning
        first = _powers(augmented, every)[:, :-1] @ row + controller.D_r
        voltage[0] = first[np.abs(first).argmax()]
    time = np.arange(len(states), dtype=np.float64) * (every * motor.period_s)
    return Step(time, states @ _shown(motor, controller), voltage)


def _shown(motor: SampledMotor, controller: Controller) -> F64:
    """Row of (motor, controller, 1) that gives the speed, or the angle: θ[k] = θ[k−1] + T w[k]."""
    row = np.zeros(motor.B.shape[1] + len(controller.A) + 1)
    if not controller.position:
        row[SPEED] = 1.0
        return row
    row[MEAN_SPEED] = motor.period_s
    row[motor.B.shape[1] + _angle_state(controller, motor.period_s)] = 1.0
    return row


def _angle_state(controller: Controller, period_s: float) -> int:
    """The controller's state that sums the angle up: the one that grows by T w and by nothing else."""
    alone = np.eye(len(controller.A))
    for k in range(len(controller.A)):
        if np.array_equal(controller.A[k], alone[k]) and controller.B_y[k, 0] == period_s and controller.B_r[k] == 0:
            return k
    raise ValueError("this controller does not hold the angle")


def _powers(A: F64, n: int) -> F64:
    """A^k (0, …, 0, 1) for k < n, shape (n, m), by doubling."""
    states = np.zeros((1, len(A)))
    states[0, -1] = 1.0
    power = A
    while len(states) < n:
        states = np.concatenate((states, states @ power.T))
        power = power @ power
    return states[:n]


def duration_s(motor: SampledMotor, controller: Controller) -> float:
    """Long enough for a step of the first motor's loop: its slowest mode has decayed to 1e-4."""
    A, _ = closed_loop(motor, controller)
    radius = float(np.abs(np.linalg.eigvals(A[0])).max())
    if radius >= 1.0:
        return 1000 * motor.period_s
    return min(1e6, max(20.0, math.log(1e-4) / math.log(max(radius, 1e-12)))) * motor.period_s


def settling_s(motor: SampledMotor, controller: Controller, duration: float) -> float | None:
    """Until a step stays within 2 % of 1, s; None: not within `duration`."""
    answer = step(motor, controller, duration)
    return _settled(answer.shown, answer.time_s)


def _settled(share: F64, time_s: F64) -> float | None:
    """From when on a step, as a share of its final value, stays within 2 %."""
    outside = np.flatnonzero(~(np.abs(share - 1.0) <= SETTLED))
    last = int(outside[-1]) if len(outside) else -1
    return None if last + 1 >= len(share) else float(time_s[last + 1])


def _rise(share: F64, time_s: F64) -> float | None:
    """From the first sample at 10 % to the first at 90 %, s."""
    low, high = np.flatnonzero(share >= 0.1), np.flatnonzero(share >= 0.9)
    return float(time_s[high[0]] - time_s[low[0]]) if len(high) else None


def response(motor: SampledMotor, controller: Controller) -> Response:
    """The first motor's loop, which must be stable."""
    answer = step(motor, controller, duration_s(motor, controller))
    final = 1.0 if _reaches(controller) else float(answer.shown[-1])
    share = answer.shown / final
    return Response(
        bandwidth_hz=bandwidth_hz(motor, controller),
        settling_s=_settled(share, answer.time_s),
        rise_s=_rise(share, answer.time_s),
        overshoot_percent=max(0.0, 100.0 * (float(share.max()) - 1.0)),
        peak_V=float(np.abs(answer.voltage_V).max()),
    )


def _reaches(controller: Controller) -> bool:
    """An integrator in the controller, or the angle itself: the step's final value is the reference."""
    return bool((np.abs(np.diag(controller.A) - 1.0) < 1e-12).any())
