"""How near to parameters that move linearly anybody can come, and how near a random walk can.

The plant is linearised at the truth of each run, all noise is known, the encoder's steps count as white noise of a
count over √12. Two estimators, both as covariances (no noise is drawn):

trend  knows that the logarithms move at constant rates, and learns the rates: the posterior Cramér–Rao bound (as in
       `cramer_rao`) with five rates as further states, of which 10 %/min (1 σ) is known before. Nobody who is told less
       comes nearer.
walk   takes the parameters for random walks, as the daemon does. What it is off by on a ramp is its noise and its lag,
       both exactly: e⁺ = (1 − k H)(F e − Δq), S⁺ = (1 − k H) (F S Fᵀ + Q) (1 − k H)ᵀ + r k kᵀ with the gain k of a
       filter that expects a walk. The intensities are the daemon's defaults times the factor (of `FACTORS`) that is
       best for this motor, motion and parameter.
"""

from __future__ import annotations

from functools import cache

import casadi as ca
import numpy as np

from servo_daemon.kalman.model import predict
from servo_daemon.plant.build import build_plant
from servo_daemon.plant.compiled import SampleLoop
from servo_daemon.samples import F64
from servo_daemon.tracking.plan.settings import TrackerSettings
from tests.recovery.generator import Motor, Recording, Sensors
from tests.recovery.tracking.cramer_rao import log_parameters, true_samples
from tests.recovery.tracking.follow import BURN_IN_S, NAMES

#: What is known at the start, 1 σ: of each logarithm, and of its rate (1/s).
START_STD, RATE_STD = 0.3, 0.1 / 60
#: Of the default random walks' 1 σ.
FACTORS = (0.2, 0.4, 1.0)


@cache
def _loop(*, rates: bool) -> SampleLoop:
    """State: P | S | e (P and S column-major); constants: variances of voltage, current, position | walk (1/s);
    sample: x | q | u | t | h | what the parameters move by meanwhile; output: mean squares of their errors."""
    n = 13 if rates else 8
    state, const, sample = ca.SX.sym("state", 2 * n * n + n), ca.SX.sym("const", 8), ca.SX.sym("sample", 16)
    P, S, e = ca.reshape(state[: n * n], n, n), ca.reshape(state[n * n : 2 * n * n], n, n), state[2 * n * n :]
    h = ca.fmax(sample[10], 1e-9)
    step = predict(
        build_plant(), sample[:3], sample[:3], sample[3:8], sample[8], sample[9], h, const[0], ca.SX(0), ca.SX(0)
    )
    F, Q, expected = ca.SX.eye(n), ca.SX.zeros(n, n), ca.SX.zeros(n, n)
    F[:3, :3], F[:3, 3:8] = step.by_state, step.by_parameter
    if rates:
        F[3:8, 8:] = h * ca.SX.eye(5)
    Q[:3, :3] = step.noise
    expected[3:8, 3:8] = ca.diag(const[3:]) * h
    P, S, e = F @ P @ F.T + Q + expected, F @ S @ F.T + Q, F @ e
    if not rates:
        e[3:8] -= sample[11:]
    for channel, r in ((0, const[1]), (2, const[2])):
        gain = P[:, channel] / (P[channel, channel] + r)
        left = ca.SX.eye(n)
        left[:, channel] -= gain
        P, S = (left @ M @ left.T + r * gain @ gain.T for M in (P, S))
        e = left @ e
    following = ca.vertcat(ca.vec((P + P.T) / 2), ca.vec((S + S.T) / 2), e)
    return SampleLoop(ca.Function("step", [state, const, sample], [following, ca.diag(S)[3:8] + e[3:8] ** 2]))


def _samples(recording: Recording) -> F64:
    """Shape (n, 16), as `_loop` has it."""
    q = log_parameters(recording)
    return np.hstack([true_samples(recording, q), np.diff(q, axis=0, prepend=q[:1])])


def _rms(samples: F64, variances: F64, walk_var_per_s: F64 | None) -> F64:
    """Of the errors after the burn-in, shape (5,); None: with rates."""
    rates = walk_var_per_s is None
    std = [1.0] * 3 + [START_STD] * 5 + ([RATE_STD] * 5 if rates else [])
    P = np.diag(np.square(std)).ravel()
    constants = np.concatenate([variances, np.zeros(5) if walk_var_per_s is None else walk_var_per_s])
    squares = _loop(rates=rates).run(np.concatenate([P, P, np.zeros(len(std))]), constants, samples)
    late = samples[:, 9] > BURN_IN_S
    return np.asarray(np.sqrt(squares[late].mean(axis=0)))


def ramp_bounds(motor: Motor, recording: Recording) -> tuple[F64, F64]:
    """RMS errors of the logarithms, shape (5,) each: of who knows the trend, and of the best random walk.

    Args:
        recording: with `Sensors.laboratory`.
    """
    sensors, samples = Sensors.laboratory(motor), _samples(recording)
    variances = np.array(
        [
            sensors.hidden_V**2 + sensors.voltage_lsb_V**2 / 12,
            sensors.current_noise_A**2 + sensors.current_lsb_A**2 / 12,
            (2 * np.pi / sensors.counts_per_rev) ** 2 / 12,
        ]
    )
    default = np.square([TrackerSettings().drift_of(name) for name in NAMES])
    walks = [_rms(samples, variances, factor**2 * default) for factor in FACTORS]
    return _rms(samples, variances, None), np.min(walks, axis=0)
