"""The same filter on filterpy's ExtendedKalmanFilter: readable, slow, and the check on the compiled one.

It runs sample by sample in Python over the same plant, keeps the same flat vectors as `ekf_model` and so can take the
place of the compiled loop (`engine = "filterpy"`). The two agree to rounding; a test holds them to 1e-6.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from servo_daemon.estimators.ekf_model import _SHORTEST_STEP_S, GATE, MEASURABLE, EkfLayout, natural, predict
from servo_daemon.plant.build import PlantModel
from servo_daemon.samples import F64


class FilterpyLoop:
    """Drop-in for `SampleLoop`: `run(state, constants, samples)` changes `state`, returns the innovations."""

    def __init__(self, plant: PlantModel, channels: tuple[str, ...]) -> None:
        self._lay = EkfLayout(plant, channels)
        self._predict = _prediction(plant)
        self._shown = [_shown(plant, channel) for channel in channels]
        rows, columns = np.tril_indices(self._lay.n_z)
        order = np.lexsort((rows, columns))
        self._rows, self._columns = rows[order], columns[order]
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
            self._time_update(ekf, state, constants, sample)
            for k in range(len(lay.channels)):
                outputs[row, 3 * k : 3 * k + 3] = self._measure(ekf, state, constants, sample, k)
            q = ekf.x[lay.q]
            ekf.x[lay.q] = np.clip(q, self._low, self._high)
            # Rounding leaves P a little asymmetric; carried on or not, that must not depend on where a run ends.
            ekf.P[self._columns, self._rows] = ekf.P[self._rows, self._columns]
            state[lay.held_input], state[lay.held_variance] = sample[2], constants[0] + sample[3]
        state[lay.z] = ekf.x
        state[lay.tri] = ekf.P[self._rows, self._columns]
        return outputs

    def _time_update(self, ekf: Any, state: F64, constants: F64, sample: F64) -> None:
        lay, h = self._lay, max(sample[1], _SHORTEST_STEP_S)
        u, var_u = state[lay.held_input], state[lay.held_variance]
        if lay.plant.drive != "voltage":
            u, var_u = (u + sample[2]) / 2, (var_u + constants[0] + sample[3]) / 4
        x_next, by_z, noise = self._predict(ekf.x[lay.x], ekf.x[lay.q], u, sample[0] - h, h, var_u, constants[1])
        F, Q = np.eye(lay.n_z), np.zeros((lay.n_z, lay.n_z))
        F[lay.x, :] = by_z
        Q[lay.x, lay.x] = noise
        Q[lay.q, lay.q] = np.diag(constants[2 : 2 + lay.n_q] * h)
        ekf.F, ekf.Q = F, Q
        ekf.P = F @ ekf.P @ F.T + Q
        ekf.x = np.concatenate([x_next, ekf.x[lay.q]])

    def _measure(self, ekf: Any, state: F64, constants: F64, sample: F64, k: int) -> tuple[float, float, float]:
        """One channel, by filterpy's own update (Joseph's form) with the gated variance and the held rows."""
        lay = self._lay
        y, valid, doubt = sample[4 + 3 * k : 7 + 3 * k]
        r = constants[2 + 2 * lay.n_q + k] * doubt
        predicted, H = self._shown[k](ekf.x, sample[0])
        s0 = float((H @ ekf.P @ H.T)[0, 0])
        innovation = float(y - predicted)
        s = max(s0 + r, innovation**2 / GATE**2)
        if valid > 0:
            PHt = (ekf.P @ H.T)[:, 0]
            reduction, p_qq = PHt[lay.q] ** 2 / s, np.diag(ekf.P)[lay.q]
            state[lay.information] += reduction / (p_qq * (p_qq - reduction))
            self._update(ekf, H, innovation, s, s - s0, constants)
        gated = float(innovation**2 > GATE**2 * (s0 + r))
        return valid * innovation, s0 + r, valid * gated

    def _update(self, ekf: Any, H: F64, innovation: float, s: float, r: float, constants: F64) -> None:
        lay = self._lay
        active = np.concatenate([np.ones(lay.n_x), constants[2 + lay.n_q : 2 + 2 * lay.n_q]])
        if active.all():
            # The innovation is already known: hand filterpy a measurement whose residual is just that.
            ekf.update(np.array([innovation]), lambda _x: H, lambda _x: np.zeros(1), R=np.array([[r]]))
            ekf.x = ekf.x.reshape(-1)
            return
        gain = active * (ekf.P @ H.T)[:, 0] / s  # filterpy has no considered parameters: Joseph's form by hand
        I_KH = np.eye(lay.n_z) - np.outer(gain, H[0])
        ekf.x = ekf.x + gain * innovation
        ekf.P = I_KH @ ekf.P @ I_KH.T + r * np.outer(gain, gain)


def _prediction(plant: PlantModel) -> Callable[..., tuple[F64, F64, F64]]:
    x, q = ca.SX.sym("x", len(plant.states)), ca.SX.sym("q", len(plant.parameters))
    u, t, h, var_u, psd = (ca.SX.sym(n) for n in ("u", "t", "h", "var_u", "psd"))
    step = predict(plant, x, q, u, t, h, var_u, psd)
    by_z = ca.horzcat(step.by_state, step.by_parameter)
    function = ca.Function("predict", [x, q, u, t, h, var_u, psd], [step.x, ca.densify(by_z), ca.densify(step.noise)])

    def call(*arguments: Any) -> tuple[F64, F64, F64]:
        x_next, F, Q = function(*arguments)
        return np.asarray(x_next).reshape(-1), np.asarray(F), np.asarray(Q)

    return call


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
