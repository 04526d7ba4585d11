"""The extended Kalman filter's step as one CasADi function over the plant, parameters included as states.

State z = (x, q): the plant's states and the parameters, logarithms where they are positive. One step predicts over the
sample period just passed, with the input that was held during it, then takes the sample's channels one after another.

Covariance in Joseph's form with an arbitrary gain (Bucy & Joseph 1968; Bierman 1977, eq. II.6.8):

    P⁺ = P − k (P Hᵀ)ᵀ − (P Hᵀ) kᵀ + s k kᵀ,   s = H P Hᵀ + r

kept as its lower triangle, so that it is symmetric by construction. Because the form holds for any gain, a parameter
whose motion says nothing can be held by zeroing its row of the gain (Schmidt's "considered" parameter) and a suspected
outlier by enlarging r, both without P becoming a lie.

An innovation beyond `GATE` standard deviations is not thrown away but weighted down to the weight it would have at the
gate: a single wrong sample moves nothing much, a model that has gone wrong is never locked out of its data.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, cached_property

import casadi as ca

from servo_daemon.plant.build import PlantModel

#: Standard deviations at which an innovation is weighted down: 1 in 1.7 million for a Gaussian.
GATE = 5.0

#: Shortest step, s: two samples with one time stamp must not divide by zero.
_SHORTEST_STEP_S = 1e-9

#: Channels the filter can take, in the order in which it takes them.
MEASURABLE = ("current_A", "velocity_rad_s", "position_rad")


@dataclass(frozen=True)
class EkfLayout:
    """Where everything is in the flat vectors that the compiled loop carries.

    state:     x | q | lower triangle of P by columns | held input | its variance | information gained per parameter
    constants: var_input | torque_psd | walk per parameter (1/s) | active per parameter | r per channel
    sample:    t | h | input | extra variance of the input | (y, valid, doubt) per channel; doubt multiplies r
    output:    (innovation, its variance, gated) per channel
    """

    plant: PlantModel
    channels: tuple[str, ...]

    @cached_property
    def n_x(self) -> int:
        return len(self.plant.states)

    @cached_property
    def n_q(self) -> int:
        return len(self.plant.parameters)

    @cached_property
    def n_z(self) -> int:
        return self.n_x + self.n_q

    @cached_property
    def n_tri(self) -> int:
        return self.n_z * (self.n_z + 1) // 2

    @cached_property
    def n_state(self) -> int:
        return self.n_z + self.n_tri + 2 + self.n_q

    @cached_property
    def n_constants(self) -> int:
        return 2 + 2 * self.n_q + len(self.channels)

    @cached_property
    def n_sample(self) -> int:
        return 4 + 3 * len(self.channels)

    @cached_property
    def n_output(self) -> int:
        return 3 * len(self.channels)

    @cached_property
    def z(self) -> slice:
        return slice(0, self.n_z)

    @cached_property
    def x(self) -> slice:
        return slice(0, self.n_x)

    @cached_property
    def q(self) -> slice:
        return slice(self.n_x, self.n_z)

    @cached_property
    def tri(self) -> slice:
        return slice(self.n_z, self.n_z + self.n_tri)

    @cached_property
    def held_input(self) -> int:
        return self.n_z + self.n_tri

    @cached_property
    def held_variance(self) -> int:
        return self.held_input + 1

    @cached_property
    def information(self) -> slice:
        return slice(self.n_state - self.n_q, self.n_state)


def natural(plant: PlantModel, q: ca.SX) -> ca.SX:
    """Parameters in their units from what the filter estimates."""
    parts = [ca.exp(q[k]) if p.transform == "log" else q[k] for k, p in enumerate(plant.parameters)]
    return ca.vertcat(*parts)


def _pack(P: ca.SX) -> ca.SX:
    """Lower triangle, column by column."""
    n = P.size1()
    return ca.vertcat(*[P[row, column] for column in range(n) for row in range(column, n)])


def _unpack(tri: ca.SX, n: int) -> ca.SX:
    P, k = ca.SX.zeros(n, n), 0
    for column in range(n):
        for row in range(column, n):
            P[row, column] = P[column, row] = tri[k]
            k += 1
    return P


@dataclass(frozen=True)
class Prediction:
    """x_next, its derivatives, and the process noise of the plant's states."""

    x: ca.SX
    by_state: ca.SX
    by_parameter: ca.SX
    noise: ca.SX


def _own_state_noise(plant: PlantModel, h: ca.SX) -> ca.SX:
    """Effects' states may wander by 1 % of their scale in a second: their equations are approximations."""
    core = ("current_A", "velocity_rad_s", "position_rad")
    return ca.diag(ca.vertcat(*[0.0 if s.name in core else (0.01 * s.scale) ** 2 * h for s in plant.states]))


def predict(
    plant: PlantModel, x: ca.SX, q: ca.SX, u: ca.SX, t: ca.SX, h: ca.SX, var_u: ca.SX, torque_psd: ca.SX
) -> Prediction:
    """The plant's step and its linearisation at (x, q).

    Args:
        var_u: variance of the held input.
        torque_psd: intensity of a white load torque, (N·m)²·s; held over one step its variance is psd / h.
    """
    p = natural(plant, q)
    x_next = plant.step(x, u, p, t, h)
    gain = plant.noise_gain(x, u, p, t, h)
    noise = gain[:, 0] @ gain[:, 0].T * var_u + gain[:, 1] @ gain[:, 1].T * (torque_psd / h)
    return Prediction(x_next, ca.jacobian(x_next, x), ca.jacobian(x_next, q), noise + _own_state_noise(plant, h))


@cache
def build_ekf_step(plant: PlantModel, channels: tuple[str, ...]) -> tuple[EkfLayout, ca.Function]:
    """The filter's step as a function for `SampleLoop`.

    Args:
        channels: which of `MEASURABLE` are measured, in that order.

    Raises:
        ValueError: an unknown channel, none at all, or current where the current is the input.
    """
    if not channels or any(c not in MEASURABLE for c in channels):
        raise ValueError(f"channels must be some of {MEASURABLE}, got {channels}")
    if plant.drive != "voltage" and "current_A" in channels:
        raise ValueError("current is the input of this plant, it cannot be measured as well")
    lay = EkfLayout(plant, channels)
    state, const = ca.SX.sym("state", lay.n_state), ca.SX.sym("const", lay.n_constants)
    sample = ca.SX.sym("sample", lay.n_sample)
    z, P = _time_update(lay, state, const, sample)
    z, P, information, output = _measurement_update(lay, z, P, state, const, sample)
    held = ca.vertcat(sample[2], const[0] + sample[3])
    next_state = ca.vertcat(z, _pack(P), held, information)
    return lay, ca.Function("step", [state, const, sample], [next_state, output])


def _time_update(lay: EkfLayout, state: ca.SX, const: ca.SX, sample: ca.SX) -> tuple[ca.SX, ca.SX]:
    n_x, n_q = lay.n_x, lay.n_q
    x, q, P = state[lay.x], state[lay.q], _unpack(state[lay.tri], lay.n_z)
    h = ca.fmax(sample[1], _SHORTEST_STEP_S)
    u, var_u = state[lay.held_input], state[lay.held_variance]
    if lay.plant.drive != "voltage":  # a measured current or torque is a sample of a continuous signal: trapezoid
        u, var_u = (u + sample[2]) / 2, (var_u + const[0] + sample[3]) / 4
    step = predict(lay.plant, x, q, u, sample[0] - h, h, var_u, const[1])
    M = ca.horzcat(step.by_state, step.by_parameter)
    T = M @ P
    P_xx = T @ M.T + step.noise
    P_xq = T[:, n_x:]
    P_qq = P[n_x:, n_x:] + ca.diag(const[2 : 2 + n_q] * h)
    P_next = ca.vertcat(ca.horzcat(P_xx, P_xq), ca.horzcat(P_xq.T, P_qq))
    return ca.vertcat(step.x, q), P_next


def _measurement_update(
    lay: EkfLayout, z: ca.SX, P: ca.SX, state: ca.SX, const: ca.SX, sample: ca.SX
) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
    n_x, n_q = lay.n_x, lay.n_q
    rows = ca.vertcat(ca.SX.ones(n_x), const[2 + n_q : 2 + 2 * n_q])
    information, outputs = state[lay.information], []
    for k, channel in enumerate(lay.channels):
        y, valid, doubt = sample[4 + 3 * k], sample[5 + 3 * k], sample[6 + 3 * k]
        r = const[2 + 2 * n_q + k] * doubt
        shown, H = _shown(lay, channel)
        predicted, H_here = ca.Function("shown", shown, [H[0], H[1]])(z, sample[0])
        PHt = P @ H_here.T
        s0 = H_here @ PHt
        innovation = y - predicted
        s = ca.fmax(s0 + r, innovation**2 / GATE**2)
        gain = valid * rows * PHt / s
        # What this sample would tell of each parameter if it were free: held ones must be able to wake up.
        p_qq, seen = ca.diag(P)[n_x:], PHt[n_x:]
        reduction = seen**2 / s
        information = information + valid * reduction / (p_qq * (p_qq - reduction))
        z = z + gain * innovation
        P = P - gain @ PHt.T - PHt @ gain.T + s * (gain @ gain.T)
        gated = valid * (innovation**2 > GATE**2 * (s0 + r))
        outputs += [valid * innovation, s0 + r, gated]
    bounds = [_bounds(p.lower, p.upper, p.transform) for p in lay.plant.parameters]
    q = [ca.fmax(ca.fmin(z[n_x + k], high), low) for k, (low, high) in enumerate(bounds)]
    return ca.vertcat(z[:n_x], *q), P, information, ca.vertcat(*outputs)


def _shown(lay: EkfLayout, channel: str) -> tuple[list[ca.SX], tuple[ca.SX, ca.SX]]:
    """What the channel's sensor shows and its derivative, as expressions in fresh symbols."""
    z, t = ca.SX.sym("z", lay.n_z), ca.SX.sym("t")
    value = lay.plant.sensed(z[: lay.n_x], natural(lay.plant, z[lay.n_x :]), t)[MEASURABLE.index(channel)]
    return [z, t], (value, ca.jacobian(value, z))


def _bounds(lower: float, upper: float, transform: str) -> tuple[float, float]:
    """Bounds in the estimated coordinate."""
    return (math.log(lower), math.log(upper)) if transform == "log" else (lower, upper)
