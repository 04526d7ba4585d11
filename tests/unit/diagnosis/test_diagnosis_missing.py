"""Unmodelled torque and voltage: against a dense Gaussian smoother, over gaps and jitter, for every signal set."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.diagnosis.missing.missing import Missing, missing_inputs
from servo_daemon.diagnosis.missing.noise_levels import NoiseLevels, alive, resolution
from servo_daemon.diagnosis.missing.response import smoothed
from servo_daemon.identification.output_error import FitOptions, Recording, fit_output_error
from servo_daemon.plant.build import build_plant
from servo_daemon.plant.columns.screening import Trace
from servo_daemon.samples import F64, SampleBlock, make_block

VALUES = {"R": 1.0, "L": 2e-3, "K": 0.1, "J": 1e-4, "B": 1e-4}
LEVELS = NoiseLevels(
    {"torque": 1e-4, "voltage": 1e-2}, 1e-4, {"current_A": 1e-4, "position_rad": 1e-8, "velocity_rad_s": 1e-2}
)


def _capture(n: int = 400, torque: float = 0.0, seed: int = 3, jitter: float = 0.2) -> SampleBlock:
    """A linear motor stepped by the plant, with noise on both sensors and a load torque from the middle on."""
    rng = np.random.default_rng(seed)
    plant = build_plant(("constant_load_torque",))
    time = (np.arange(n) + jitter * rng.uniform(-0.5, 0.5, n)) * 1e-3
    u = 5 * np.sin(2 * np.pi * 3 * time) + rng.normal(0, 2, n)
    x, states = np.zeros(3), np.empty((n, 3))
    for k in range(n):
        states[k] = x
        h = time[k + 1] - time[k] if k + 1 < n else 1e-3
        load = torque if k >= n // 2 else 0.0
        x = np.asarray(plant.step(x, u[k], [*VALUES.values(), load], time[k], h)).ravel()
    return make_block(
        time,
        voltage_V=u,
        current_A=states[:, 0] + rng.normal(0, 0.01, n),
        position_rad=states[:, 2] + rng.normal(0, 1e-4, n),
        velocity_rad_s=states[:, 1] + rng.normal(0, 0.1, n),
    )


def _only(block: SampleBlock, *channels: str) -> SampleBlock:
    return make_block(block.time_s, **{name: getattr(block, name) for name in channels})


def _missing(block: SampleBlock, levels: NoiseLevels | None = None) -> Missing:
    """With the true parameters."""
    fixed = {name: value for name, value in VALUES.items() if name != "B"}
    fit = fit_output_error([Recording("test", block)], (), FitOptions(fixed=fixed, nominal=VALUES))
    names = fit.problem.plant.parameter_names
    coordinates = np.array([*(np.log(VALUES[name]) for name in names), 0.0])
    return missing_inputs(fit, block, coordinates=coordinates, levels=levels)


def _dense(m: Missing, levels: NoiseLevels, start: F64, P0: F64) -> tuple[F64, F64]:
    """Mean and variance of all z by one least-squares problem over everything random, its columns of variance 1:
    the initial state, every input noise, every step of the walks. Matrices from SciPy's exponential."""
    from scipy.linalg import expm, qr, solve_triangular

    p, rows, n = VALUES, m.stretches[0].rows, len(m.time_s)
    A = np.array([[-p["R"] / p["L"], -p["K"] / p["L"], 0], [p["K"] / p["J"], -p["B"] / p["J"], 0], [0, 1.0, 0]])
    inputs = np.array([[1 / p["L"], 0, -1 / p["L"]], [0, -1 / p["J"], 0], [0, 0, 0]])  # u, d_T, d_V
    means, M = [start], np.zeros((n, 5, 5 + 3 * (n - 1)))
    M[0, :, :5] = np.sqrt(P0)  # diagonal
    for k in range(n - 1):
        h = rows[k, 1]
        block = expm(np.block([[A, inputs], [np.zeros((3, 6))]]) * h)
        F = np.eye(5)
        F[:3, :3], F[:3, 3:] = block[:3, :3], block[:3, 4:]
        M[k + 1] = F @ M[k]
        M[k + 1, :3, 5 + 3 * k] = block[:3, 3] * np.sqrt(levels.input_var)
        M[k + 1, 3, 6 + 3 * k] = np.sqrt(levels.walk["torque"] * h)
        M[k + 1, 4, 7 + 3 * k] = np.sqrt(levels.walk["voltage"] * h)
        means.append(F @ means[-1] + np.append(block[:3, 3] * rows[k, 2], [0, 0]))
    mean = np.array(means)
    sigma = np.sqrt([levels.channel_var["current_A"], levels.channel_var["position_rad"]])
    shown = (M[:, [0, 2], :] / sigma[:, None]).reshape(2 * n, -1)
    left = ((rows[:, 3:5] - mean[:, [0, 2]]) / sigma).ravel()
    Q, R = qr(np.vstack([shown, np.eye(M.shape[2])]), mode="economic")
    noise = solve_triangular(R, Q.T @ np.append(left, np.zeros(M.shape[2])))
    spread = solve_triangular(R.T, M.reshape(5 * n, -1).T, lower=True)
    return mean + M @ noise, np.sum(spread**2, axis=0).reshape(n, 5)


def test_agrees_with_a_dense_gaussian_smoother() -> None:
    block = _only(_capture(60, torque=0.02), "voltage_V", "current_A", "position_rad")
    m = _missing(block, LEVELS)
    first, n_z = m.stretches[0].passed[0], m.augmented.n_z
    P0 = np.zeros((n_z, n_z))
    P0.T[np.triu_indices(n_z)] = first[m.augmented.columns["P"]]
    P0 = np.maximum(P0, P0.T)  # diagonal
    z, variance = _dense(m, LEVELS, first[:n_z], P0)
    scale = np.sqrt(np.mean(z**2, axis=0))
    assert np.max(np.abs(m.stretches[0].z - z) / scale) < 1e-8
    off = np.abs(m.stretches[0].std ** 2 / variance - 1)
    assert np.max(off[5:]) < 1e-6
    assert np.max(off) < 1e-3  # the first ones are what is left of the wide prior, a difference of large numbers


def test_a_load_step_is_found_with_its_size_and_time() -> None:
    block = _only(_capture(2000, torque=0.03), "voltage_V", "current_A", "position_rad")
    m = _missing(block)
    assert m.visible == "torque and voltage"
    torque, std = m.series["torque"], m.std["torque"]
    assert abs(np.mean(torque[200:900])) < 0.002
    assert abs(np.mean(torque[1100:1900]) - 0.03) < 0.002
    assert np.mean(np.abs(torque[1050:] - 0.03) < 1.96 * std[1050:]) > 0.8
    assert np.sqrt(np.mean(m.series["voltage"] ** 2)) < 0.1


@pytest.mark.parametrize(
    ("channels", "visible"),
    [
        (("voltage_V", "position_rad"), "sum as torque"),
        (("voltage_V", "velocity_rad_s"), "sum as torque"),
        (("voltage_V", "current_A"), "sum as voltage"),
        (("voltage_V", "current_A", "velocity_rad_s"), "torque and voltage"),
        (("current_A", "position_rad"), "torque"),
    ],
)
def test_every_signal_set_says_what_it_shows(channels: tuple[str, ...], visible: str) -> None:
    block = _only(_capture(3000, torque=0.02), *channels)
    m = _missing(block)
    assert m.visible == visible
    name = "voltage" if visible == "sum as voltage" else "torque"
    before, after = m.series[name][300:1400].mean(), m.series[name][1600:2900].mean()
    # referred to the terminals a load torque is R/K times as many volts, once the speed has settled
    if name == "torque":
        assert after - before == pytest.approx(0.02, abs=0.004)
    assert np.isfinite(m.std[name]).all()


def test_a_torque_as_input() -> None:
    whole = _capture(3000, torque=0.02)
    assert whole.current_A is not None
    block = make_block(whole.time_s, torque_Nm=0.1 * whole.current_A, position_rad=whole.position_rad)
    m = _missing(block)
    assert m.visible == "torque"
    assert m.series["torque"][1600:].mean() - m.series["torque"][300:1400].mean() == pytest.approx(0.02, abs=0.004)


def test_gaps_begin_anew_and_missing_values_are_passed_over() -> None:
    block = _only(_capture(3000, torque=0.02), "voltage_V", "current_A", "position_rad")
    keep = np.ones(3000, dtype=bool)
    keep[800:1300] = False
    cut = block.select(keep)
    current = np.array(cut.current_A)
    current[100:130] = np.nan
    cut = make_block(cut.time_s, voltage_V=cut.voltage_V, current_A=current, position_rad=cut.position_rad)
    m = _missing(cut)
    assert len(m.stretches) == 2
    assert len(m.time_s) == 2500
    assert all(np.isfinite(values).all() for values in (*m.series.values(), *m.std.values()))
    assert m.series["torque"][1200:].mean() == pytest.approx(0.02, abs=0.003)


def test_the_linear_response_is_what_a_changed_recording_shows() -> None:
    block = _only(_capture(500), "voltage_V", "current_A", "position_rad")
    wave = 0.05 * np.sin(np.arange(500) / 20)
    moved = make_block(
        block.time_s, voltage_V=block.voltage_V, current_A=block.current_A + wave, position_rad=block.position_rad
    )
    before, after = _missing(block, LEVELS), _missing(moved, LEVELS)
    shown = smoothed(before, [Trace(shown={"current_A": wave})])
    for name in ("torque", "voltage"):
        difference = after.series[name] - before.series[name]
        # the first state is a guess from the samples, and moves with them
        assert np.max(np.abs(difference - shown[name][:, 0])[50:]) < 1e-3 * np.max(np.abs(difference))


def test_intensities_are_found_from_the_data() -> None:
    block = _only(_capture(6000), "voltage_V", "current_A", "position_rad")
    levels = _missing(block).levels
    assert levels.channel_var["current_A"] == pytest.approx(1e-4, rel=0.15)
    assert levels.channel_var["position_rad"] == pytest.approx(1e-8, rel=0.15)
    assert levels.walk["torque"] < 1e-6  # nothing is missing


def test_resolution_and_standing_readings() -> None:
    t = np.arange(2000) / 1000
    steps = np.round(np.sin(t) / 0.01) * 0.01
    assert resolution(steps) == pytest.approx(0.01, rel=1e-6)
    assert resolution(np.random.default_rng(0).normal(size=500)) == 0.0
    assert alive(np.array([1.0] * 12)).tolist() == [True] * 4 + [False] * 4 + [True] * 4
