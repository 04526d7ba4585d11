"""Output error: its derivatives, its search, what it says of what the data do not hold."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from servo_daemon.errors import BadInputError
from servo_daemon.identification.output_error import FitOptions, Recording, fit_output_error
from servo_daemon.identification.output_error.problem import linearisation
from servo_daemon.identification.output_error.problem.linearisation import linearise
from servo_daemon.identification.output_error.problem.rollout import free_run, simulate, simulate_many
from servo_daemon.identification.output_error.problem.score import measured_speed, score
from servo_daemon.identification.output_error.problem.setup import make_problem
from servo_daemon.identification.output_error.solver.robust import sample_weights
from servo_daemon.identification.output_error.solver.solver import solve, within
from servo_daemon.plant.build import build_plant
from servo_daemon.plant.linear import linear_step
from servo_daemon.samples import F64, SampleBlock, make_block
from tests.few_samples import run_uncompiled

MOTOR = {"R": 1.2, "L": 2e-3, "K": 0.08, "J": 2e-4, "B": 1e-3}
RATE_HZ = 1000.0


def linear_recording(
    seconds: float = 2.0, *, noise: float = 1e-3, seed: int = 0, torque: float = 0.0, offset_A: float = 0.0
) -> dict[str, F64]:
    """Voltage, current and angle of the linear motor by SciPy's `expm`, with white noise."""
    rng = np.random.default_rng(seed)
    n = round(seconds * RATE_HZ)
    v = np.repeat(rng.normal(0.0, 6.0, n // 20 + 1), 20)[:n]
    Ad, Bd = linear_step(MOTOR, 1.0 / RATE_HZ)
    x, path = np.array([0.1, 2.0, 0.3]), np.empty((n, 3))
    for k in range(n):
        path[k] = x
        x = Ad @ x + Bd @ [v[k], torque]
    return {
        "voltage_V": v,
        "current_A": path[:, 0] + offset_A + rng.normal(0.0, 10 * noise, n),
        "position_rad": path[:, 2] + rng.normal(0.0, noise, n),
        "velocity_rad_s": path[:, 1] + rng.normal(0.0, noise, n),
    }


def block_of(signals: dict[str, F64], *names: str) -> SampleBlock:
    n = len(next(iter(signals.values())))
    return make_block(np.arange(n) / RATE_HZ, **{name: signals[name] for name in names})


FULL = ("voltage_V", "current_A", "position_rad")


@pytest.mark.parametrize(
    "effects", [(), ("gravity_load",), ("constant_load_torque", "current_sensor_offset"), ("winding_heating",)]
)
def test_sensitivities_are_the_derivatives_of_the_simulated_numbers(effects: tuple[str, ...]) -> None:
    plant, channels = build_plant(effects), ("current_A", "position_rad")
    rng = np.random.default_rng(3)
    n = 400
    rows = np.ascontiguousarray(
        np.c_[np.arange(n) * 1e-3, rng.uniform(0.5e-3, 2e-3, n), np.repeat(rng.normal(0, 6, n // 20), 20)]
    )
    q = np.array([np.log(p.nominal) if p.transform == "log" else 0.1 for p in plant.parameters])
    x0 = rng.normal(0.0, 0.5, len(plant.states))
    run = simulate(plant, channels, q, x0, rows)
    shown, states = free_run(plant, channels, q, x0, rows)
    assert np.array_equal(shown, run.shown)
    assert np.array_equal(states[0], x0)
    d = 1e-6
    for k in range(len(q)):
        step = d * np.eye(len(q))[k]
        ahead, behind = (free_run(plant, channels, q + s, x0, rows)[0] for s in (step, -step))
        slope = run.by_parameter[:, :, k]
        assert np.allclose((ahead - behind) / (2 * d), slope, atol=1e-6 * (1 + np.abs(slope).max()))
    for k in range(len(x0)):
        step = d * np.eye(len(x0))[k]
        ahead, behind = (free_run(plant, channels, q, x0 + s, rows)[0] for s in (step, -step))
        slope = run.by_state[:, :, k]
        assert np.allclose((ahead - behind) / (2 * d), slope, atol=1e-6 * (1 + np.abs(slope).max()))


def test_all_five_parameters_from_nothing() -> None:
    fit = fit_output_error([Recording("a", block_of(linear_recording(), *FULL))])
    assert fit.solution.converged
    assert fit.white
    assert fit.null_directions == ()
    for name, truth in MOTOR.items():
        p = fit.parameters[name]
        assert p.status == "estimated"
        assert p.value is not None
        assert p.std is not None
        assert abs(p.value - truth) < 4 * p.std
        assert p.std < 0.02 * truth
    assert fit.residual["position_rad"].rmse == pytest.approx(1e-3, rel=0.05)
    costs = [fit.cost(i) for i in fit.solution.iterations]
    assert all(b <= a * (1 + 1e-9) for a, b in pairwise(costs))


@pytest.mark.parametrize("scale", [0.2, 5.0])
def test_far_starts_end_at_the_same_place(scale: float) -> None:
    block = block_of(linear_recording(), *FULL)
    there = fit_output_error([Recording("a", block)])
    wrong = {n: v * (scale if k % 2 else 1 / scale) for k, (n, v) in enumerate(MOTOR.items())}
    fit = fit_output_error([Recording("a", block)], (), FitOptions(nominal=wrong))
    assert fit.start == "nominal values"
    for name, p in fit.parameters.items():
        assert p.value == pytest.approx(there.parameters[name].value, rel=1e-3)


def test_derivatives_are_computed_only_where_a_search_goes_on_from(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a model with sensitivities ten times as dear as its simulation that is most of a fit's time."""
    calls = []

    def counted(*arguments: Any) -> Any:
        calls.append(arguments)
        return simulate_many(*arguments)

    monkeypatch.setattr(linearisation, "simulate_many", counted)
    problem = make_problem([Recording("a", block_of(linear_recording(), *FULL))], (), {})
    far = {n: float(np.log(v * (5.0 if k % 2 else 0.2))) for k, (n, v) in enumerate(MOTOR.items())}
    solution = solve(problem, problem.start(far), robust=False)
    assert solution is not None
    assert solution.converged
    assert len(calls) == len(solution.iterations)
    assert solution.iterations[-1].evaluations > 1.5 * len(calls)


def test_differences_are_the_derivatives_of_every_recording_and_length(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two recordings with offsets of their own, in segments of two lengths, with a warm winding that goes on through
    them: one column for each unknown, of each segment its own."""
    run_uncompiled(monkeypatch)
    recordings = [
        Recording("a", block_of(linear_recording(1.0), *FULL)),
        Recording("b", block_of(linear_recording(0.7), *FULL)),
    ]
    effects = ("constant_load_torque", "current_sensor_offset", "winding_heating")
    exact = make_problem(recordings, effects, {}, segment_s=0.3)
    assert exact.local
    assert len({len(s.rows) for s in exact.segments}) > 1
    by_name = {p.name: np.log(p.nominal) if p.transform == "log" else p.nominal for p in exact.plant.parameters}
    unknowns = exact.start({**by_name, **{n: float(np.log(v)) for n, v in MOTOR.items()}})
    unknowns[exact.n_shared : len(exact.parameter_of_column)] += np.arange(len(exact.local) * 2) * 0.01
    differenced = linearise(replace(exact, exact=False, own_states=exact.plant.state_names), unknowns)
    here = linearise(exact, unknowns)
    for true, close, r, segment in zip(
        here.jacobian, differenced.jacobian, here.residuals, exact.segments, strict=True
    ):
        assert true.shape == close.shape == (*r.shape, true.shape[2])
        assert len(r) == len(segment.rows)
        scale = np.abs(true).max(axis=(0, 1))
        assert (np.abs(true - close).max(axis=(0, 1)) < 1e-3 * scale + 1e-6).all()
    for left, other in zip(here.residuals, differenced.residuals, strict=True):
        np.testing.assert_array_equal(left, other)


def test_without_a_current_three_combinations_of_five_are_left() -> None:
    fit = fit_output_error([Recording("a", block_of(linear_recording(), "voltage_V", "position_rad"))])
    assert len(fit.null_directions) == 2
    assert all(p.value is None and p.std is None and p.status == "undetermined" for p in fit.parameters.values())
    m = MOTOR
    truth = {
        "K/(B R + K²)": m["K"] / (m["B"] * m["R"] + m["K"] ** 2),
        "(J R + L B)/(B R + K²)": (m["J"] * m["R"] + m["L"] * m["B"]) / (m["B"] * m["R"] + m["K"] ** 2),
        "J L/(B R + K²)": m["J"] * m["L"] / (m["B"] * m["R"] + m["K"] ** 2),
    }
    found = {c.expression: c for c in fit.combinations}
    for name, value in truth.items():
        assert abs(found[name].value - value) < 4 * found[name].std
    assert "K/R" not in found  # of these five, K/R alone is not visible


def test_what_is_given_closes_the_null_directions() -> None:
    block = block_of(linear_recording(), "voltage_V", "position_rad")
    fit = fit_output_error([Recording("a", block)], (), FitOptions(fixed={"R": MOTOR["R"], "K": MOTOR["K"]}))
    assert fit.null_directions == ()
    assert fit.parameters["R"].status == "fixed"
    assert fit.parameters["R"].std is None
    for name in ("L", "J", "B"):
        p = fit.parameters[name]
        assert p.value is not None
        assert p.std is not None
        assert abs(p.value - MOTOR[name]) < 4 * p.std


def test_without_a_voltage_only_ratios_are_left() -> None:
    fit = fit_output_error([Recording("a", block_of(linear_recording(), "current_A", "position_rad"))])
    assert len(fit.null_directions) == 1
    assert set(fit.null_directions[0].components) == {"K", "J", "B"}
    found = {c.expression: c.value for c in fit.combinations}
    assert found["J/K"] == pytest.approx(MOTOR["J"] / MOTOR["K"], rel=0.02)


def test_voltage_and_current_alone_hold_what_they_hold() -> None:
    fit = fit_output_error([Recording("a", block_of(linear_recording(4.0), "voltage_V", "current_A"))])
    assert fit.parameters["R"].value == pytest.approx(MOTOR["R"], rel=0.02)
    assert fit.parameters["L"].value == pytest.approx(MOTOR["L"], rel=0.05)
    assert fit.parameters["K"].value is None
    found = {c.expression: c.value for c in fit.combinations}
    assert found["K²/J"] == pytest.approx(MOTOR["K"] ** 2 / MOTOR["J"], rel=0.05)


def test_a_speed_alone_is_an_answer_too() -> None:
    fit = fit_output_error([Recording("a", block_of(linear_recording(), "voltage_V", "current_A", "velocity_rad_s"))])
    for name, truth in MOTOR.items():
        assert fit.parameters[name].value == pytest.approx(truth, rel=0.03)


def test_every_capture_has_its_own_offsets_and_states() -> None:
    recordings = [
        Recording("a", block_of(linear_recording(torque=0.02, offset_A=0.3, seed=1), *FULL)),
        Recording("b", block_of(linear_recording(torque=-0.01, offset_A=-0.2, seed=2), *FULL)),
    ]
    fit = fit_output_error(recordings, ("constant_load_torque", "current_sensor_offset"))
    for name, truth in MOTOR.items():
        p = fit.parameters[name]
        assert p.value is not None
        assert p.std is not None
        assert abs(p.value - truth) < 4 * p.std
    for k, (torque, offset) in enumerate([(0.02, 0.3), (-0.01, -0.2)]):
        for name, truth in (("TL", torque), ("i0", offset)):
            p = fit.offsets[k][name]
            assert p.value is not None
            assert p.std is not None
            assert abs(p.value - truth) < 4 * p.std


def test_segments_give_the_same_motor() -> None:
    block = block_of(linear_recording(4.0), *FULL)
    whole = fit_output_error([Recording("a", block)])
    cut = fit_output_error([Recording("a", block)], (), FitOptions(segment_s=0.5))
    assert len(cut.problem.segments) == 8
    for name, p in cut.parameters.items():
        assert p.value is not None
        assert p.std is not None
        assert abs(p.value - MOTOR[name]) < 4 * p.std
        assert p.std >= 0.99 * (whole.parameters[name].std or 0.0)  # unknown states cost information


def test_a_long_gap_begins_a_new_segment() -> None:
    signals = linear_recording(4.0)
    keep = np.r_[0:1500, 2500:4000]
    time = np.arange(4000) / RATE_HZ
    block = make_block(time[keep], **{n: signals[n][keep] for n in FULL})
    problem = make_problem([Recording("a", block)], (), {})
    assert [len(s.rows) for s in problem.segments] == [1500, 1500]
    fit = fit_output_error([Recording("a", block)])
    assert fit.parameters["J"].value == pytest.approx(MOTOR["J"], rel=0.01)


def test_spikes_move_nothing_and_are_counted() -> None:
    signals = linear_recording()
    clean = fit_output_error([Recording("a", block_of(signals, *FULL))])
    spoilt = {**signals, "current_A": signals["current_A"].copy()}
    spoilt["current_A"][[300, 900, 1500]] += 40.0
    robust = fit_output_error([Recording("a", block_of(spoilt, *FULL))])
    plain = fit_output_error([Recording("a", block_of(spoilt, *FULL))], (), FitOptions(robust=False))
    assert robust.residual["current_A"].outliers == 3
    for name, p in robust.parameters.items():
        assert abs((p.value or 0) - (clean.parameters[name].value or 0)) < 0.5 * (clean.parameters[name].std or 0)
    worst = max(
        abs((p.value or 0) - (clean.parameters[n].value or 0)) / (clean.parameters[n].std or 1)
        for n, p in plain.parameters.items()
    )
    assert worst > 1.0


def test_what_lasts_keeps_its_weight() -> None:
    r = np.random.default_rng(0).normal(0.0, 1.0, (500, 1))
    r[100:140] += 30.0
    r[300] += 100.0
    (weights,) = sample_weights([r])
    assert (weights[105:135] == 1.0).all()
    assert weights[300, 0] < 0.2


def test_a_missing_effect_makes_the_residual_not_white() -> None:
    signals = linear_recording(torque=0.02)
    fit = fit_output_error([Recording("a", block_of(signals, *FULL))])
    assert not fit.white


def test_nothing_moves_nothing_is_claimed() -> None:
    n = 500
    rng = np.random.default_rng(0)
    block = make_block(
        np.arange(n) / RATE_HZ,
        voltage_V=np.zeros(n),
        current_A=rng.normal(0, 0.01, n),
        position_rad=np.zeros(n),
    )
    fit = fit_output_error([Recording("a", block)])
    assert all(p.std is None for p in fit.parameters.values())
    assert all(p.value is None or np.isfinite(p.value) for p in fit.parameters.values())


@pytest.mark.parametrize(
    ("channels", "words"),
    [(("voltage_V",), "no pair of an input and a response"), (("position_rad",), "no pair")],
)
def test_signals_that_answer_nothing_are_refused(channels: tuple[str, ...], words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        fit_output_error([Recording("a", block_of(linear_recording(), *channels))])


def test_an_impossible_fixed_value_is_named() -> None:
    with pytest.raises(BadInputError, match="R = -1"):
        fit_output_error([Recording("a", block_of(linear_recording(), *FULL))], (), FitOptions(fixed={"R": -1.0}))


def test_too_few_samples_are_refused() -> None:
    block = block_of(linear_recording(), *FULL).slice(0, 5)
    with pytest.raises(BadInputError, match="too few samples"):
        fit_output_error([Recording("a", block)])


def test_the_same_data_give_the_same_numbers() -> None:
    block = block_of(linear_recording(), *FULL)
    a, b = (fit_output_error([Recording("a", block)]) for _ in range(2))
    assert a.parameters == b.parameters


def test_the_scores_of_the_truth_are_the_noise() -> None:
    signals = linear_recording(3.0)
    block, plant = block_of(signals, *FULL), build_plant(())
    q = np.log([MOTOR[n] for n in plant.parameter_names])
    s = score(block, plant, q)
    assert set(s.rmse) == {"current_A", "velocity_rad_s", "position_rad"}
    assert s.rmse["current_A"] == pytest.approx(0.01, rel=0.3)
    worse = score(block, plant, q + np.log(1.3))
    assert worse.rmse["current_A"] > 3 * s.rmse["current_A"]
    assert worse.rmse_1s["position_rad"] > s.rmse_1s["position_rad"]


def test_a_run_that_explodes_scores_badly_and_finitely() -> None:
    block = block_of(linear_recording(), "voltage_V", "position_rad")
    plant = build_plant(())
    q = np.log([MOTOR[n] for n in plant.parameter_names])
    s = score(replace(block, voltage_V=np.full(len(block), 1e300)), plant, q)
    assert all(np.isfinite(v) for v in (*s.rmse.values(), *s.rmse_1s.values()))


def test_the_measured_speed_is_the_slope_of_the_angle() -> None:
    t = np.arange(1000) / RATE_HZ
    block = make_block(t, position_rad=np.sin(5 * t))
    speed = measured_speed(block)
    assert speed is not None
    assert np.allclose(speed[20:-20], 5 * np.cos(5 * t)[20:-20], atol=2e-3)


def test_with_every_parameter_given_only_states_are_fitted() -> None:
    fit = fit_output_error([Recording("a", block_of(linear_recording(), *FULL))], (), FitOptions(fixed=MOTOR))
    assert all(p.status == "fixed" and p.std is None for p in fit.parameters.values())
    assert {name: p.value for name, p in fit.parameters.items()} == MOTOR  # to the last digit
    assert fit.white
    assert fit.null_directions == ()


def test_a_phase_is_turned_back_and_not_held_at_a_bound() -> None:
    block = block_of(linear_recording(0.2), *FULL)
    problem = make_problem([Recording("test", block)], ("cogging_torque",), {"n_cog": 7.0})
    at = problem.free.index("phi_cog")
    for phase, same in ((6.7, 6.7 - 2 * np.pi), (-6.7, 2 * np.pi - 6.7), (6.4, 6.4)):
        unknowns = np.zeros(problem.n_unknowns)
        unknowns[at] = phase
        assert within(problem, unknowns)[at] == pytest.approx(same)
