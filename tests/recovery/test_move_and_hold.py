"""Inverse dynamics of axes that move and hold: jittered instants, lost samples, rests; nothing vanishes unsaid."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.identification.inverse_dynamics.fit import InverseDynamics, identify_inverse_dynamics
from servo_daemon.samples import F64, Quality, SampleBlock, make_block
from tests.recovery.generator import BELT_SERVO, GEAR_MOTOR, PAPER, Motor, Plan, Scenario, Sensors, generate

pytestmark = pytest.mark.usefixtures("generator_built")

#: An axis is moved for so long, s, once in every period, s.
_MOVE_S, _PERIOD_S = 0.6, 3.0


def moves(time_s: F64, span: float) -> Plan:
    """Minimum-jerk moves there and back by the span, rad, with rests between."""
    number, within = np.divmod(time_s, _PERIOD_S)
    u = np.clip(within / _MOVE_S, 0.0, 1.0)
    share = u**3 * (10 - 15 * u + 6 * u**2)
    return Plan("position", span * np.where(number % 2 == 0, share, 1.0 - share))


def joint(motor: Motor, seed: int, *, lost: float = 0.0, mean_s: float = 0.026) -> tuple[SampleBlock, dict[str, float]]:
    """Torque and angle at instants 15 … 88 ms apart, 26 ms on average; quantised angle, 1 % noise of the torque."""
    truth = {"J": motor.J, "B": motor.B, "Tc": 0.3 * motor.working_torque_Nm, "TL": 0.05 * motor.working_torque_Nm}
    effects = {"coulomb_friction": {"Tc": truth["Tc"]}, "constant_load_torque": {"TL": truth["TL"]}}
    n = 60 * 2000
    # as fast as half of the torque makes it: min-jerk peaks at 5.77 span / T²
    span = 0.25 * motor.working_torque_Nm / motor.J * _MOVE_S**2 / 5.77
    plan = moves(np.arange(n) / 2000, min(span, 0.2 * motor.speed_max_rad_s * _MOVE_S / 1.875))
    made = generate(motor, Scenario(plan, seconds=60, rate_hz=2000, effects=effects, sensors=Sensors(), seed=seed))
    rng = np.random.default_rng(seed)
    steps = np.clip(rng.gamma(6.0, mean_s / 6.0, size=n), 0.58 * mean_s, 3.4 * mean_s)
    steps = np.where(rng.random(n) < lost, 2 * steps, steps)
    at = np.cumsum(steps)
    index = np.round(at[at < made.time_s[-1]] * 2000).astype(int)
    torque = motor.K * made.truth.current_A[index]
    torque = torque + rng.normal(0.0, 0.01 * motor.working_torque_Nm, len(index))
    step = np.ptp(made.position_rad) / 800
    block = make_block(
        made.time_s[index], torque_Nm=torque, position_rad=np.round(made.position_rad[index] / step) * step
    )
    quality = block.quality.copy()
    distance = np.diff(block.time_s)
    quality[1:][distance > 1.75 * np.median(distance)] = Quality.GAP_BEFORE
    return make_block(block.time_s, quality=quality, torque_Nm=block.torque_Nm, position_rad=block.position_rad), truth


def identified(block: SampleBlock) -> InverseDynamics:
    return identify_inverse_dynamics([block], ("coulomb_friction", "constant_load_torque"))


@pytest.mark.parametrize("motor", [PAPER, GEAR_MOTOR, BELT_SERVO], ids=lambda m: m.name)
@pytest.mark.parametrize("lost", [0.0, 0.15])
def test_a_joint_that_rests_most_of_the_time(motor: Motor, lost: float) -> None:
    for seed in range(2):
        block, truth = joint(motor, seed, lost=lost)
        found = identified(block)
        every = {**found.parameters, **found.undetermined}
        for name in ("Tc", "B", "TL", "J"):
            e = every[name]
            assert abs(e.value - truth[name]) < max(4 * e.std, 0.02 * truth[name]), (seed, name, e, truth[name])
        assert found.parameters["Tc"].std < 0.05 * truth["Tc"]
        used = sum("samples are not used" in note for note in found.notes)
        assert used == 1, found.notes


def test_at_400_hz_dry_and_viscous_friction_are_within_three_of_their_std() -> None:
    """Steps of the encoder of a quarter of the travel within one sample at full speed: rests are told by them."""
    off = []
    for seed in range(6):
        block, truth = joint(PAPER, 10 + seed, mean_s=0.0025)
        found = identified(block)
        every = {**found.parameters, **found.undetermined}
        off += [abs(every[name].value - truth[name]) / every[name].std for name in ("Tc", "B")]
    assert max(off) < 3.0, off


def test_what_gaps_take_is_told_without_dry_friction_too() -> None:
    """Short pieces between gaps are no rows of a filter; the note says how many samples they held."""
    made = generate(PAPER, Scenario("prbs", seconds=10, rate_hz=500, seed=3))
    quality = np.zeros(len(made.time_s), np.uint8)
    quality[[1000, 1030, 1060]] = Quality.GAP_BEFORE
    block = make_block(
        made.time_s, quality=quality, torque_Nm=PAPER.K * made.truth.current_A, position_rad=made.position_rad
    )
    found = identify_inverse_dynamics([block])
    assert any(note.startswith("60 of 5000 samples are not used") for note in found.notes), found.notes
