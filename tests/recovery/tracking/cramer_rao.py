"""The posterior Cramér–Rao bound of the parameters along a run's true path.

Tichavský, Muravchik & Nehorai, *IEEE Trans. Signal Process.* 46, 1998, eq. 21, its expectations taken along each run's
own path: for additive Gaussian noise the recursion is then the Riccati equation of the plant linearised at the truth.
"""

from __future__ import annotations

from functools import cache

import casadi as ca
import numpy as np

from servo_daemon.kalman.model import predict
from servo_daemon.plant.build import build_plant
from servo_daemon.plant.compiled import SampleLoop
from servo_daemon.samples import F64
from tests.recovery.generator import Recording
from tests.recovery.tracking.follow import NAMES

#: What is known at the start: each parameter to 10 %, the motion to one unit.
START_STD = 0.1


@cache
def _riccati() -> SampleLoop:
    """Covariance of the plant linearised at given states: state P (column-major), sample x, q, u, t, h."""
    plant = build_plant()
    P, const, sample = ca.SX.sym("P", 64), ca.SX.sym("const", 8), ca.SX.sym("sample", 11)
    x, q, u, t, h = sample[:3], sample[3:8], sample[8], sample[9], ca.fmax(sample[10], 1e-9)
    step = predict(plant, x, x, q, u, t, h, const[0], ca.SX(0), ca.SX(0))
    F = ca.SX.eye(8)
    F[:3, :3], F[:3, 3:] = step.by_state, step.by_parameter
    Q = ca.SX.zeros(8, 8)
    Q[:3, :3], Q[3:, 3:] = step.noise, ca.diag(const[3:8]) * h
    C = F @ ca.reshape(P, 8, 8) @ F.T + Q
    for channel, r in ((0, const[1]), (2, const[2])):
        gain = C[:, channel] / (C[channel, channel] + r)
        C = C - gain @ C[channel, :] - C[:, channel] @ gain.T + (C[channel, channel] + r) * gain @ gain.T
    C = (C + C.T) / 2
    return SampleLoop(ca.Function("step", [P, const, sample], [ca.vec(C), ca.diag(C)[3:]]))


def log_parameters(recording: Recording) -> F64:
    """The true ones, shape (n, 5)."""
    return np.asarray(np.log(np.column_stack([recording.truth.parameters[name] for name in NAMES])))


def true_samples(recording: Recording, q: F64) -> F64:
    """State, log parameters and voltage from the sample before on, time and step; shape (n, 11)."""
    truth = recording.truth
    x = np.column_stack([truth.current_A, truth.speed_rad_s, truth.position_rad])
    out = np.zeros((len(q), 11))
    out[1:, :3], out[1:, 3:8], out[1:, 8] = x[:-1], q[:-1], recording.voltage_V[:-1]
    out[0, :3], out[0, 3:8] = x[0], q[0]
    out[:, 9], out[:, 10] = recording.time_s, np.diff(recording.time_s, prepend=recording.time_s[0])
    return out


def bound_std(recording: Recording, variances: tuple[float, float, float], drift_var_per_s: F64) -> F64:
    """1 σ of each log parameter that no estimator beats, shape (n, 5).

    Args:
        variances: of the applied voltage from sample to sample (V²), of current (A²) and position (rad²) as measured.
        drift_var_per_s: random walk of each logarithm, 1/s, shape (5,).
    """
    sample = true_samples(recording, log_parameters(recording))
    P = np.diag([1.0, 1.0, 1.0] + [START_STD**2] * 5).T.reshape(-1).copy()
    return np.sqrt(_riccati().run(P, np.concatenate([variances, drift_var_per_s]), sample))
