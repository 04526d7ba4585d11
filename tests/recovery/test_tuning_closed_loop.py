"""Designed gains in closed loops that know nothing of `servo_daemon.tuning`: the independent generator's drive and
motor, and a loop written here. What was asked for is seen, and the loop oscillates where its gain margin says."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import expm

from servo_daemon.samples import F64
from servo_daemon.tuning.design import FAMILIES
from servo_daemon.tuning.knowledge import NEEDED, Ask, CascadeGains, Known, LoopSetup, MotorKnowledge
from servo_daemon.tuning.laws import StateGains
from servo_daemon.tuning.search import Design, find
from tests.recovery.generator import PAPER, RE40, Motor, Scenario, Sensors, generate
from tests.recovery.generator.motions import Gains, Plan

FAMILY = {f.key: f for f in FAMILIES}
STEP = 1e-4  # rad or rad/s, small: neither voltage nor current meets its limit


def designed(motor: Motor, key: str, ask: Ask, delay: float, rate_hz: float = 1000.0) -> Design:
    known = {name: Known(getattr(motor, name), "estimate") for name in NEEDED}
    return find(FAMILY[key], MotorKnowledge(known), LoopSetup(rate_hz, delay_samples=delay), ask, None)


def generated_step(motor: Motor, g: CascadeGains, seconds: float, louder: float = 1.0) -> tuple[F64, F64, F64]:
    """Time, speed and angle of the generator's own drive after a step of the reference, over the step. Its integral
    holds the errors before the present one: k_p takes the difference."""
    T = 1e-3
    assert g.filter_hz is not None and g.setpoint_weight == pytest.approx(1.0)
    gains = Gains(
        kp=louder * (g.speed_kp_V_s_rad + g.speed_ki_V_rad * T),
        ki=louder * g.speed_ki_V_rad,
        k_pos=g.position_kp_1_s or 0.0,
        filter_s=1 / (2 * math.pi * g.filter_hz),
        speed_limit_rad_s=1e9,
    )
    position = g.position_kp_1_s is not None
    plan = Plan("position" if position else "speed", np.full(round(seconds / T), STEP), gains=gains)
    truth = generate(motor, Scenario(plan, seconds, sensors=Sensors())).truth
    return truth.time_s, truth.speed_rad_s / STEP, truth.position_rad / STEP


def settling(time_s: F64, shown: F64) -> float:
    outside = np.flatnonzero(np.abs(shown - 1.0) > 0.02)
    return float(time_s[outside[-1] + 1])


@pytest.mark.parametrize("motor", [PAPER, RE40], ids=lambda m: m.name)
@pytest.mark.parametrize("key", ["speed_pi", "position_pid"])
def test_the_generators_drive_settles_as_asked(motor: Motor, key: str) -> None:
    design = designed(motor, key, Ask(settling_s=0.25), delay=0.0)
    assert not design.capped and isinstance(design.gains, CascadeGains)
    time_s, speed, angle = generated_step(motor, design.gains, 1.5)
    shown = speed if key == "speed_pi" else angle
    assert settling(time_s, shown) == pytest.approx(0.25, abs=0.003)
    assert 100 * (shown.max() - 1.0) == pytest.approx(design.response.overshoot_percent, abs=0.05)


@pytest.mark.parametrize("motor", [PAPER, RE40], ids=lambda m: m.name)
@pytest.mark.parametrize("key", ["speed_pi", "position_pid"])
def test_the_generators_drive_oscillates_at_its_gain_margin(motor: Motor, key: str) -> None:
    design = designed(motor, key, Ask(), delay=0.0)
    assert isinstance(design.gains, CascadeGains) and design.margins.gain_margin_dB is not None
    factor = 10 ** (design.margins.gain_margin_dB / 20)
    _, below, _ = generated_step(motor, design.gains, 1.2, 0.97 * factor)
    _, above, _ = generated_step(motor, design.gains, 1.2, 1.03 * factor)
    assert np.ptp(below[-100:]) < 0.5 * np.ptp(below[200:300]), "just below its margin it still calms down"
    assert np.ptp(above[-100:]) > 2.0 * np.ptp(above[200:300]), "just above it grows"


def own_loop(motor: Motor, g: CascadeGains | StateGains, delay: float, reference: F64, louder: float = 1.0) -> F64:
    """Speed and angle, shape (n, 2), of a loop with its own equations and its own timing: ten steps a sample, so that a
    delay of tenths of a sample is exact."""
    T, x, rows = 1e-3, np.zeros(4), []
    system = np.zeros((4, 4))
    system[0] = [-motor.R / motor.L, -motor.K / motor.L, 0, 1 / motor.L]
    system[1, :2], system[2, 1] = [motor.K / motor.J, -motor.B / motor.J], 1.0
    tenth = expm(system * T / 10)
    alpha = math.exp(-2 * math.pi * (g.filter_hz or math.inf) * T)
    volts: list[float] = []
    speed = before = integral = 0.0
    for k, wanted in enumerate(reference.tolist()):
        rows.append(x[1:3].copy())
        speed = alpha * speed + (1 - alpha) * (x[2] - before) / T
        before = x[2]
        if isinstance(g, StateGains):
            v = -g.angle_V_rad * (x[2] - g.setpoint_weight * wanted) - g.speed_V_s_rad * speed
            v -= g.current_V_A * x[0] + g.integral_V_rad_s * integral
            own = sum(q * u for q, u in zip(g.previous_V_V, volts[::-1], strict=False))
            integral += T * (x[2] - wanted)
            volts.append(louder * v - own)
        else:
            target = wanted if g.position_kp_1_s is None else g.position_kp_1_s * (wanted - x[2])
            integral += T * (target - speed)
            v = g.speed_kp_V_s_rad * (g.setpoint_weight * target - speed) + g.speed_ki_V_rad * integral
            volts.append(louder * v)
        for tenths in range(10):
            source = math.floor((10 * k + tenths - round(10 * delay)) / 10)
            x[3] = volts[source] if source >= 0 else 0.0
            x = tenth @ x
    return np.array(rows)


@pytest.mark.parametrize("key", FAMILY)
@pytest.mark.parametrize("delay", [1.0, 1.3])
def test_a_late_loop_has_the_bandwidth_that_was_asked(key: str, delay: float) -> None:
    """Driven with a sine of the asked frequency, the response is 3 dB down."""
    design = designed(PAPER, key, Ask(bandwidth_hz=3.0), delay)
    assert not design.capped
    t = np.arange(6000) * 1e-3
    shown = own_loop(PAPER, design.gains, delay, np.sin(2 * math.pi * 3.0 * t))[:, 0 if key == "speed_pi" else 1]
    last = slice(-3000, None)  # nine periods
    basis = np.column_stack((np.sin(2 * math.pi * 3.0 * t), np.cos(2 * math.pi * 3.0 * t), np.ones_like(t)))[last]
    parts = np.linalg.lstsq(basis, shown[last], rcond=None)[0]
    assert np.hypot(*parts[:2]) == pytest.approx(math.sqrt(0.5), rel=2e-3)


@pytest.mark.parametrize("key", FAMILY)
@pytest.mark.parametrize("delay", [1.0, 1.3])
def test_a_late_loop_oscillates_at_its_gain_margin(key: str, delay: float) -> None:
    design = designed(PAPER, key, Ask(), delay)
    assert design.margins.gain_margin_dB is not None
    factor = 10 ** (design.margins.gain_margin_dB / 20)
    shown = [own_loop(PAPER, design.gains, delay, np.ones(1500), factor * share)[:, 0] for share in (0.97, 1.03)]
    assert np.ptp(shown[0][-100:]) < 0.5 * np.ptp(shown[0][100:200])
    assert np.ptp(shown[1][-100:]) > 2.0 * np.ptp(shown[1][100:200])
