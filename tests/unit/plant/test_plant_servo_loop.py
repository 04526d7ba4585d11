"""The servo mechanism: what the paper prints, what it means, and the loop as we close it."""

from __future__ import annotations

from collections.abc import Mapping

import control
import numpy as np
import pytest

from servo_daemon.parameters import LINEAR
from servo_daemon.plant import servo_loop
from servo_daemon.plant.build import build_plant
from servo_daemon.plant.compiled import SampleLoop
from servo_daemon.plant.linear import linear_step
from servo_daemon.plant.servo_loop import (
    N_ROW,
    OUT,
    ROW,
    ServoGains,
    servo_constants,
    servo_step,
    suitable_gains,
)
from servo_daemon.samples import F64

PAPER = {p.name: p.nominal for p in LINEAR}
GAINS = ServoGains()
STEP = np.deg2rad(50.0)
S = control.TransferFunction([1, 0], [1])


def motor_speed(p: Mapping[str, float]) -> control.TransferFunction:
    return control.TransferFunction(*servo_loop.motor_speed(p))


def closed_servo(p: Mapping[str, float], gains: ServoGains) -> control.TransferFunction:
    return control.TransferFunction(*servo_loop.closed_servo(p, gains))


def motor_angle(p: Mapping[str, float]) -> control.TransferFunction:
    """θ/v of the unloaded motor, rad per V: what the paper's G_o means, K / (s [(J s + B)(R + s L) + K²])."""
    return motor_speed(p) / S


def printed_motor_angle(p: Mapping[str, float]) -> control.TransferFunction:
    """G_o as printed: its s multiplies only the product, k_t / (s [J s + D][R + s L] + k_t k_b)."""
    return p["K"] / (S * (p["J"] * S + p["B"]) * (p["R"] + S * p["L"]) + p["K"] ** 2)


def printed_servo(p: Mapping[str, float], gains: ServoGains) -> control.TransferFunction:
    """G_s as printed first, with G_o = ω/v: k_io k_s G_o / (1 + k_s G_o k_g) · 1/s. A step gives a ramp."""
    return gains.k_io * control.feedback(gains.k_s * motor_speed(p), gains.k_g) / S


def run(
    reference: F64, rate_hz: float, *, gains: ServoGains = GAINS, supply_V: float = 24.0, **columns: float
) -> tuple[F64, F64]:
    """(outputs, final state) of the sampled loop from rest; further columns of the row are constants."""
    rows = np.zeros((len(reference), N_ROW + 5))
    rows[:, ROW.time_s] = np.arange(len(reference)) / rate_hz
    rows[:, ROW.step_s] = 1 / rate_hz
    rows[:, ROW.reference_rad] = reference
    rows[:, N_ROW:] = list(PAPER.values())
    for name, value in columns.items():
        rows[:, getattr(ROW, name)] = value
    x = np.zeros(3)
    return SampleLoop(servo_step(build_plant(()))).run(x, servo_constants(gains, supply_V, 0.0), rows), x


def test_amplifiers_multiply() -> None:
    assert ServoGains(k_op=2, k_au=0.5, k_pu=3, k_su=4).k_s == pytest.approx(12)


def test_fifty_degrees_ask_for_twenty_volts() -> None:
    assert pytest.approx(20.0) == GAINS.k_s * GAINS.k_io * STEP


def test_motor_is_an_integrator_behind_its_speed() -> None:
    assert np.min(np.abs(motor_angle(PAPER).poles())) < 1e-12
    gain = PAPER["K"] / (PAPER["R"] * PAPER["B"] + PAPER["K"] ** 2)
    assert motor_speed(PAPER).dcgain() == pytest.approx(gain) == pytest.approx(0.884, abs=1e-3)


def test_printed_g_o_has_lost_its_integrator() -> None:
    """Its s multiplies only the product: a constant voltage would turn the motor by a finite angle."""
    printed = printed_motor_angle(PAPER)
    assert np.min(np.abs(printed.poles())) > 0.3
    assert printed.dcgain() == pytest.approx(1 / PAPER["K"])


def test_printed_g_s_turns_a_step_into_a_ramp() -> None:
    t = np.linspace(0, 4, 4001)
    _, angle = control.step_response(printed_servo(PAPER, GAINS), t)
    speed = np.gradient(angle, t)
    assert speed[2000] == pytest.approx(speed[3900], rel=1e-6)  # it never stops
    assert angle[-1] > 10


def test_the_closed_loop_is_the_motor_inside_both_feedbacks() -> None:
    """Against python-control's own algebra: tacho inside, potentiometer outside."""
    speed = PAPER["K"] / ((PAPER["J"] * S + PAPER["B"]) * (PAPER["R"] + S * PAPER["L"]) + PAPER["K"] ** 2)
    inner = control.feedback(GAINS.k_s * speed, GAINS.k_g)
    at = 1j * np.geomspace(0.1, 1e4, 50)
    assert np.allclose(closed_servo(PAPER, GAINS)(at), control.feedback(GAINS.k_io * inner / S, 1)(at), rtol=1e-12)


def test_closed_loop_reaches_the_angle_it_was_given() -> None:
    closed = closed_servo(PAPER, GAINS)
    assert closed.dcgain() == pytest.approx(1.0)
    assert np.max(closed.poles().real) < -10
    info = control.step_info(closed)
    assert info["SettlingTime"] < 0.4
    assert info["Overshoot"] < 1


def test_sampled_loop_is_the_continuous_one_at_a_high_rate() -> None:
    n, rate = 5000, 10_000.0
    outputs, _ = run(np.full(n, STEP), rate)
    _, expected = control.step_response(closed_servo(PAPER, GAINS) * STEP, np.arange(n) / rate)
    assert np.max(np.abs(outputs[:, OUT.position_rad] - expected)) < 3e-3 * STEP


@pytest.mark.parametrize("degrees", [50, -50])
def test_a_step_of_fifty_degrees_arrives(degrees: float) -> None:
    outputs, x = run(np.full(1000, np.deg2rad(degrees)), 1000.0)
    assert np.rad2deg(x[2]) == pytest.approx(degrees, abs=0.01)
    assert abs(outputs[0, OUT.voltage_V]) == pytest.approx(20.0)


def test_the_supply_limits_the_voltage() -> None:
    outputs, _ = run(np.full(1000, 10 * STEP), 1000.0)
    assert np.max(np.abs(outputs[:, OUT.voltage_V])) == 24.0


def test_voltage_is_a_multiple_of_its_resolution() -> None:
    rows = np.zeros((200, N_ROW + 5))
    rows[:, ROW.step_s], rows[:, ROW.reference_rad], rows[:, N_ROW:] = 1e-3, 0.3, list(PAPER.values())
    outputs = SampleLoop(servo_step(build_plant(()))).run(np.zeros(3), servo_constants(GAINS, 24.0, 0.25), rows)
    volts = outputs[:, OUT.voltage_V]
    assert np.array_equal(volts, np.rint(volts / 0.25) * 0.25)
    assert len(np.unique(volts)) > 5


def test_hidden_voltage_moves_the_motor_and_is_not_reported() -> None:
    outputs, x = run(np.zeros(3000), 1000.0, hidden_V=1.0)
    assert x[2] == pytest.approx(1.0 / (GAINS.k_s * GAINS.k_io), rel=1e-6)  # what the loop needs to push back
    assert outputs[-1, OUT.voltage_V] == pytest.approx(-1.0, rel=1e-6)
    assert outputs[0, OUT.voltage_V] == 0


def test_dither_is_reported() -> None:
    outputs, _ = run(np.zeros(10), 1000.0, dither_V=1.5)
    assert outputs[0, OUT.voltage_V] == 1.5


@pytest.mark.parametrize("rate_hz", [100.0, 190.0, 1000.0, 10_000.0])
@pytest.mark.parametrize(
    "motor",
    [
        PAPER,
        {"R": 1.2, "L": 1e-3, "K": 0.05, "J": 2e-5, "B": 1e-5},
        {"R": 8.0, "L": 2e-3, "K": 0.008, "J": 1e-7, "B": 1e-7},
        {"R": 0.1, "L": 1e-4, "K": 0.4, "J": 0.05, "B": 1e-3},
    ],
)
def test_suitable_gains_give_a_stable_sampled_loop(motor: dict[str, float], rate_hz: float) -> None:
    gains = suitable_gains(motor, 24.0, rate_hz)
    Ad, Bd = linear_step(motor, 1 / rate_hz)
    loop = Ad - Bd[:, :1] @ (gains.k_s * np.array([[0, gains.k_g, gains.k_io]]))
    assert np.max(np.abs(np.linalg.eigvals(loop))) < 1


def test_the_paper_s_first_method_took_the_missing_division_for_one() -> None:
    """Its numbers satisfy τ₁τ₂ = J L and τ₁ + τ₂ = R J + D L as printed, because its D R + k² happens to be 1.005."""
    J, k, D, R, L = 12.27e-3, 4.25e-3, 0.67, 1.5, 1.81e-3
    assert pytest.approx(1.21e-3 * 18.4e-3, rel=0.01) == J * L
    assert pytest.approx(1.21e-3 + 18.4e-3, rel=0.01) == R * J + D * L
    assert D * R + k**2 == pytest.approx(1.0, rel=0.01)
