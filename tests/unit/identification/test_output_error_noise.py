"""Noise that enters the motor: the whitening filter, the likelihood, and when the estimate under it is published."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servo_daemon.identification.output_error import FitOptions, Recording, fit_output_error
from servo_daemon.identification.output_error.noise.noise import INPUT_NOISE, TORQUE_NOISE, likelihood_of, resolution
from servo_daemon.identification.output_error.noise.whitening import (
    SOURCES,
    Structure,
    Tangent,
    moving,
    tangent,
    whiten,
)
from servo_daemon.identification.output_error.problem.linearisation import linearise
from servo_daemon.identification.output_error.problem.problem import Problem
from servo_daemon.identification.output_error.problem.setup import make_problem
from servo_daemon.identification.output_error.solver.solver import point_of
from servo_daemon.identification.output_error.whitened_point import whiten_point, whitened_value
from servo_daemon.plant.build import build_plant
from servo_daemon.plant.linear import linear_step
from servo_daemon.samples import F64, SampleBlock, make_block

MOTOR = {"R": 1.2, "L": 2e-3, "K": 0.08, "J": 2e-4, "B": 1e-3}
RATE_HZ, CURRENT_STD, ANGLE_STD = 1000.0, 0.01, 1e-3


def noisy_block(n: int, *, voltage_std: float = 0.0, torque_std: float = 0.0, seed: int = 0) -> SampleBlock:
    """The linear motor by SciPy's `expm`, with white noise of sensors, voltage and load torque."""
    rng = np.random.default_rng(seed)
    v = np.repeat(rng.normal(0.0, 6.0, n // 20 + 1), 20)[:n]
    Ad, Bd = linear_step(MOTOR, 1.0 / RATE_HZ)
    x, path = np.zeros(3), np.empty((n, 3))
    for k in range(n):
        path[k] = x
        x = Ad @ x + Bd @ [v[k] + voltage_std * rng.normal(), torque_std * rng.normal()]
    return make_block(
        np.arange(n) / RATE_HZ,
        voltage_V=v,
        current_A=path[:, 0] + rng.normal(0.0, CURRENT_STD, n),
        position_rad=path[:, 2] + rng.normal(0.0, ANGLE_STD, n),
    )


def dense(model: Tangent) -> F64:
    """F | g | H of every sample with their zeros."""
    n, c = model.structure.states, model.structure.channels
    out = np.zeros((len(model.values), n * n + SOURCES * n + c * n))
    out[:, list(model.structure.used)] = model.values
    return out


def covariance(model: F64, weights: F64, variance: F64, n_x: int) -> F64:
    """Of all residuals, shape (n c, n c), from the response of every sample to every noise before it."""
    n, c = weights.shape
    F = model[:, : n_x**2].reshape(n, n_x, n_x).transpose(0, 2, 1)
    g = model[:, n_x**2 : n_x**2 + SOURCES * n_x].reshape(n, SOURCES, n_x).transpose(0, 2, 1)
    H = model[:, n_x**2 + SOURCES * n_x :].reshape(n, n_x, c).transpose(0, 2, 1)
    response = np.zeros((n * c, n * SOURCES))
    for cause in range(n):
        x = g[cause]
        for k in range(cause + 1, n):
            response[k * c : (k + 1) * c, cause * SOURCES : (cause + 1) * SOURCES] = H[k] @ x
            x = F[k] @ x
    return (response * np.tile(variance[:SOURCES], n)) @ response.T + np.diag((variance[SOURCES:] / weights).ravel())


def test_whitening_is_the_inverse_cholesky_factor_of_the_covariance() -> None:
    rng = np.random.default_rng(1)
    n, n_x, c, k = 40, 3, 2, 11
    F = 0.8 * np.eye(n_x) + 0.2 * rng.normal(size=(n, n_x, n_x))
    g, H = rng.normal(size=(n, n_x, SOURCES)), rng.normal(size=(n, c, n_x))
    model = np.concatenate([part.transpose(0, 2, 1).reshape(n, -1) for part in (F, g, H)], axis=1)
    weights, data = rng.uniform(0.2, 1.0, (n, c)), rng.normal(size=(n, c, k))
    variance = np.array([0.3, 0.05, 0.2, 0.7])
    missing = np.zeros((n, c), dtype=bool)
    missing[[5, 20, 20], [1, 0, 1]] = True
    used = np.flatnonzero(rng.uniform(size=model.shape[1]) < 0.8)
    model[:, np.setdiff1d(np.arange(model.shape[1]), used)] = 0.0
    kept = Tangent(np.ascontiguousarray(model[:, used]), Structure(n_x, c, tuple(used.tolist())))
    out = whiten(kept, np.where(missing, 0.0, weights), np.where(missing[:, :, None], 0.0, data), variance)
    there = ~missing.ravel()
    L = np.linalg.cholesky(covariance(model, weights, variance, n_x)[np.ix_(there, there)])
    expected = np.linalg.solve(L, data.reshape(n * c, k)[there])
    assert out.values.reshape(n * c, k)[there] == pytest.approx(expected, abs=1e-10)
    assert out.log_variance.sum() == pytest.approx(2 * np.log(np.diag(L)).sum(), abs=1e-10)
    assert not out.values[missing].any()
    assert not out.log_variance[missing].any()


def test_the_tangent_is_the_linear_motor() -> None:
    plant, n = build_plant(), 7
    q = np.log([MOTOR[name] for name in plant.parameter_names])
    rows = np.ascontiguousarray(np.c_[np.arange(n) * 1e-3, np.full(n, 1e-3), np.ones(n)])
    model = tangent(plant, ("current_A", "position_rad"), q, np.array([0.1, 2.0, 0.0]), rows)
    Ad, Bd = linear_step(MOTOR, 1e-3)
    H = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    expected = np.concatenate([Ad.ravel("F"), Bd.ravel("F"), H.ravel("F")])
    assert dense(model) == pytest.approx(np.tile(expected, (n, 1)), rel=1e-9, abs=1e-12)


def test_dry_friction_that_sticks_lets_no_noise_through() -> None:
    plant = build_plant(("coulomb_friction",))
    values = MOTOR | {"Tc": 0.5}
    q = np.log([values[name] for name in plant.parameter_names])
    rows = np.array([[0.0, 1e-3, 0.1]])
    n_x, speed = len(plant.states), plant.state_names.index("velocity_rad_s")
    at_rest = tangent(plant, ("position_rad",), q, np.zeros(n_x), rows)
    sliding = tangent(plant, ("position_rad",), q, np.array([0.0, 50.0, 0.0]), rows)
    for model, moves in ((at_rest, False), (sliding, True)):
        gains = dense(model)[0, n_x**2 : n_x**2 + SOURCES * n_x].reshape(SOURCES, n_x)
        assert np.all((gains[:, speed] != 0.0) == moves)


def residual_likelihood(block: SampleBlock):  # type: ignore[no-untyped-def]
    """Of the residuals at the true parameters, all variances free from 1e-12 to 1e4."""
    problem = make_problem([Recording("a", block)], (), {})
    start = problem.start({name: float(np.log(value)) for name, value in MOTOR.items()})
    start[-3:] = 0.0
    q = problem.coordinates(start, 0)
    model = tangent(problem.plant, problem.channels, q, np.zeros(3), problem.segments[0].rows)
    limits = np.full(4, np.log(1e-12)), np.full(4, np.log(1e4))
    return likelihood_of([model], [np.ones((len(block), 2))], linearise(problem, start).residuals, limits)


def test_the_value_needs_no_sensitivities() -> None:
    problem = make_problem([Recording("a", noisy_block(400))], (), {})
    start = problem.start({name: float(np.log(value)) for name, value in MOTOR.items()})
    linear = linearise(problem, start)
    point = point_of(problem, start, linear, tuple(np.ones_like(r) for r in linear.residuals))
    variance = np.log([1e-4, 1e-8, CURRENT_STD**2, ANGLE_STD**2])
    value = whitened_value(problem, point, variance)
    assert "jacobian" not in vars(linear)
    assert value == whiten_point(problem, point, variance)[0].value


def test_the_likelihood_finds_the_noise_there_is() -> None:
    at = residual_likelihood(noisy_block(6000, voltage_std=0.2, seed=4))
    found, value = at.with_source(at.sensors_alone(), INPUT_NOISE)
    assert np.exp(found / 2)[[0, 2, 3]] == pytest.approx([0.2, CURRENT_STD, ANGLE_STD], rel=0.06)
    assert np.exp(found[TORQUE_NOISE]) == 0.0
    assert value < at.value(at.sensors_alone()) - 1000.0
    for k in (0, 2, 3):  # a minimum: either side is worse
        for step in (-0.2, 0.2):
            assert at.value(found + step * (np.arange(4) == k)) > value
    assert value - at.with_source(found, TORQUE_NOISE)[1] < 12.0  # no torque is there, and none is seen


def test_the_likelihood_tells_a_torque_from_a_voltage() -> None:
    at = residual_likelihood(noisy_block(6000, voltage_std=0.2, torque_std=0.02, seed=5))
    voltage, _ = at.with_source(at.sensors_alone(), INPUT_NOISE)
    both, value = at.with_source(voltage, TORQUE_NOISE)
    assert at.value(voltage) - value > 100.0
    assert np.exp(both / 2) == pytest.approx([0.2, 0.02, CURRENT_STD, ANGLE_STD], rel=0.08)


def fitted(block: SampleBlock, noise_model: str = "auto"):  # type: ignore[no-untyped-def]
    options = FitOptions(nominal=MOTOR, noise_model=noise_model)  # type: ignore[arg-type]
    return fit_output_error([Recording("a", block)], (), options)


def test_noise_of_the_sensors_alone_is_plain_output_error() -> None:
    block = noisy_block(2000, seed=6)
    fit, plain = fitted(block), fitted(block, "none")
    assert fit.noise is None
    assert fit.innovation is None
    assert fit.white
    assert fit.parameters == plain.parameters


def test_noise_of_the_voltage_is_found_and_weighed() -> None:
    block = noisy_block(3000, voltage_std=0.2, seed=7)
    fit, plain = fitted(block), fitted(block, "none")
    assert fit.noise is not None
    assert fit.noise.input_std == pytest.approx(0.2, rel=0.06)
    assert fit.noise.sensor_std["current_A"] == pytest.approx(CURRENT_STD, rel=0.1)
    assert fit.noise.sensor_std["position_rad"] == pytest.approx(ANGLE_STD, rel=0.1)
    assert fit.white
    assert not plain.white
    assert fit.innovation is not None
    assert all(abs(test.autocorrelation) < 0.1 for test in fit.innovation.values())
    for name, p in fit.parameters.items():
        assert p.std is not None
        assert abs(p.value - MOTOR[name]) < 4 * p.std
    assert np.array_equal(fit.plain.point.unknowns, plain.solution.point.unknowns)


def test_a_torque_that_the_model_lacks_is_not_passed_off_as_noise() -> None:
    fit, plain = (
        fitted(noisy_block(3000, voltage_std=0.05, torque_std=0.02, seed=8), m)
        for m in ("auto", "none")  # type: ignore[misc]
    )
    assert fit.noise is None
    assert not fit.white
    assert np.array_equal(fit.solution.point.unknowns, plain.solution.point.unknowns)
    for name, p in fit.parameters.items():
        other = plain.parameters[name]
        assert p.std is not None
        assert other.std is not None
        assert p.std >= other.std * (1 - 1e-9)


def test_without_a_measured_current_noise_is_not_modelled() -> None:
    block = noisy_block(3000, voltage_std=0.2, seed=9)
    without = make_block(block.time_s, voltage_V=block.voltage_V, position_rad=block.position_rad)
    options = FitOptions(nominal=MOTOR, fixed={"R": MOTOR["R"], "L": MOTOR["L"]})
    assert fit_output_error([Recording("a", without)], (), options).noise is None


def problem_of(position: F64) -> Problem:
    n = len(position)
    rng = np.random.default_rng(0)
    block = make_block(
        np.arange(n) * 1e-3, voltage_V=rng.normal(size=n), current_A=rng.normal(size=n), position_rad=position
    )
    return make_problem([Recording("a", block)], (), {})


def test_steps_of_an_encoder_are_seen() -> None:
    lsb = 2 * np.pi / 4096
    counts = np.floor(300 * np.sin(np.arange(500) / 40.0))
    assert resolution(problem_of(counts * lsb))[1] == pytest.approx(lsb, rel=1e-9)
    assert resolution(problem_of(counts * lsb))[0] == 0.0  # a Gaussian current has none
    assert resolution(problem_of(np.sin(np.arange(500) / 40.0)))[1] == 0.0


def test_an_encoder_at_rest_does_not_count() -> None:
    position = np.concatenate([np.arange(50) * 0.01, np.full(100, 0.5), 0.5 + np.repeat(np.arange(1, 11), 3) * 0.01])
    problem = problem_of(position)
    mask = moving(problem)[0]
    assert mask[:, 0].all()
    assert mask[:50, 1].all()
    assert not mask[50:150, 1].any()
    assert mask[150:, 1].all()
    segment = replace(problem.segments[0], valid=np.zeros_like(problem.segments[0].valid))
    assert not moving(replace(problem, segments=(segment,)))[0].any()
