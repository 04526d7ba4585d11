"""Gains for a design frequency: SIMC for the PI speed loop, a cascade on top of it for the angle, LQR.

Each family has one free number ω (rad/s); `search.py` finds the ω that gives the bandwidth or settling time asked for,
on the exact sampled loop. The formulas in here only have to propose good gains, they are not what is promised.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from servo_daemon.samples import F64
from servo_daemon.tuning.knowledge import NEEDED, CascadeGains, LoopSetup
from servo_daemon.tuning.laws import Gains, StateGains, smoothing
from servo_daemon.tuning.sampled import CURRENT, MEAN_SPEED, N_MOTION, SPEED, SampledMotor, sampled_motor

#: The speed's low-pass lies this far above the loop's own frequency, but not beyond this share of the sample rate,
#: where a first-order filter of a sampled difference stops to smooth.
_FILTER_ABOVE, _FILTER_SHARE = 10.0, 0.25
#: The LQR's integral acts at this share of its frequency.
_INTEGRAL_SHARE = 1.0 / 3.0


@dataclass(frozen=True, slots=True)
class MotorLags:
    """ω/v as gain and two lags: k / ((τ₁ s + 1)(τ₂ s + 1)), τ₁ ≥ τ₂; complex poles count as two equal lags."""

    gain: float
    slow_s: float
    fast_s: float


def motor_lags(p: Mapping[str, float]) -> MotorLags:
    """The motor's. J L s² + (R J + L B) s + R B + K² = 0."""
    poles = np.roots([p["J"] * p["L"], p["R"] * p["J"] + p["L"] * p["B"], p["R"] * p["B"] + p["K"] ** 2])
    slow, fast = sorted(1.0 / np.abs(poles), reverse=True)
    return MotorLags(p["K"] / (p["R"] * p["B"] + p["K"] ** 2), float(slow), float(fast))


def filter_hz(omega: float, setup: LoopSetup) -> float:
    """Cut-off of the speed's low-pass, Hz."""
    if setup.filter_hz is not None:
        return setup.filter_hz
    return min(_FILTER_ABOVE * omega / (2 * math.pi), _FILTER_SHARE * setup.rate_hz)


@dataclass(frozen=True, slots=True)
class _SpeedPi:
    kp: float
    ki: float
    weight: float
    pole_rad_s: float  # what remains of the closed speed loop


def _speed_pi(p: Mapping[str, float], omega: float) -> _SpeedPi:
    """SIMC (Skogestad, *Simple analytic rules for model reduction and PID controller tuning*, J. Process Control 13,
    2003): half of the smaller lag counts to the larger one; k_p = τ ω / k, T_i = min(τ, 4/ω).

    The setpoint weight puts the PI's zero onto the slower closed-loop pole, which then does not show in a step.
    """
    lags = motor_lags(p)
    tau = lags.slow_s + lags.fast_s / 2.0
    Ti = min(tau, 4.0 / omega)
    kp = tau * omega / lags.gain
    a, b, c = tau * Ti, Ti * (1.0 + tau * omega), tau * omega
    root = math.sqrt(max(b * b - 4.0 * a * c, 0.0))
    slow = 2.0 * c / (b + root)
    weight = min(1.0, 1.0 / (slow * Ti))
    return _SpeedPi(kp, kp / Ti, weight, omega * weight)


def speed_gains(p: Mapping[str, float], setup: LoopSetup, omega: float) -> CascadeGains:
    """Gains of a PI speed loop."""
    pi = _speed_pi(p, omega)
    return CascadeGains(pi.kp, pi.ki, setpoint_weight=pi.weight, filter_hz=filter_hz(omega, setup))


def position_gains(p: Mapping[str, float], setup: LoopSetup, omega: float) -> CascadeGains:
    """P around the PI, which together is a PID: k_pθ is a third of the speed loop's pole p, so that the angle, with
    s² + p s + p k_pθ, is damped with a ratio of √3/2 and overshoots by 0.4 %."""
    pi = _speed_pi(p, omega)
    return CascadeGains(
        pi.kp,
        pi.ki,
        position_kp_1_s=pi.pole_rad_s / 3.0,
        setpoint_weight=pi.weight,
        filter_hz=filter_hz(omega, setup),
    )


def lqr_gains(p: Mapping[str, float], setup: LoopSetup, omega: float) -> StateGains:
    """Discrete LQR on (angle error, speed, current, last voltages, integral), minimising Σ ε² + (ω/3)² z² + ρ v².

    ρ = |θ/v (jω)|² balances both terms at ω, so that the closed loop is about as fast as ω (symmetric root locus;
    Franklin, Powell & Emami-Naeini, *Feedback Control of Dynamic Systems*).

    Raises:
        np.linalg.LinAlgError: the Riccati equation has no solution.
    """
    from scipy.linalg import solve_discrete_are

    cut = filter_hz(omega, setup)
    motor = sampled_motor(np.log([[p[name] for name in NEEDED]]), setup.period_s, setup.delay_samples)
    A, B = _with_angle_and_integral(motor)
    angle = _angle_per_volt(motor, omega)
    n = len(A)
    Q = np.zeros((n, n))
    Q[n - 2, n - 2], Q[n - 1, n - 1] = 1.0, (_INTEGRAL_SHARE * omega) ** 2
    b = B / angle  # voltages in units of 1/angle: weight 1
    X = solve_discrete_are(A, b[:, None], Q, np.eye(1))
    gain = b @ X @ A / (1.0 + b @ X @ b)
    row = gain / angle
    stored = motor.B.shape[1] - N_MOTION
    rates = -np.log(np.abs(np.linalg.eigvals(A - np.outer(b, gain))) + 1e-300) / setup.period_s
    slow = float(rates.min())
    angle_gain, integral = float(row[n - 2]), float(row[n - 1])
    return StateGains(
        angle_V_rad=angle_gain,
        speed_V_s_rad=float(row[1]),
        current_V_A=float(row[0]),
        integral_V_rad_s=integral,
        previous_V_V=tuple(float(v) for v in row[2 : 2 + stored]),
        setpoint_weight=min(1.0, max(0.0, integral / (angle_gain * slow))),
        filter_hz=cut,
    )


def _with_angle_and_integral(motor: SampledMotor) -> tuple[F64, F64]:
    """(i, ω, last voltages, θ, z) of the first motor, with the mean speed replaced by its sum, the angle."""
    keep = [CURRENT, SPEED, *range(N_MOTION, motor.B.shape[1])]
    n, T = len(keep) + 2, motor.period_s
    A, B = np.zeros((n, n)), np.zeros(n)
    A[: n - 2, : n - 2], B[: n - 2] = motor.A[0][np.ix_(keep, keep)], motor.B[0, keep]
    A[n - 2, : n - 2], B[n - 2] = T * motor.A[0][MEAN_SPEED, keep], T * motor.B[0, MEAN_SPEED]
    A[n - 2, n - 2] = A[n - 1, n - 1] = 1.0
    A[n - 1, n - 2] = T
    return A, B


def _angle_per_volt(motor: SampledMotor, omega: float) -> float:
    z = np.exp(1j * np.array([min(omega, 0.99 * np.pi / motor.period_s)]) * motor.period_s)
    w, _ = motor.response(z)
    return float(np.abs(w[0, 0] * motor.period_s / (z[0] - 1.0)))


@dataclass(frozen=True, slots=True)
class Family:
    """One kind of controller: its key in documents, what it is, its gains for a motor and a design frequency, and
    whether it needs the current, whose answer to the voltage no encoder shows."""

    key: str
    title: str
    make: Callable[[Mapping[str, float], LoopSetup, float], Gains]
    measures_current: bool = False


FAMILIES: tuple[Family, ...] = (
    Family("speed_pi", "PI speed loop", speed_gains),
    Family("position_pid", "PID position loop: P around the PI speed loop", position_gains),
    Family("lqr", "LQR with integral action on angle, speed and current", lqr_gains, measures_current=True),
)


def lateness_s(p: Mapping[str, float], gains: Gains, setup: LoopSetup) -> dict[str, float]:
    """What makes the loop late, s: the parts of the effective delay that bounds its bandwidth."""
    T = setup.period_s
    alpha = smoothing(gains.filter_hz, T)
    return {
        "the delay": setup.delay_samples * T,
        "sampling, hold and encoder difference": T,
        "the speed filter": T * alpha / (1.0 - alpha),
        "the armature (L/R and the motor's faster pole)": motor_lags(p).fast_s / 2.0,
    }
