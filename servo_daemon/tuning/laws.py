"""The control laws, written down once: as text, and as the linear controller that is analysed.

Time index k, sample period T. The encoder gives θ, its difference the speed, smoothed by a first-order low-pass:

    w[k] = (θ[k] − θ[k−1]) / T        ω̂[k] = α ω̂[k−1] + (1 − α) w[k],   α = exp(−2π f_c T)

Integrals are sums that hold the present error (backward rectangle). See `docs/tuning.md`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servo_daemon.samples import F64
from servo_daemon.tuning.knowledge import CascadeGains
from servo_daemon.tuning.sampled import Controller

SPEED_FILTER = r"\hat\omega_k = \alpha\hat\omega_{k-1} + (1-\alpha)(\theta_k-\theta_{k-1})/T,\ \alpha = e^{-2\pi f_c T}"
SPEED_LAW = (
    r"e_k = \omega^*_k - \hat\omega_k,\quad I_k = I_{k-1} + T e_k,\quad "
    r"v_k = k_p (b\,\omega^*_k - \hat\omega_k) + k_i I_k"
)
POSITION_LAW = (
    r"\epsilon_k = \theta^*_k - \theta_k,\quad S_k = S_{k-1} + T\epsilon_k,\quad "
    r"\omega^*_k = k_{p\theta}\epsilon_k + k_{i\theta} S_k - k_{d\theta}\hat\omega_k,\quad " + SPEED_LAW
)
STATE_LAW = (
    r"\epsilon_k = \theta_k - \theta^*_k,\quad "
    r"v_k = -k_\theta(\theta_k - b\,\theta^*_k) - k_\omega\hat\omega_k - k_i i_k - k_z z_k"
    r" - \sum_j k_{vj} v_{k-j},\quad z_{k+1} = z_k + T\epsilon_k"
)


@dataclass(frozen=True, slots=True)
class StateGains:
    """State feedback with integral action: `STATE_LAW`.

    Attributes:
        angle_V_rad, speed_V_s_rad, current_V_A, integral_V_rad_s: gains on the angle's error, the speed, the current
            and the error's integral.
        previous_V_V: gains on the last voltages, newest first, that have not acted yet.
        setpoint_weight: b.
        filter_hz: cut-off of the speed's low-pass.
    """

    angle_V_rad: float
    speed_V_s_rad: float
    current_V_A: float
    integral_V_rad_s: float
    previous_V_V: tuple[float, ...]
    setpoint_weight: float
    filter_hz: float | None


Gains = CascadeGains | StateGains


def smoothing(filter_hz: float | None, period_s: float) -> float:
    """α of the speed's low-pass; 0 without one."""
    return 0.0 if filter_hz is None else math.exp(-2.0 * math.pi * filter_hz * period_s)


def controller(gains: Gains, period_s: float) -> Controller:
    """The linear controller of these gains."""
    return cascade(gains, period_s) if isinstance(gains, CascadeGains) else state_feedback(gains, period_s)


class _Rows:
    """Linear combinations of (controller states, w, i, r), built from earlier ones."""

    def __init__(self, states: Sequence[str]) -> None:
        self.states = tuple(states)
        self._unit = np.eye(len(self.states) + 3)

    def __getitem__(self, name: str) -> F64:
        """The quantity itself; zero for a state that this controller does not have."""
        names = (*self.states, "w", "i", "r")
        return self._unit[names.index(name)] if name in names else np.zeros(len(names))

    def build(self, position: bool, u: F64, updates: dict[str, F64], previous: F64) -> Controller:
        c = len(self.states)
        rows = np.array([updates[name] for name in self.states]).reshape(c, c + 3)
        return Controller(
            position, rows[:, :c], rows[:, c : c + 2], rows[:, c + 2], u[:c], u[c : c + 2], float(u[c + 2]), previous
        )


def cascade(g: CascadeGains, period_s: float) -> Controller:
    """`SPEED_LAW`, or `POSITION_LAW` where there is a position loop. An integral without gain is left out."""
    T, alpha, position = period_s, smoothing(g.filter_hz, period_s), g.position_kp_1_s is not None
    wanted = {
        "f": alpha > 0,
        "theta": position,
        "S": position and g.position_ki_1_s2 > 0,
        "I": g.speed_ki_V_rad > 0,
    }
    q = _Rows([name for name, there in wanted.items() if there])
    speed = alpha * q["f"] + (1 - alpha) * q["w"]
    theta = q["theta"] + T * q["w"]
    S = q["S"] + T * (q["r"] - theta)
    reference = q["r"]
    if g.position_kp_1_s is not None:
        reference = g.position_kp_1_s * (q["r"] - theta) + g.position_ki_1_s2 * S - g.position_kd * speed
    integral = q["I"] + T * (reference - speed)
    u = g.speed_kp_V_s_rad * (g.setpoint_weight * reference - speed) + g.speed_ki_V_rad * integral
    return q.build(position, u, {"f": speed, "theta": theta, "S": S, "I": integral}, np.zeros(0))


def state_feedback(g: StateGains, period_s: float) -> Controller:
    """The controller of `STATE_LAW` with these gains."""
    T, alpha = period_s, smoothing(g.filter_hz, period_s)
    q = _Rows((["f"] if alpha > 0 else []) + ["theta", "z"])
    speed = alpha * q["f"] + (1 - alpha) * q["w"]
    theta = q["theta"] + T * q["w"]
    u = -g.angle_V_rad * (theta - g.setpoint_weight * q["r"])
    u = u - g.speed_V_s_rad * speed - g.current_V_A * q["i"] - g.integral_V_rad_s * q["z"]
    updates = {"f": speed, "theta": theta, "z": q["z"] + T * (theta - q["r"])}
    return q.build(True, u, updates, -np.array(g.previous_V_V))
