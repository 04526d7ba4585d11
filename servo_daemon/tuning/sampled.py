"""The loop as the drive's processor sees it: motor under a held voltage, encoder differences, and a linear controller.

The loop is cut at the voltage, where the amplifier's gain, the delay and most of what ages act: one input, one output,
whatever the controller's structure. All motor functions take many motors at once (first axis).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servo_daemon.plant.linear import linear_step
from servo_daemon.samples import F64
from servo_daemon.tuning.knowledge import NEEDED

C128 = NDArray[np.complex128]

#: Indices of the motor's states; the last voltages follow, newest first.
CURRENT, SPEED, MEAN_SPEED, N_MOTION = 0, 1, 2, 3


@dataclass(frozen=True, slots=True, eq=False)
class SampledMotor:
    """n motors: x[k+1] = A x[k] + B u[k], with x = (i, ω, w, u[k−1], …, u[k−N]).

    w[k] = (θ[k] − θ[k−1]) / T is what the encoder tells of the speed. u is the voltage that the controller asks for; it
    acts `delay_samples` later, N is that delay rounded up.

    Attributes:
        A: shape (n, 3 + N, 3 + N).
        B: shape (n, 3 + N).
        per_old, per_new: shape (n, 3): effect of the older and the newer voltage that act within one sample.
        whole: samples of delay before the newer one acts.
        period_s: T.
    """

    A: F64
    B: F64
    per_old: F64
    per_new: F64
    whole: int
    period_s: float

    def response(self, z: C128) -> tuple[C128, C128]:
        """(w/u, i/u) at these z, each shape (n, len(z)), in rad/s per V and A per V."""
        z = z[None, :]
        late = z ** (-self.whole)
        g = [self.per_new[:, k, None] * late + self.per_old[:, k, None] * late / z for k in range(N_MOTION)]
        a, b, c, d = (self.A[:, row, column, None] for row in (0, 1) for column in (0, 1))
        det = (z - a) * (z - d) - b * c
        current = ((z - d) * g[0] + b * g[1]) / det
        speed = (c * g[0] + (z - a) * g[1]) / det
        to_w = self.A[:, MEAN_SPEED, :2, None]
        return (to_w[:, 0] * current + to_w[:, 1] * speed + g[2]) / z, current


def sampled_motor(log_values: F64, period_s: float, delay_samples: float) -> SampledMotor:
    """Motors under zero-order hold with a delay of any length.

    Args:
        log_values: logarithms of R, L, K, J, B; shape (n, 5).
    """
    p: dict[str, float | F64] = {name: np.exp(log_values[:, k]) for k, name in enumerate(NEEDED)}
    whole = math.floor(delay_samples + 1e-9)
    part = max(0.0, delay_samples - whole)
    if part < 1e-9:
        Ad, Bd = linear_step(p, period_s)
        new, old, stored = Bd[..., 0], np.zeros_like(Bd[..., 0]), whole
    else:
        _, first = linear_step(p, part * period_s)
        rest, new = linear_step(p, (1.0 - part) * period_s)
        old, new, stored = (rest @ first)[..., 0], new[..., 0], whole + 1
        Ad, _ = linear_step(p, period_s)
    for step in (Ad, new, old):
        step[:, 2] /= period_s  # the angle's increment becomes the mean speed
    size = N_MOTION + stored
    A, B = np.zeros((len(log_values), size, size)), np.zeros((len(log_values), size))
    A[:, :3, :2] = Ad[:, :, :2]
    _enter(A, B, whole, new)
    if part >= 1e-9:
        _enter(A, B, whole + 1, old)
    if stored:
        B[:, N_MOTION] = 1.0
        A[:, range(N_MOTION + 1, size), range(N_MOTION, size - 1)] = 1.0
    return SampledMotor(A, B, old, new, whole, period_s)


def _enter(A: F64, B: F64, age: int, effect: F64) -> None:
    """The voltage of so many samples ago acts."""
    if age == 0:
        B[:, :N_MOTION] += effect
    else:
        A[:, :N_MOTION, N_MOTION + age - 1] += effect


@dataclass(frozen=True, slots=True, eq=False)
class Controller:
    """x[k+1] = A x + B_y y + B_r r,  u = C x + D_y y + D_r r + Σ_j previous_j u[k−j], with y = (w, i).

    Attributes:
        position: r is an angle and the loop closes over it; else r is a speed.
        A: shape (c, c), lower triangular.
        B_y: shape (c, 2). B_r: shape (c,). C: shape (c,). D_y: shape (2,). D_r: a number.
        previous: shape (m,), m at most the motor's stored voltages.
    """

    position: bool
    A: F64
    B_y: F64
    B_r: F64
    C: F64
    D_y: F64
    D_r: float
    previous: F64

    def response(self, z: C128) -> tuple[C128, C128, C128]:
        """u per w, per i and per r at these z, each shape (len(z),)."""
        inputs = np.column_stack((self.B_y, self.B_r))
        states = np.zeros((len(self.A), 3, len(z)), np.complex128)
        for k in range(len(self.A)):  # forward substitution: A is lower triangular
            known = np.tensordot(self.A[k, :k], states[:k], 1)
            states[k] = (known + inputs[k][:, None]) / (z - self.A[k, k])
        out = np.tensordot(self.C, states, 1) + np.append(self.D_y, self.D_r)[:, None]
        own = 1.0 - sum((q * z ** -(j + 1.0) for j, q in enumerate(self.previous)), np.zeros_like(z))
        w, i, r = out / own
        return w, i, r


def closed_loop(motor: SampledMotor, controller: Controller) -> tuple[F64, F64]:
    """The closed loops: x[k+1] = A x + B r with x = (motor, controller); shapes (n, m, m) and (n, m)."""
    n, size = motor.B.shape
    c = len(controller.A)
    u_of_motor = np.zeros(size)
    u_of_motor[MEAN_SPEED], u_of_motor[CURRENT] = controller.D_y
    u_of_motor[N_MOTION : N_MOTION + len(controller.previous)] += controller.previous
    A, B = np.zeros((n, size + c, size + c)), np.zeros((n, size + c))
    A[:, :size, :size] = motor.A + motor.B[:, :, None] * u_of_motor
    A[:, :size, size:] = motor.B[:, :, None] * controller.C
    A[:, size:, MEAN_SPEED], A[:, size:, CURRENT] = controller.B_y[:, 0], controller.B_y[:, 1]
    A[:, size:, size:] = controller.A
    B[:, :size] = motor.B * controller.D_r
    B[:, size:] = controller.B_r
    return A, B


def voltage_row(motor: SampledMotor, controller: Controller) -> F64:
    """Row c with u = c x + D_r r of the closed loop's state x, shape (m,)."""
    size = motor.B.shape[1]
    row = np.zeros(size + len(controller.A))
    row[MEAN_SPEED], row[CURRENT] = controller.D_y
    row[N_MOTION : N_MOTION + len(controller.previous)] += controller.previous
    row[size:] = controller.C
    return row
