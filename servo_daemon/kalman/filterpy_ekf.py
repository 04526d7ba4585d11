"""The same filter on filterpy's ExtendedKalmanFilter: readable, slow, and the check on the compiled one.

It runs sample by sample in Python over the same plant, keeps the same flat vectors as `model` and so can take the
place of the compiled loop (`engine = "filterpy"`). The two agree to rounding; a test holds them to 1e-6.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from servo_daemon.kalman.expressions import natural
from servo_daemon.kalman.layout import CLIP, MEASURABLE, SPIKE, STATISTICS, EkfLayout
from servo_daemon.kalman.measurement import GATE, UNUSUAL_INPUT
from servo_daemon.kalman.model import (
    DOUBTFUL_INPUT,
    SAMPLES_TO_FIND_SPEED,
    SHORTEST_STEP_S,
    acting,
    found_speed,
    predict,
    slowness,
    trajectory_after,
)
from servo_daemon.plant.build import PlantModel
from servo_daemon.samples import F64

#: After each sample the interpreter is let go for so long (the timer adds 50 µs), s: who waits for it
#: gets it after a step, and not after five milliseconds of plain Python (benchmarks/neighbours.py: p99 86 ms, not 101).
_PAUSE_S = 1e-6


class FilterpyLoop:
    """Drop-in for `SampleLoop`: `run(state, constants, samples)` changes `state`, returns the innovations."""

    def __init__(self, plant: PlantModel, channels: tuple[str, ...], mean_input: bool = False) -> None:
        self._mean_input = mean_input
        self._lay = EkfLayout(plant, channels)
        self._predict = _prediction(plant)
        self._follow = _following(plant)
        self._shown = [_shown(plant, channel) for channel in channels]
        self._rows, self._columns = self._lay.triangle
        self._low, self._high = (np.array([bound(p) for p in plant.parameters]) for bound in (_low, _high))

    def run(self, state: F64, constants: F64, samples: F64) -> F64:
        from filterpy.kalman import ExtendedKalmanFilter

        lay = self._lay
        ekf = ExtendedKalmanFilter(dim_x=lay.n_z, dim_z=1)
        ekf.x = state[lay.z].copy()
        ekf.P = np.empty((lay.n_z, lay.n_z))
        ekf.P[self._rows, self._columns] = ekf.P[self._columns, self._rows] = state[lay.tri]
        outputs = np.empty((len(samples), lay.n_output))
        for row, sample in enumerate(samples):
            time.sleep(_PAUSE_S)
            self._time_update(ekf, state, constants, sample)
            self._earlier = state[lay.statistics][STATISTICS.index("last")]
            for k in range(len(lay.channels)):
                outputs[row, 3 * k : 3 * k + 3] = self._measure(ekf, state, constants, sample, k)
            q = ekf.x[lay.q]
            ekf.x[lay.q] = np.clip(q, self._low, self._high)
            # Rounding leaves P a little asymmetric; carried on or not, that must not depend on where a run ends.
            ekf.P[self._columns, self._rows] = ekf.P[self._rows, self._columns]
            trusted = min(DOUBTFUL_INPUT * constants[0] / max(state[lay.held_variance], 1e-300), 1.0)
            slowly = trusted * float(slowness(max(sample[1], SHORTEST_STEP_S), state[-1], constants[-1]))
            state[lay.trajectory] = self._follow(state[lay.trajectory], ekf.x[lay.x], slowly)
            age = state[-1] + sample[1]
            state[-1] = SAMPLES_TO_FIND_SPEED * sample[1] if outputs[row, 2::3].any() else age
            state[lay.held_input], state[lay.held_variance] = sample[2], constants[0] + sample[3]
        state[lay.z] = ekf.x
        state[lay.tri] = ekf.P[self._rows, self._columns]
        return outputs

    def _time_update(self, ekf: Any, state: F64, constants: F64, sample: F64) -> None:
        lay, h = self._lay, max(sample[1], SHORTEST_STEP_S)
        if lay.plant.drive == "voltage":
            state[lay.held_input] += sample[lay.correction]
            state[lay.held_variance] += sample[lay.correction] ** 2
        u, var_u, change = acting(lay, state, constants, sample, mean_input=self._mean_input)
        at = lay.plant.state_names.index("velocity_rad_s")
        x_next, modelled, by_z, noise = self._predict(
            ekf.x[lay.x], state[lay.trajectory], ekf.x[lay.q], u, sample[0] - h, h, var_u, constants[1], ekf.P[at, at],
            change,
        )  # fmt: skip
        state[lay.trajectory] = modelled
        F, Q = np.eye(lay.n_z), np.zeros((lay.n_z, lay.n_z))
        by_z[:, lay.n_x :] *= float(found_speed(state[-1], h))
        F[lay.x, :] = by_z
        Q[lay.x, lay.x] = noise
        Q[lay.q, lay.q] = np.diag(constants[lay.walk] * h)
        ekf.F, ekf.Q = F, Q
        ekf.P = F @ ekf.P @ F.T + Q
        ekf.x = np.concatenate([x_next, ekf.x[lay.q]])

    def _measure(self, ekf: Any, state: F64, constants: F64, sample: F64, k: int) -> tuple[float, float, float]:
        """One channel, by filterpy's own update (Joseph's form) with the gated variance and the held directions."""
        lay = self._lay
        y, valid, doubt = sample[4 + 3 * k : 7 + 3 * k]
        r = constants[lay.r][k] * doubt
        predicted, H = self._shown[k](ekf.x, sample[0])
        s0 = float((H @ ekf.P @ H.T)[0, 0]) + r
        innovation = float(y - predicted)
        extra = valid * max(innovation**2 / GATE**2 - s0, 0.0)
        gated = extra > 0 or bool(doubt >= SPIKE) or bool(k == 0 and valid * sample[lay.correction] != 0)
        usual = state[lay.held_variance] <= UNUSUAL_INPUT * constants[0]
        self._count(state, k, innovation, s0, bool(valid > 0 and doubt <= 1.0 and usual), gated)
        if valid > 0:
            own = lay.plant.state_names.index(lay.channels[k])
            ekf.P[own, own] += extra / 2
            PHt = (ekf.P @ H.T)[:, 0]
            reduction, p_qq = PHt[lay.q] ** 2 / (s0 + extra), np.diag(ekf.P)[lay.q]
            state[lay.information] += reduction / (p_qq * (p_qq - reduction))
            self._update(ekf, H, innovation, s0 + extra, r + extra / 2, constants)
        return (innovation, s0, float(gated)) if valid > 0 else (0.0, 1.0, float(gated))

    def _count(self, state: F64, k: int, innovation: float, s0: float, counts: bool, outlier: bool) -> None:
        n = len(STATISTICS)
        sums = state[self._lay.statistics][k * n : (k + 1) * n]
        earlier = self._earlier
        if counts:
            normalised = innovation / np.sqrt(s0)
            clipped = min(normalised**2, CLIP**2)
            sums[:4] += (1.0, normalised**2, s0 * (clipped - 1.0), normalised * sums[4])
            sums[4] = normalised
            sums[6] += normalised * earlier
        sums[5] += outlier

    def _update(self, ekf: Any, H: F64, innovation: float, s: float, r: float, constants: F64) -> None:
        lay = self._lay
        active = np.concatenate([np.ones(lay.n_x), constants[lay.active]])
        if active.all():
            # The innovation is already known: hand filterpy a measurement whose residual is just that.
            ekf.update(np.array([innovation]), lambda _x: H, lambda _x: np.zeros(1), R=np.array([[r]]))
            ekf.x = ekf.x.reshape(-1)
            return
        gain = active * (ekf.P @ H.T)[:, 0] / s  # filterpy has no considered parameters: Joseph's form by hand
        I_KH = np.eye(lay.n_z) - np.outer(gain, H[0])
        ekf.x = ekf.x + gain * innovation
        ekf.P = I_KH @ ekf.P @ I_KH.T + r * np.outer(gain, gain)


def _prediction(plant: PlantModel) -> Callable[..., tuple[F64, ...]]:
    x, trajectory = ca.SX.sym("x", len(plant.states)), ca.SX.sym("trajectory", len(plant.states))
    q = ca.SX.sym("q", len(plant.parameters))
    rest = [ca.SX.sym(n) for n in ("u", "t", "h", "var_u", "psd", "speed_var", "change")]
    step = predict(plant, x, trajectory, q, *rest)
    by_z = ca.horzcat(step.by_state, step.by_parameter)
    results = [step.x, step.trajectory, ca.densify(by_z), ca.densify(step.noise)]
    function = ca.Function("predict", [x, trajectory, q, *rest], results)

    def call(*arguments: Any) -> tuple[F64, ...]:
        x_next, modelled, F, Q = (np.asarray(r) for r in function(*arguments))
        return x_next.reshape(-1), modelled.reshape(-1), F, Q

    return call


def _following(plant: PlantModel) -> Callable[..., F64]:
    modelled, x = ca.SX.sym("m", len(plant.states)), ca.SX.sym("x", len(plant.states))
    slowly = ca.SX.sym("slowly")
    function = ca.Function("follow", [modelled, x, slowly], [trajectory_after(plant, modelled, x, slowly)])
    return lambda *arguments: np.asarray(function(*arguments)).reshape(-1)


def _shown(plant: PlantModel, channel: str) -> Callable[[F64, float], tuple[float, F64]]:
    n_x = len(plant.states)
    z, t = ca.SX.sym("z", n_x + len(plant.parameters)), ca.SX.sym("t")
    value = plant.sensed(z[:n_x], natural(plant, z[n_x:]), t)[MEASURABLE.index(channel)]
    function = ca.Function("shown", [z, t], [value, ca.densify(ca.jacobian(value, z))])

    def call(z_now: F64, t_now: float) -> tuple[float, F64]:
        y, H = function(z_now, t_now)
        return float(y), np.asarray(H)

    return call


def _low(p: Any) -> float:
    return float(np.log(p.lower)) if p.transform == "log" else float(p.lower)


def _high(p: Any) -> float:
    return float(np.log(p.upper)) if p.transform == "log" else float(p.upper)
