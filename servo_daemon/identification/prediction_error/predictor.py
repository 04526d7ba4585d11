"""Extended Kalman filter with given parameters: what it predicts of each sample, and how surely.

    x⁺ = f(x, u, q),  P⁺ = F P Fᵀ + g σ_u² gᵀ          F = ∂f/∂x and g = ∂f/∂u at the filtered state
    ε = (y − h(x))/√s,  s = H P Hᵀ + σ_y²              channel by channel

A free run follows the model alone; where dry friction holds the shaft, or a gap lets it go, a noise that no recording
shows decides when, and all that follows is another motion. Here the state follows the data, and each sample is
predicted from the one before (Ljung, *System Identification*, 2nd ed. 1999, sec. 7.2).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import casadi as ca
import numpy as np

from servo_daemon.identification.output_error.problem.problem import MOTOR_STATES, Problem
from servo_daemon.identification.output_error.problem.rollout import INPUT, STEP, TIME
from servo_daemon.kalman.expressions import natural, pack, unpack
from servo_daemon.kalman.layout import MEASURABLE
from servo_daemon.kalman.model import predict
from servo_daemon.plant.build import PlantModel
from servo_daemon.plant.compiled import SampleLoop
from servo_daemon.samples import F64

#: 1 σ of the states at first, in their sizes over the recording: of the motor's, which the data show at once, and of
#: effects', which begin as the fit has them.
_MOTION_STD, _OTHER_STD = 1.0, 0.1


@dataclass(frozen=True, slots=True)
class Predictions:
    """Innovations over their standard deviations, and the logarithms of their variances; per segment, shape (n, c);
    0 where a sample is not valid."""

    innovations: tuple[F64, ...]
    log_variance: tuple[F64, ...]


@cache
def _loop(plant: PlantModel, channels: tuple[str, ...]) -> SampleLoop:
    n, n_q, c = len(plant.states), len(plant.parameters), len(channels)
    state, const = ca.SX.sym("state", n + n * (n + 1) // 2), ca.SX.sym("const", n_q + 1 + c)
    sample = ca.SX.sym("sample", 3 + 2 * c)
    x, P, q, variance = state[:n], unpack(state[n:], n), const[:n_q], const[n_q:]
    t, h, u = sample[TIME], sample[STEP], sample[INPUT]
    white, logs = [], []
    for k, channel in enumerate(channels):
        y, weight = sample[3 + k], sample[3 + c + k]
        at = ca.SX.sym("x", n)
        shown = plant.sensed(at, natural(plant, q), t)[MEASURABLE.index(channel)]
        value, H = ca.Function("shown", [at, q, t], [shown, ca.jacobian(shown, at)])(x, q, t)
        valid = weight > 0
        PHt = P @ H.T
        s = H @ PHt + variance[1 + k] / ca.if_else(valid, weight, 1.0)
        x, P = x + valid / s * PHt * (y - value), P - valid / s * (PHt @ PHt.T)
        white.append(valid * (y - value) / ca.sqrt(s))
        logs.append(valid * ca.log(s))
    speed = plant.state_names.index("velocity_rad_s")
    here, spread = ca.SX.sym("x", n), ca.SX.sym("var")
    ahead = predict(plant, here, here, q, u, t, h, variance[0], ca.SX(0), spread)
    step = ca.Function(
        "ahead", [here, q, u, t, h, variance, spread], [ahead.x, ahead.by_state, ahead.noise], {"always_inline": True}
    )
    x, F, noise = step(x, q, u, t, h, variance, P[speed, speed])
    outputs = ca.vertcat(*white, *logs)
    return SampleLoop(
        ca.Function("step", [state, const, sample], ca.cse([ca.vertcat(x, pack(F @ P @ F.T + noise)), outputs])),
        paced_by=STEP,
    )


@dataclass(frozen=True)
class Predictor:
    """The filter over a problem's segments.

    Attributes:
        problem: uncut.
        begins: per segment, shape (n_x,): the state that it begins with, where no sensor shows it.
        samples: per segment, shape (n, 3 + 2 c): as `rollout` has them, measurements, weights.
    """

    problem: Problem
    begins: tuple[F64, ...]
    samples: tuple[F64, ...]

    def run(self, unknowns: F64, log_variance: F64) -> Predictions:
        """Go over all samples with these parameters and noises.

        Args:
            unknowns: of which the parameters are taken.
            log_variance: of the voltage, held over a step, and of each channel's noise, shape (1 + c,).
        """
        plant, channels = self.problem.plant, self.problem.channels
        c, white, logs = len(channels), [], []
        for segment, x0, samples in zip(self.problem.segments, self.begins, self.samples, strict=True):
            moving = np.array([name in MOTOR_STATES for name in plant.state_names])
            std = segment.x0_scale * np.where(moving, _MOTION_STD, _OTHER_STD)
            state = np.concatenate([x0, _packed(np.diag(std**2))])
            q = self.problem.acting(unknowns, segment.recording)
            out = _loop(plant, channels).run(state, np.concatenate([q, np.exp(log_variance)]), samples)
            white.append(out[:, :c])
            logs.append(out[:, c:])
        return Predictions(tuple(white), tuple(logs))


def _packed(P: F64) -> F64:
    """Lower triangle, column by column."""
    n = len(P)
    return np.concatenate([P[k:, k] for k in range(n)])


def _alike(measured: F64) -> F64:
    """How many samples of a channel have shown the same value in a row, up to each one, shape (n, c): an encoder at
    rest repeats one rounding error, and however often it does, it tells the angle once."""
    index = np.arange(len(measured))[:, None]
    moved = np.diff(measured, axis=0, prepend=np.nan) != 0.0
    return np.asarray(index - np.maximum.accumulate(np.where(moved, index, 0), axis=0) + 1.0)


def predictor(problem: Problem, unknowns: F64, weights: tuple[F64, ...]) -> Predictor:
    """Lay the problem's samples out for the filter.

    Args:
        unknowns: effects' states begin as these have them.
        weights: per segment, shape (n, c); a channel's variance is divided by it, 0: not valid.
    """
    begins, samples = [], []
    for k, segment in enumerate(problem.segments):
        own = [name in MOTOR_STATES for name in problem.plant.state_names]
        begins.append(np.where(own, segment.x0, problem.initial_state(unknowns, k)))
        measured = np.where(segment.valid, segment.measured, 0.0)
        use = weights[k] * segment.valid / _alike(measured)
        samples.append(np.ascontiguousarray(np.hstack([segment.rows, measured, use])))
    return Predictor(problem, tuple(begins), tuple(samples))
