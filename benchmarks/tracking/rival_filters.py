"""What others would run on the same samples, each written as its user would: per sample in Python.

The motor is a user's own: dI/dt = (V − R I − K ω)/L, dω/dt = (K I − B ω)/J, dθ/dt = ω, parameters as logarithms. Each
rival is told the true sensor noise and a drift tuned to the data; all start from the same wrong
datasheet.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from servo_daemon.samples import F64
from tests.recovery.generator import Motor, Recording
from tests.recovery.tracking.follow import NAMES

#: Random walk of a logarithm, 1 σ after a minute, in the order of NAMES: a third of it spoils the
#: coverage, three times as much the error.
DRIFT_PER_SQRT_MIN = np.array([0.03, 0.01, 0.01, 0.02, 0.03])
#: Torque noise, as a share of the rated torque, from sample to sample: what the encoder's steps call for.
TORQUE_SHARE = 0.002
#: What is known of the motion and the parameters at the start, 1 σ.
START_STD = np.array([1.0, 1.0, 0.01, 0.4, 0.4, 0.4, 0.4, 0.4])
SUBSTEPS = 2
H = np.array([[1.0, 0, 0, 0, 0, 0, 0, 0], [0, 0, 1.0, 0, 0, 0, 0, 0]])


@dataclass(frozen=True, slots=True, eq=False)
class Rival:
    """Parameters after each sample, shape (n, 5), and 1 σ of each where the rival has one (NaN: it has none); `note`:
    how it ended, if it did not reach the end."""

    value: F64
    std: F64
    note: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """What a rival gets: the samples, the motor's ratings (no parameter), and a datasheet that is wrong."""

    recording: Recording
    motor: Motor
    nominal: Mapping[str, float]


def derivative(z: F64, u: float) -> F64:
    """dz/dt of (I, ω, θ, ln R, ln L, ln K, ln J, ln B)."""
    R, L, K, J, B = np.exp(z[3:])
    return np.array([(u - R * z[0] - K * z[1]) / L, (K * z[0] - B * z[1]) / J, z[1], 0, 0, 0, 0, 0])


def jacobian(z: F64, u: float) -> F64:
    """d(dz/dt)/dz, shape (8, 8)."""
    R, L, K, J, B = np.exp(z[3:])
    i, w = z[0], z[1]
    A = np.zeros((8, 8))
    A[0, :2], A[0, 3:6] = (-R / L, -K / L), (-R * i / L, -(u - R * i - K * w) / L, -K * w / L)
    A[1, :2], A[1, 5:8] = (K / J, -B / J), (K * i / J, -(K * i - B * w) / J, -B * w / J)
    A[2, 1] = 1.0
    return A


def runge_kutta(z: F64, u: float, h: float) -> tuple[F64, F64]:
    """Next state and its Jacobian by fourth-order steps; the Jacobian's exponential to the same order."""
    F = np.eye(8)
    d = h / SUBSTEPS
    for _ in range(SUBSTEPS):
        Ad = jacobian(z, u) * d
        F = (np.eye(8) + Ad @ (np.eye(8) + Ad @ (np.eye(8) + Ad @ (np.eye(8) + Ad / 4) / 3) / 2)) @ F
        k1 = derivative(z, u)
        k2 = derivative(z + d / 2 * k1, u)
        k3 = derivative(z + d / 2 * k2, u)
        k4 = derivative(z + d * k3, u)
        z = z + d / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return z, F


def heun(z: F64, u: float, h: float) -> tuple[F64, F64]:
    """The same to second order: what is written in an hour."""
    F = np.eye(8)
    d = h / SUBSTEPS
    for _ in range(SUBSTEPS):
        Ad = jacobian(z, u) * d
        F = (np.eye(8) + Ad + Ad @ Ad / 2) @ F
        k1 = derivative(z, u)
        z = z + d / 2 * (k1 + derivative(z + d * k1, u))
    return z, F


def process_noise(motor: Motor, hidden_V: float, h: float) -> F64:
    """Q of one sample: voltage noise through the winding, torque noise, drift of the parameters."""
    torque = TORQUE_SHARE * motor.working_torque_Nm
    current = hidden_V / motor.R * (1 - np.exp(-h * motor.R / motor.L))
    return np.diag([current**2, (torque * h / motor.J) ** 2, 0.0, *(DRIFT_PER_SQRT_MIN**2 * h / 60)])


def sensor_noise(motor: Motor) -> F64:
    """R of (current, position): noise and a count's rounding."""
    return np.diag([(0.003 * motor.rated_current_A) ** 2, (2 * np.pi / motor.counts_per_rev) ** 2 / 12])


def _start(task: Task) -> F64:
    q = np.log([task.nominal[name] for name in NAMES])
    return np.concatenate([[task.recording.current_A[0], 0.0, task.recording.position_rad[0]], q])


def filterpy_ekf(task: Task) -> Rival:
    """filterpy's ExtendedKalmanFilter, Runge–Kutta of fourth order, two substeps."""
    from filterpy.kalman import ExtendedKalmanFilter

    recording, motor = task.recording, task.motor
    ekf = ExtendedKalmanFilter(dim_x=8, dim_z=2)
    ekf.x, ekf.P, ekf.R = _start(task), np.diag(START_STD**2), sensor_noise(motor)
    Q = process_noise(motor, 0.001 * motor.supply_V, 1e-3)

    def move(u: tuple[float, float]) -> None:
        ekf.x, ekf.F = runge_kutta(ekf.x, *u)

    ekf.predict_x = move
    value, std = np.full((2, len(recording.time_s), 5), np.nan)
    for k in range(len(value)):
        if k:
            h = recording.time_s[k] - recording.time_s[k - 1]
            move((recording.voltage_V[k - 1], h))
            ekf.P = ekf.F @ ekf.P @ ekf.F.T + Q
        measured = np.array([recording.current_A[k], recording.position_rad[k]])
        ekf.update(measured, lambda _: H, lambda x: H @ x)
        value[k], std[k] = np.exp(ekf.x[3:]), np.sqrt(np.diag(ekf.P)[3:])
    return Rival(value, value * std)


def numpy_ekf(task: Task) -> Rival:
    """The textbook's equations in NumPy, two Heun substeps."""
    recording, motor = task.recording, task.motor
    x, P, R = _start(task), np.diag(START_STD**2), sensor_noise(motor)
    Q = process_noise(motor, 0.001 * motor.supply_V, 1e-3)
    value, std = np.full((2, len(recording.time_s), 5), np.nan)
    for k in range(len(value)):
        if not (np.isfinite(P).all() and (np.diag(P) > 0).all() and np.abs(x[3:]).max() < 50):
            return Rival(value, std, f"diverged after {recording.time_s[k]:.1f} s")
        if k:
            x, F = heun(x, recording.voltage_V[k - 1], recording.time_s[k] - recording.time_s[k - 1])
            P = F @ P @ F.T + Q
        y = np.array([recording.current_A[k], recording.position_rad[k]])
        gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        x = x + gain @ (y - H @ x)
        P = (np.eye(8) - gain @ H) @ P
        value[k], std[k] = np.exp(x[3:]), np.sqrt(np.diag(P)[3:])
    return Rival(value, value * std)


FILTERS: dict[str, Callable[[Task], Rival]] = {
    "filterpy, Runge–Kutta": filterpy_ekf,
    "NumPy EKF, Heun": numpy_ekf,
}
