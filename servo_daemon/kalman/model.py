"""The extended Kalman filter's step as one CasADi function over the plant, parameters included as states.

State z = (x, q): the plant's states and the parameters, logarithms where they are positive. One step predicts over the
sample period just passed, with the input that was held during it, then takes the sample's channels one after another
(`measurement`).

The derivatives by the parameters are taken along an instrumental trajectory: the states as the model has them when it
follows the filter only slowly. Along the filter's own states, which hold the last samples' noise, an EKF takes that
noise for excitation: it gains information about L or J from nothing but the colour of the noise, and since regressor
and innovation then share their noise, what it gains is wrong (Ljung, *IEEE Trans. Autom. Control* 24, 1979, on the
bias; Söderström & Stoica, *Instrumental Variable Methods for System Identification*, 1983, on the cure).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import casadi as ca

from servo_daemon.kalman.expressions import natural, pack, unpack
from servo_daemon.kalman.layout import MEASURABLE, EkfLayout
from servo_daemon.kalman.measurement import measurement_update
from servo_daemon.plant.build import PlantModel

#: Shortest step, s: two samples with one time stamp must not divide by zero.
SHORTEST_STEP_S = 1e-9

#: Time constants with which the instrumental trajectory follows the filter, s. Long against a sample, short against
#: what a wrong model needs to run away; and at once, where the parameters are not known yet and the model would lead
#: it astray (decision 13).
INSTRUMENT_S, NO_INSTRUMENT_S = 0.1, 1e-9
#: An input known this many times worse than usual (in variance) leads it astray (chosen; half and twice move no
#: tracking figure).
DOUBTFUL_INPUT = 100.0
#: Its time constant is at most this share of its age (chosen; half and twice move no tracking figure).
_YOUTH = 0.1
#: After so many samples a filter that knew nothing of the speed has found it. Until then derivatives by the parameters
#: are of another motion, and what the speed does to the current would pass for L (decision 18).
SAMPLES_TO_FIND_SPEED = 3.0
#: Of the speed's standard deviation: four fifths of a Gaussian are further from its mean.
_TO_SLIDE = 0.25


@dataclass(frozen=True)
class Prediction:
    """States and instrumental trajectory after the step, derivatives, and the process noise of the plant's states."""

    x: ca.SX
    trajectory: ca.SX
    by_state: ca.SX
    by_parameter: ca.SX
    noise: ca.SX


def _own_state_noise(plant: PlantModel, h: ca.SX) -> ca.SX:
    """Effects' states may wander by 1 % of their scale in a second: their equations are approximations."""
    core = ("current_A", "velocity_rad_s", "position_rad")
    return ca.diag(ca.vertcat(*[0.0 if s.name in core else (0.01 * s.scale) ** 2 * h for s in plant.states]))


def _by_state(
    plant: PlantModel,
    x: ca.SX,
    u: ca.SX,
    p: ca.SX,
    t: ca.SX,
    h: ca.SX,
    x_next: ca.SX,
    speed_var: ca.SX,
) -> ca.SX:
    """d x_next / d x; where dry friction may hold the shaft, of a shaft that turns a little faster.

    A shaft that sticks forgets its speed: the derivative is zero, and the filter is sure that it stands. At a speed
    that is not known (a start, a gap, a wrong friction) that is a trap without a way out, since the samples then move
    nothing but the angle. The mean derivative over the speed's distribution (statistical linearisation; Gelb,
    *Applied Optimal Estimation*, 1974, sec. 6.2) is the share of it that slides: taken for nought or one, by whether
    the quarter of a standard deviation suffices to slide.
    """
    if not plant.may_stick:
        return ca.jacobian(x_next, x)
    away, k = ca.SX(x), plant.state_names.index("velocity_rad_s")
    away[k] += ca.if_else(x[k] >= 0, 1.0, -1.0) * _TO_SLIDE * ca.sqrt(ca.fmax(speed_var, 0.0))
    return ca.jacobian(plant.step(away, u, p, t, h), x)


def predict(
    plant: PlantModel,
    x: ca.SX,
    trajectory: ca.SX,
    q: ca.SX,
    u: ca.SX,
    t: ca.SX,
    h: ca.SX,
    var_u: ca.SX,
    torque_psd: ca.SX,
    speed_var: ca.SX,
    change: ca.SX | float = 0.0,
) -> Prediction:
    """The plant's step and its linearisation, by the states at (x, q), by the parameters at (trajectory, q).

    Args:
        var_u: variance of the held input.
        torque_psd: intensity of a white load torque, (N·m)²·s; held over one step its variance is psd / h.
        speed_var: of the speed in x, rad²/s².
        change: of the input across the step, about its mean.
    """
    p = natural(plant, q)
    x_next, modelled = plant.step(x, u, p, t, h), plant.step(trajectory, u, p, t, h)
    by_state = _by_state(plant, x, u, p, t, h, x_next, speed_var)
    gain = plant.noise_gain(x, u, p, t, h)
    noise = gain[:, 0] @ gain[:, 0].T * var_u + gain[:, 1] @ gain[:, 1].T * (torque_psd / h)
    noise += _own_state_noise(plant, h)
    if plant.drive != "voltage":
        x_next += _by_change(plant, gain, h, change)
        modelled += _by_change(plant, plant.noise_gain(trajectory, u, p, t, h), h, change)
    return Prediction(x_next, modelled, by_state, ca.jacobian(modelled, q), noise)


def _by_change(plant: PlantModel, gain: ca.SX, h: ca.SX, change: ca.SX | float) -> ca.SX:
    """What a change of the input across the step does to the states beside its mean: an acceleration that rises from a
    to b leads by h² (a/3 + b/6), not by h² (a + b)/4.

    Args:
        gain: the plant's `noise_gain`.
    """
    out = ca.SX(len(plant.states), 1)
    out[plant.state_names.index("position_rad")] = (
        -h / 12.0 * gain[plant.state_names.index("velocity_rad_s"), 0] * change
    )
    return out


@cache
def build_ekf_step(
    plant: PlantModel, channels: tuple[str, ...], mean_input: bool = False
) -> tuple[EkfLayout, ca.Function]:
    """The filter's step as a function for `SampleLoop`.

    Args:
        channels: which of `MEASURABLE` are measured, in that order.
        mean_input: a current as the input is the mean over the interval that ends at its sample.

    Raises:
        ValueError: an unknown channel, none at all, or current where the current is the input.
    """
    if not channels or any(c not in MEASURABLE for c in channels):
        raise ValueError(f"channels must be some of {MEASURABLE}, got {channels}")
    if plant.drive != "voltage" and "current_A" in channels:
        raise ValueError("current is the input of this plant, it cannot be measured as well")
    lay = EkfLayout(plant, channels)
    given, const = ca.SX.sym("state", lay.n_state), ca.SX.sym("const", lay.n_constants)
    sample = ca.SX.sym("sample", lay.n_sample)
    state = _corrected(lay, given, sample)
    z, P, modelled = _time_update(lay, state, const, sample, mean_input=mean_input)
    z, P, sums, output = measurement_update(lay, z, P, state, const, sample)
    held = ca.vertcat(sample[2], const[0] + sample[3])
    # Where the input was not known the model knows nothing; after an outlier, which may have been the input's, neither.
    trusted = ca.fmin(DOUBTFUL_INPUT * const[0] / ca.fmax(state[lay.held_variance], 1e-300), 1.0)
    slowly = trusted * slowness(ca.fmax(sample[1], SHORTEST_STEP_S), state[-1], const[-1])
    trajectory = trajectory_after(plant, modelled, z[lay.x], slowly)
    outlier = sum((output[3 * k + 2] for k in range(len(channels))), start=ca.SX(0)) > 0
    age = ca.if_else(outlier, SAMPLES_TO_FIND_SPEED * sample[1], state[-1] + sample[1])
    next_state = ca.vertcat(z, pack(P), held, sums, trajectory, age)
    return lay, ca.Function("step", [given, const, sample], ca.cse([next_state, output]))


def _corrected(lay: EkfLayout, state: ca.SX, sample: ca.SX) -> ca.SX:
    """The state with the held input as what came after it shows it. (Between two samples of a current or torque there
    is a line, and what is wrong with one of them was taken before.)"""
    if lay.plant.drive != "voltage":
        return state
    out = ca.SX(state)
    out[lay.held_input] += sample[lay.correction]
    out[lay.held_variance] += sample[lay.correction] ** 2
    return out


def slowness(h: ca.SX, age_s: ca.SX, time_constant_s: ca.SX) -> ca.SX:
    """What is left of the instrumental trajectory's distance from the filter after h. A young one follows quickly:
    after a gap or at the start the filter finds its own states first."""
    return ca.exp(-h / ca.fmin(time_constant_s, _YOUTH * (age_s + h)))


def found_speed(age_s: ca.SX, h: ca.SX) -> ca.SX:
    """1 from `SAMPLES_TO_FIND_SPEED` on, 0 before."""
    return ca.if_else(age_s >= (SAMPLES_TO_FIND_SPEED - 0.5) * h, 1.0, 0.0)


def trajectory_after(plant: PlantModel, modelled: ca.SX, x: ca.SX, slowly: ca.SX) -> ca.SX:
    """The instrumental trajectory follows the filter slowly in what noise drives (current, speed), at once in the rest.

    Args:
        slowly: 1 .. 0: from not at all to at once.
    """
    slow = ca.vertcat(*[1.0 if s.name in ("current_A", "velocity_rad_s") else 0.0 for s in plant.states])
    return x + slow * slowly * (modelled - x)


def acting(lay: EkfLayout, state: Any, const: Any, sample: Any, *, mean_input: bool) -> tuple[Any, Any, Any]:
    """The input's mean over the step before a sample, the variance of that, and its change across the step."""
    u, var_u = state[lay.held_input], state[lay.held_variance]
    if lay.plant.drive == "voltage":
        return u, var_u, 0.0
    off_line, change = sample[lay.correction + 1], sample[lay.correction + 2]
    if mean_input:
        return sample[2], const[0] + sample[3], 0.0
    return (u + sample[2]) / 2 + off_line, (var_u + const[0] + sample[3]) / 4, change


def _time_update(
    lay: EkfLayout, state: ca.SX, const: ca.SX, sample: ca.SX, *, mean_input: bool
) -> tuple[ca.SX, ca.SX, ca.SX]:
    n_x = lay.n_x
    x, q, P = state[lay.x], state[lay.q], unpack(state[lay.tri], lay.n_z)
    h = ca.fmax(sample[1], SHORTEST_STEP_S)
    u, var_u, change = acting(lay, state, const, sample, mean_input=mean_input)
    at = lay.plant.state_names.index("velocity_rad_s")
    step = predict(lay.plant, x, state[lay.trajectory], q, u, sample[0] - h, h, var_u, const[1], P[at, at], change)
    M = ca.horzcat(step.by_state, step.by_parameter * found_speed(state[-1], h))
    T = M @ P
    P_xx = T @ M.T + step.noise
    P_xq = T[:, n_x:]
    P_qq = P[n_x:, n_x:] + ca.diag(const[lay.walk] * h)
    P_next = ca.vertcat(ca.horzcat(P_xx, P_xq), ca.horzcat(P_xq.T, P_qq))
    return ca.vertcat(step.x, q), P_next, step.trajectory
