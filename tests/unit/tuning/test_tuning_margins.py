"""Margins against python-control, closed formulas and the closed loop itself; the loop written a second time here."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pytest
from scipy.linalg import expm

from servo_daemon.samples import F64
from servo_daemon.tuning.design import lqr_gains
from servo_daemon.tuning.knowledge import CascadeGains, LoopSetup
from servo_daemon.tuning.laws import Gains, StateGains, controller
from servo_daemon.tuning.margins import Margins, margins
from servo_daemon.tuning.response import duration_s, response, step
from servo_daemon.tuning.sampled import C128, closed_loop, sampled_motor
from tests.recovery.generator.motors import MOTORS, PAPER, RE40, Motor

NAMES = ("R", "L", "K", "J", "B")


def logs(motor: Motor | Mapping[str, float]) -> F64:
    get = motor.__getitem__ if isinstance(motor, Mapping) else lambda name: getattr(motor, name)
    return np.log([[get(name) for name in NAMES]])


def found(motor: Motor | Mapping[str, float], gains: Gains, rate_hz: float, delay: float) -> Margins:
    sampled = sampled_motor(logs(motor), 1.0 / rate_hz, delay)
    return margins(sampled, controller(gains, 1.0 / rate_hz)).of(0)


def second_opinion(motor: Motor, gains: CascadeGains | StateGains, rate_hz: float, delay: int, omega: F64) -> C128:
    """The return ratio with python-control's own sampling, and the law as `docs/tuning.md` writes it."""
    import control

    T = 1.0 / rate_hz
    z = np.exp(1j * omega * T)
    A = [[-motor.R / motor.L, -motor.K / motor.L, 0], [motor.K / motor.J, -motor.B / motor.J, 0], [0, 1, 0]]
    continuous = control.ss(A, [[1 / motor.L], [0], [0]], [[1, 0, 0], [0, 0, 1]], [[0], [0]])
    current, theta = control.sample_system(continuous, T, "zoh")(z)[:, 0]
    alpha = 0.0 if gains.filter_hz is None else math.exp(-2 * math.pi * gains.filter_hz * T)
    speed = (1 - alpha) / (1 - alpha / z) * (1 - 1 / z) / T
    summed = T / (1 - 1 / z)
    if isinstance(gains, StateGains):
        law = (gains.angle_V_rad + gains.speed_V_s_rad * speed + gains.integral_V_rad_s * summed / z) * theta
        own = 1 + sum(k / z ** (j + 1) for j, k in enumerate(gains.previous_V_V))
        return (law + gains.current_V_A * current) / own / z**delay
    pi = gains.speed_kp_V_s_rad + gains.speed_ki_V_rad * summed
    if gains.position_kp_1_s is None:
        return pi * speed * theta / z**delay
    outer = gains.position_kp_1_s + gains.position_ki_1_s2 * summed + gains.position_kd * speed
    weighted = gains.setpoint_weight * gains.speed_kp_V_s_rad + gains.speed_ki_V_rad * summed
    return (weighted * outer + pi * speed) * theta / z**delay


LOOPS = {
    "paper-speed": (PAPER, CascadeGains(0.8, 58.0, filter_hz=80.0), 1000.0, 1),
    "paper-speed-raw": (PAPER, CascadeGains(0.8, 58.0), 1000.0, 0),
    "re40-speed-weighted": (RE40, CascadeGains(0.1, 8.0, setpoint_weight=0.6, filter_hz=200.0), 1000.0, 2),
    "paper-cascade": (PAPER, CascadeGains(0.63, 43.5, 9.6, setpoint_weight=0.7, filter_hz=61.0), 1000.0, 1),
    "paper-full": (PAPER, CascadeGains(0.63, 43.5, 9.6, 12.0, 0.2, 0.7, 61.0), 2000.0, 1),
    "re40-p-of-p": (RE40, CascadeGains(0.07, 0.0, 24.0, filter_hz=150.0), 1000.0, 1),
    "paper-lqr": (PAPER, StateGains(152.0, 1.5, 0.19, 2176.0, (0.08,), 0.6, 106.0), 1000.0, 1),
}


@pytest.mark.parametrize("name", LOOPS)
def test_margins_are_those_of_python_control(name: str) -> None:
    import control

    motor, gains, rate_hz, delay = LOOPS[name]
    ours = found(motor, gains, rate_hz, delay)
    omega = np.geomspace(1e-5, 1, 8000) * math.pi * rate_hz
    L = second_opinion(motor, gains, rate_hz, delay, omega)
    data = (np.abs(L), np.degrees(np.unwrap(np.angle(L))), omega)
    gain, phase, sensitivity, _, _, _ = control.stability_margins(data, returnall=True)
    assert ours.stable
    assert ours.phase_margin_deg == pytest.approx(min(phase), abs=0.05)
    assert ours.gain_margin_dB == pytest.approx(20 * math.log10(min(g for g in gain if g > 1)), abs=0.02)
    assert ours.sensitivity_peak == pytest.approx(1 / min(sensitivity), rel=2e-3)


@pytest.mark.parametrize("name", ["paper-speed", "paper-full", "paper-lqr"])
def test_a_step_is_described_as_python_control_describes_it(name: str) -> None:
    import control

    motor, gains, rate_hz, delay = LOOPS[name]
    sampled, law = sampled_motor(logs(motor), 1.0 / rate_hz, delay), controller(gains, 1.0 / rate_hz)
    ours = response(sampled, law)
    shown = step(sampled, law, duration_s(sampled, law))
    info = control.step_info(shown.shown, shown.time_s, None, 1.0, SettlingTimeThreshold=0.02)
    found = (ours.rise_s, ours.settling_s, ours.overshoot_percent)
    assert found == pytest.approx((info["RiseTime"], info["SettlingTime"], info["Overshoot"]), rel=1e-9, abs=1e-9)
    assert 0.0 < ours.rise_s < ours.settling_s  # type: ignore[operator]


def test_the_lqr_gains_are_those_of_python_control() -> None:
    """On the motor sampled by python-control, with the angle in place of the mean speed and without delay."""
    import control

    rate_hz, omega = 1000.0, 60.0
    T, m = 1.0 / rate_hz, PAPER
    A = [[-m.R / m.L, -m.K / m.L, 0], [m.K / m.J, -m.B / m.J, 0], [0, 1, 0]]
    motor = control.sample_system(control.ss(A, [[1 / m.L], [0], [0]], np.eye(3), np.zeros((3, 1))), T, "zoh")
    A4 = np.block([[motor.A, np.zeros((3, 1))], [np.array([[0, 0, T, 1]])]])  # the integral of the angle
    B4 = np.vstack((motor.B, [[0.0]]))
    per_volt = abs(motor(np.exp(1j * omega * T))[2, 0])
    Q = np.diag([0, 0, 1, (omega / 3) ** 2])
    gain, _, _ = control.dlqr(A4, B4, Q, np.eye(1) * per_volt**2)
    ours = lqr_gains({n: getattr(m, n) for n in NAMES}, LoopSetup(rate_hz, delay_samples=0.0), omega)
    found = (ours.current_V_A, ours.speed_V_s_rad, ours.angle_V_rad, ours.integral_V_rad_s)
    assert found == pytest.approx(np.asarray(gain)[0], rel=1e-6)


def ideal(crossover_rad_s: float, delay: float, rate_hz: float) -> Margins:
    """L(s) = ω_c e^{−sτ}/s: a motor of one lag, which the PI's zero cancels; encoder difference and hold count one more
    sample of delay."""
    motor = {"R": 1.0, "L": 1e-7, "K": 0.1, "J": 1e-4, "B": 1e-9}
    lag = motor["J"] * motor["R"] / motor["K"] ** 2
    kp = crossover_rad_s * lag * motor["K"]
    return found(motor, CascadeGains(kp, kp / lag), rate_hz, delay)


@pytest.mark.parametrize("turn", [0.1, 0.5, 1.0])
def test_an_integrator_with_delay_has_its_textbook_margins(turn: float) -> None:
    """turn = ω_c τ: phase margin 90° − turn, gain margin π/(2 turn), delay margin to π/2 (any textbook)."""
    rate_hz, delay = 50_000.0, 19.0
    tau = (delay + 1.0) / rate_hz
    m = ideal(turn / tau, delay, rate_hz)
    assert m.phase_margin_deg == pytest.approx(90.0 - math.degrees(turn), abs=0.3)
    assert m.gain_margin_dB == pytest.approx(20 * math.log10(math.pi / 2 / turn), abs=0.1)
    assert m.delay_margin_s == pytest.approx((math.pi / 2 / turn - 1.0) * tau, rel=0.01)
    omega = np.geomspace(0.01, 100, 200_000)
    peak = np.abs(1 / (1 + turn / (1j * omega) * np.exp(-1j * omega))).max()
    assert m.sensitivity_peak == pytest.approx(peak, rel=0.005)


def test_simc_at_its_fastest_has_the_margins_of_its_paper() -> None:
    """Skogestad 2003, table 1: τ_c = θ gives gain margin 3.14, phase margin 61.4°, M_s 1.59."""
    m = ideal(0.5 / (20 / 50_000), 19.0, 50_000.0)
    assert m.phase_margin_deg == pytest.approx(61.4, abs=0.3)
    assert m.gain_margin_dB == pytest.approx(20 * math.log10(3.14), abs=0.1)
    assert m.sensitivity_peak == pytest.approx(1.59, abs=0.01)


@pytest.mark.parametrize("zeta", [0.3, 0.5, 0.707, 1.0])
def test_a_second_order_servo_has_its_textbook_phase_margin(zeta: float) -> None:
    """L = ω_n²/(s (s + 2ζω_n)): phase margin atan(2ζ / √(√(1 + 4ζ⁴) − 2ζ²)) (Franklin, Powell & Emami-Naeini). A
    P position loop around a P speed loop, whose own feedback k_p is the damping."""
    motor = {"R": 1.0, "L": 1e-7, "K": 0.1, "J": 1e-3, "B": 1e-9}
    wn = 50.0
    pole = motor["K"] ** 2 / (motor["J"] * motor["R"])  # 1/s, of ω/v = (1/K) / (s/pole + 1)
    kp = (2 * zeta * wn / pole - 1.0) * motor["K"]
    outer = wn**2 / pole * motor["K"] / kp
    # Cut at the angle instead of the voltage: with the speed feedback inside, the plant is a motor of more friction.
    closed = {**motor, "B": motor["K"] * kp / motor["R"]}
    m = found(closed, CascadeGains(1e-12, 0.0, outer * kp / 1e-12), 100_000.0, 0)
    expected = math.degrees(math.atan(2 * zeta / math.sqrt(math.sqrt(1 + 4 * zeta**4) - 2 * zeta**2)))
    assert m.phase_margin_deg == pytest.approx(expected, abs=0.3)


@pytest.mark.parametrize("name", LOOPS)
def test_the_closed_loop_is_at_its_limit_where_the_margins_say(name: str) -> None:
    """Gain up by the margin, or later by the delay margin: an eigenvalue on the unit circle, found without L."""
    motor, gains, rate_hz, delay = LOOPS[name]
    m = found(motor, gains, rate_hz, delay)
    assert m.gain_margin_dB is not None and m.delay_margin_s is not None
    loop = controller(gains, 1 / rate_hz)

    def radius(factor: float, more: float) -> float:
        p = sampled_motor(logs(motor), 1 / rate_hz, delay + more)
        louder = type(loop)(
            loop.position, loop.A, loop.B_y, loop.B_r, loop.C * factor, loop.D_y * factor, 0.0, loop.previous
        )
        return float(np.abs(np.linalg.eigvals(closed_loop(p, louder)[0])).max())

    factor = 10 ** (m.gain_margin_dB / 20)
    assert radius(0.99 * factor, 0) < 1 < radius(1.01 * factor, 0)
    later = m.delay_margin_s * rate_hz
    assert radius(1, 0.98 * later) < 1 < radius(1, 1.02 * later)


@pytest.mark.parametrize("delay", [0.0, 0.3, 1.0, 1.7, 2.0])
@pytest.mark.parametrize("motor", [PAPER, RE40], ids=lambda m: m.name)
def test_a_sampled_motor_is_the_continuous_one_under_a_late_voltage(motor: Motor, delay: float) -> None:
    T, rng, n = 1e-3, np.random.default_rng(3), 12
    volts = rng.uniform(-1, 1, n)
    system = np.zeros((4, 4))
    system[0] = [-motor.R / motor.L, -motor.K / motor.L, 0, 1 / motor.L]
    system[1, :2] = motor.K / motor.J, -motor.B / motor.J
    system[2, 1] = 1.0
    fine = expm(system * T / 10)
    x, rows = np.zeros(4), [np.zeros(4)]
    for k in range(10 * n):
        source = math.floor((k - round(10 * delay)) / 10)
        x[3] = volts[source] if source >= 0 else 0.0
        x = fine @ x
        rows.append(x.copy())
    expected = np.array(rows)[::10]
    p = sampled_motor(logs(motor), T, delay)
    state = np.zeros(p.B.shape[1])
    for k in range(n):
        state = p.A[0] @ state + p.B[0] * volts[k]
        mean = (expected[k + 1, 2] - expected[k, 2]) / T
        assert state[:3] == pytest.approx([*expected[k + 1, :2], mean], rel=1e-9, abs=1e-12)


def test_an_unstable_loop_states_nothing() -> None:
    m = found(PAPER, CascadeGains(50.0, 1000.0), 1000.0, 1)
    assert not m.stable
    assert (m.gain_margin_dB, m.phase_margin_deg, m.delay_margin_s, m.sensitivity_peak) == (None,) * 4


def test_a_conditionally_stable_loop_has_a_margin_downwards() -> None:
    """Integrals in both loops: with less gain the integrals win."""
    gains = CascadeGains(0.07, 6.0, 24.0, 400.0, filter_hz=200.0)
    m = found(RE40, gains, 1000.0, 1)
    assert m.stable and m.gain_reduction_margin_dB is not None
    loop = controller(gains, 1e-3)
    p = sampled_motor(logs(RE40), 1e-3, 1)
    radii = []
    for factor in (1.02, 0.98):
        share = factor * 10 ** (-m.gain_reduction_margin_dB / 20)
        weaker = type(loop)(
            loop.position, loop.A, loop.B_y, loop.B_r, loop.C * share, loop.D_y * share, 0.0, loop.previous
        )
        radii.append(float(np.abs(np.linalg.eigvals(closed_loop(p, weaker)[0])).max()))
    assert radii[0] < 1 < radii[1]


def test_many_motors_at_once_are_each_alone() -> None:
    every = np.concatenate([logs(m) for m in MOTORS.values()])
    loop = controller(CascadeGains(0.05, 3.0, filter_hz=100.0), 1e-3)
    together = margins(sampled_motor(every, 1e-3, 1.4), loop)
    for k, motor in enumerate(MOTORS.values()):
        assert together.of(k) == margins(sampled_motor(logs(motor), 1e-3, 1.4), loop).of(0)
