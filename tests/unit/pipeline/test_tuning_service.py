"""From published estimates to tuning: what is used, the covariance that goes with it, and the margin warning."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from servo_daemon.api import documents
from servo_daemon.config import DriveConfig, parse_config
from servo_daemon.daemon.drive import DriveRuntime
from servo_daemon.errors import ConfigError, TuningError
from servo_daemon.pipeline.controller import gains_in_use, loop_facts
from servo_daemon.pipeline.margin_watch import EVERY_S, MarginWatch
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.published.knowledge import LoopFacts, motor_knowledge
from servo_daemon.published.metrics import render_metrics
from servo_daemon.published.snapshot import Estimate, ParameterEstimate
from servo_daemon.simulate import DEFAULT_NOMINAL, SimulatedDrive, make_settings
from servo_daemon.tuning.knowledge import NEEDED, Ask, CascadeGains
from tests.fake_daemon import TRUE, UNITS, covariance_of, fake_daemon, make_estimate, make_snapshot
from tests.unit.pipeline.test_alarms import Idle

GAINS = {"speed_kp_V_s_rad": 1.2, "speed_ki_V_rad": 84.0, "speed_filter_hz": 120.0}


def configuration(controller: Mapping[str, float], **more: Any) -> DriveConfig:
    drive = {"name": "axis1", "driver": "fed", "nominal": dict(TRUE), "controller": dict(controller)} | more
    return parse_config({"drive": [drive]}).drive[0]


def parameters(**changes: ParameterEstimate) -> tuple[ParameterEstimate, ...]:
    every = {
        name: ParameterEstimate(name, value, 0.01 * value, UNITS[name], 1.1 * value, "tracking")
        for name, value in TRUE.items()
    }
    return tuple((every | changes).values())


def of(name: str, status: Any, nominal: float | None, reason: str | None = "because") -> ParameterEstimate:
    return ParameterEstimate(name, TRUE[name], 0.01 * TRUE[name], UNITS[name], nominal, status, reason)


# -- what is used ------------------------------------------------------------------------------------------------


def test_estimates_are_used_with_their_covariance() -> None:
    shown = parameters()
    motor = motor_knowledge(shown, covariance_of(shown), (), {})
    assert {k.source for k in motor.parameters.values()} == {"estimate"}
    assert motor.uncertain == NEEDED
    assert np.sqrt(np.diag(motor.covariance)) == pytest.approx([0.01] * 5)


@pytest.mark.parametrize("status", ["estimating", "at_bound", "fixed", "invalid"])
def test_what_is_not_known_is_nominal_and_claims_nothing(status: Any) -> None:
    shown = parameters(J=of("J", status, 0.02))
    motor = motor_knowledge(shown, covariance_of(parameters()), (), {})
    J = motor.parameters["J"]
    assert (J.value, J.source, J.std, J.why) == (0.02, "nominal", None, f"{status}: because")
    assert motor.uncertain == ("R", "L", "K", "B") and motor.covariance.shape == (4, 4)


def test_a_held_value_is_still_the_motors() -> None:
    shown = parameters(J=of("J", "unexcited", 0.02))
    assert motor_knowledge(shown, None, (), {}).parameters["J"].source == "estimate"


def test_what_is_neither_is_refused_by_name_and_reason() -> None:
    shown = parameters(J=of("J", "estimating", None, "the speed is constant"), B=of("B", "fixed", None, None))
    with pytest.raises(TuningError, match=r"no gains without J \(the speed is constant\), B: neither estimated"):
        motor_knowledge(shown, None, (), {})


def test_given_values_win() -> None:
    shown = parameters(J=of("J", "estimating", None))
    motor = motor_knowledge(shown, covariance_of(parameters()), (), {}, fixed={"J": 0.5, "R": 2.0})
    assert motor.parameters["J"].value == 0.5 and motor.parameters["R"].source == "fixed"
    assert motor.uncertain == ("L", "K", "B")


def test_the_loop_has_the_warm_winding() -> None:
    shown = parameters()
    motor = motor_knowledge(shown, covariance_of(shown), ("winding_heating",), {"winding_rise_K": 50.0})
    assert motor.parameters["R"].value == pytest.approx(TRUE["R"] * 1.195)
    assert "warm by 50 K" in (motor.parameters["R"].why or "")


def test_the_controllers_configuration_is_understood() -> None:
    config = configuration(
        {**GAINS, "position_kp_1_s": 9.0, "delay_samples": 1.5, "bandwidth_hz": 4.0, "gain_margin_min_dB": 8.0},
        limits={"voltage_V": 24.0},
        load={"counts_per_rev": 4096},
    )
    facts = loop_facts(config, 100.0)
    assert facts.in_use == CascadeGains(1.2, 84.0, 9.0, filter_hz=120.0)
    assert (facts.delay_samples, facts.ask, facts.voltage_V) == (1.5, Ask(bandwidth_hz=4.0), 24.0)
    assert facts.counts_per_rev == 4096 and facts.limits.gain_margin_dB == 8.0
    assert facts.setup(999.0).rate_source == "measured" and replace(facts, rate_hz=5e3).setup(999.0).rate_hz == 5e3
    assert gains_in_use(configuration({}).controller) is None
    with pytest.raises(TuningError, match="rate is not known"):
        facts.setup(None)


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({"bandwidth_hz": 3.0, "settling_s": 0.1}, "give one of them"),
        ({"delay_samples": -1.0}, "delay_samples"),
        ({"sensitivity_max": 1.0}, "sensitivity_max"),
        ({"speed_setpoint_weight": 1.5}, "speed_setpoint_weight"),
        ({"rate_hz": 0.0}, "rate_hz"),
    ],
)
def test_an_impossible_controller_is_refused(keys: dict[str, float], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        configuration(keys)


# -- the published covariance ------------------------------------------------------------------------------------


def test_the_pipeline_publishes_the_covariance_of_what_is_known() -> None:
    source = SimulatedDrive(make_settings(seed=2))
    config = configuration({}, nominal=dict(DEFAULT_NOMINAL))
    pipeline = Pipeline(config, source.info)
    [first, *_] = pipeline.process(source.next_block(300))
    assert first.covariance is None
    last = pipeline.process(source.next_block(8000))[-1]
    known = {p.name: p for p in last.parameters if p.status in ("tracking", "unexcited")}
    assert set(known) >= {"R", "K"} and last.covariance is not None
    assert set(last.covariance.names) == set(known) - {"J_d"}
    matrix = np.array(last.covariance.values)
    assert np.array_equal(matrix, matrix.T) and np.linalg.eigvalsh(matrix).min() > 0
    for name, var in zip(last.covariance.names, np.diag(matrix), strict=True):
        p = known[name]
        assert p.value is not None and p.std is not None
        assert math.sqrt(var) * p.value == pytest.approx(p.std, rel=1e-6), "relative, and the published std"
    correlation = matrix / np.sqrt(np.outer(np.diag(matrix), np.diag(matrix)))
    assert np.abs(correlation - np.eye(len(matrix))).max() > 0.1, "the parameters are not independent"


# -- the warning -------------------------------------------------------------------------------------------------


def aged(t: float, **factors: float) -> Estimate:
    values = {name: value * factors.get(name, 1.0) for name, value in TRUE.items()}
    shown = tuple(ParameterEstimate(n, v, 0.01 * v, UNITS[n], TRUE[n], "tracking") for n, v in values.items())
    return make_estimate(t, shown, sample_rate_hz=1000.0)


def facts(**changes: Any) -> LoopFacts:
    return replace(loop_facts(configuration(GAINS)), **changes)


def test_a_healthy_loop_is_silent_and_shown() -> None:
    watch = MarginWatch(facts())
    assert watch.update(aged(0.0)) == [] and not watch.low
    health = watch.health
    assert health["controller_stable"] is True and health["controller_margin_low"] is False
    assert 55 < float(health["controller_phase_margin_deg"] or 0) < 65
    assert 10 < float(health["controller_gain_margin_dB"] or 0) < 20


def test_ageing_that_eats_the_margin_is_told_once_and_taken_back_with_hysteresis() -> None:
    """Half of the load gone, less friction, a colder winding: the loop's gain has doubled."""
    watch = MarginWatch(facts())
    assert watch.update(aged(0.0)) == []
    [(kind, text, data)] = watch.update(aged(10.0, J=0.5, B=0.5, R=0.8))
    assert kind == "margin_low" and "no longer suit the motor" in text and data["time_s"] == 10.0
    assert watch.low and watch.health["controller_margin_low"] is True
    assert watch.update(aged(20.0, J=0.5, B=0.5, R=0.8)) == [], "told once"
    [(kind, _, _)] = watch.update(aged(30.0))
    assert kind == "margin_restored" and not watch.low


def test_the_warning_does_not_flutter_at_its_limit() -> None:
    """Back and forth over the limit by noise: one warning, and an end only when clearly better."""
    watch, louder = MarginWatch(facts()), np.linspace(1.0, 6.0, 200)
    at = next(x for x in louder if MarginWatch(facts()).update(aged(0.0, K=1.0, L=x, R=1 / x)))
    told: list[str] = []
    for k in range(20):
        x = at * (1.002 if k % 2 else 0.998)
        told += [kind for kind, _, _ in watch.update(aged(10.0 * k, L=x, R=1 / x))]
    assert told == ["margin_low"]
    assert [kind for kind, _, _ in watch.update(aged(500.0))] == ["margin_restored"]


def test_more_than_half_lost_is_told_above_the_limits_too() -> None:
    watch = MarginWatch(facts(in_use=CascadeGains(0.4, 28.0, filter_hz=80.0)))
    assert watch.update(aged(0.0)) == []
    [(kind, text, data)] = watch.update(aged(10.0, J=0.25, B=0.3, R=0.65))
    assert kind == "margin_low" and "more than half is lost" in text and "below" not in text
    assert float(data["gain_margin_dB"] or 0) > 6.0 and float(data["phase_margin_deg"] or 0) > 30.0


def test_an_unstable_loop_is_told_without_numbers() -> None:
    watch = MarginWatch(facts(in_use=CascadeGains(50.0, 1000.0)))
    [(kind, text, data)] = watch.update(aged(0.0))
    assert kind == "margin_low" and "unstable" in text and data["phase_margin_deg"] is None
    assert watch.health["controller_stable"] is False


@pytest.mark.parametrize("status", ["estimating", "invalid", "at_bound"])
def test_without_estimates_nothing_is_judged(status: Any) -> None:
    watch = MarginWatch(facts(in_use=CascadeGains(50.0, 1000.0)))
    estimate = aged(0.0)
    shown = (replace(estimate.parameters[0], status=status), *estimate.parameters[1:])
    assert watch.update(replace(estimate, parameters=shown)) == []
    assert watch.health["controller_margin_low"] is None
    assert watch.update(aged(EVERY_S)) != []


def test_it_looks_every_few_seconds_and_again_when_the_clock_restarts() -> None:
    watch, bad = MarginWatch(facts()), {"J": 0.5, "B": 0.5, "R": 0.8}
    assert watch.update(aged(100.0)) == []
    assert watch.update(aged(100.0 + 0.9 * EVERY_S, **bad)) == [], "too early"
    assert len(watch.update(aged(3.0, **bad))) == 1, "device time began anew"
    assert watch.update(aged(3.0 + 0.9 * EVERY_S)) == [] and len(watch.update(aged(3.0 + EVERY_S))) == 1


def test_without_gains_it_does_nothing() -> None:
    watch = MarginWatch(LoopFacts(nominal=TRUE))
    assert watch.update(aged(0.0)) == [] and watch.health == {} and watch.forget("reset") == []


def test_a_drive_tells_it_in_events_health_and_metrics(caplog: pytest.LogCaptureFixture) -> None:
    source = SimulatedDrive(make_settings(seed=1))
    config = configuration(
        {"speed_kp_V_s_rad": 8.0, "speed_ki_V_rad": 600.0}, nominal=dict(DEFAULT_NOMINAL), limits={"R_max": 0.01}
    )
    with caplog.at_level(logging.INFO):
        drive = DriveRuntime(config, Idle(source), None, lambda: None)
        drive.reader.queue.put(source.next_block(12_000))
        drive.work()
    [event] = [e for e in drive.events() if e.kind == "margin_low"]
    assert "no longer suit" in event.message
    assert [r.levelno for r in caplog.records if "no longer suit" in r.getMessage()] == [logging.WARNING]
    health = documents.estimates_document(drive, drive.snapshot())["health"]
    assert health["alarms"] == "R_max,controller_margin" and health["controller_margin_low"] is True
    daemon = fake_daemon()
    daemon.drives["axis1"].publish(make_snapshot(t=2.0, estimate=drive.snapshot().estimate))
    assert 'servo_daemon_controller_margin_low{drive="axis1"} 1' in render_metrics(daemon)
    drive.request_reset()
    drive.work()
    assert [e.kind for e in drive.events()][-3:] == ["reset", "alarm_cleared", "margin_restored"]


def test_metrics_are_in_si_units() -> None:
    daemon = fake_daemon()
    health = {"controller_phase_margin_deg": 60.0, "controller_gain_margin_dB": 12.0}
    daemon.drives["axis1"].publish(make_snapshot(t=2.0, estimate=make_estimate(2.0, health=health)))
    text = render_metrics(daemon)
    assert f'servo_daemon_controller_phase_margin_radian{{drive="axis1"}} {math.pi / 3!r}' in text
    assert 'servo_daemon_controller_gain_margin_decibel{drive="axis1"} 12.0' in text


def test_half_a_controller_is_told_at_the_start() -> None:
    drive = DriveRuntime(
        configuration({"position_kp_1_s": 20.0}), Idle(SimulatedDrive(make_settings(seed=1))), None, lambda: None
    )
    [event] = drive.events()
    assert event.kind == "margin_impossible" and "speed_kp_V_s_rad" in event.message
