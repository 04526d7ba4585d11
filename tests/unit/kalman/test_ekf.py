"""The filter: agreement of its engines, held parameters, outliers, missing channels, definiteness, honest intervals."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
import pytest

from servo_daemon.kalman.ekf import Ekf
from servo_daemon.kalman.filterpy_ekf import FilterpyLoop
from servo_daemon.kalman.gaussian import Gaussian
from servo_daemon.kalman.layout import SPIKE
from servo_daemon.kalman.records import NoiseLevels
from servo_daemon.plant.build import PlantModel, build_plant
from servo_daemon.samples import SampleBlock
from servo_daemon.simulate import PAPER_MOTOR, SimulatedDrive, make_settings

CHANNELS = ("current_A", "position_rad")
TRUE = np.log([PAPER_MOTOR[n] for n in ("R", "L", "K", "J", "B")])


def record(seconds: float, seed: int = 1, **settings: object) -> SampleBlock:
    return SimulatedDrive(make_settings(seed=seed, **settings)).next_block(round(1000 * seconds))  # type: ignore[arg-type]


def rows(block: SampleBlock) -> np.ndarray:
    out = np.ones((len(block), 11))
    out[:, 0] = block.time_s - block.time_s[0]
    out[:, 1] = np.diff(block.time_s, prepend=block.time_s[0])
    out[:, 2], out[:, 3], out[:, 4], out[:, 7] = block.voltage_V, 0.0, block.current_A, block.position_rad
    out[:, 10] = 0.0
    return out


def started(
    plant: PlantModel | None = None, *, wrong: float = 0.2, engine: str = "compiled", drift: float = 1e-8
) -> Ekf:
    plant = build_plant() if plant is None else plant
    n = len(plant.parameters)
    loop = FilterpyLoop(plant, CHANNELS) if engine == "filterpy" else None
    ekf = Ekf(plant, CHANNELS, loop)
    mean = np.log([p.nominal if p.transform == "log" else 1.0 for p in plant.parameters])
    for k, p in enumerate(plant.parameters):
        if p.transform != "log":
            mean[k] = p.nominal
    ekf.start(Gaussian(plant.parameter_names, mean + wrong, np.diag(np.full(n, 0.3**2))))
    ekf.set_noise(NoiseLevels(2e-4, 1e-9, (1.6e-2, 2e-8)))
    ekf.set_active(np.ones(n), np.full(n, drift))
    ekf.use_instrumental_trajectory(wrong < 0.05)
    return ekf


def test_finds_the_motor_and_its_intervals_hold() -> None:
    ekf = started()
    ekf.update(rows(record(20.0)))
    found = ekf.estimate()
    error = np.abs(found.mean - TRUE)
    assert (error < 0.01).all(), dict(zip(found.names, error, strict=True))
    assert (error < 4 * found.std).all()
    assert (found.std < 0.01).all()


def test_a_misread_input_that_is_put_right_costs_no_more_than_one_that_is_not_known() -> None:
    clean = rows(record(4.0))
    wrong, unknown = clean.copy(), clean.copy()
    spike = np.where(np.arange(len(clean)) % 300 == 299, 40.0, 0.0)
    wrong[:, 2] += spike
    wrong[1:, 10] -= spike[:-1]
    unknown[:, 3] = np.square(spike)
    found = []
    for samples in (wrong, unknown):
        ekf = started(wrong=0.1)
        gated = ekf.update(samples).gated[3:]
        assert gated.any(axis=1).tolist() == (samples[3:, 10] != 0).tolist(), "the misread ones count as outliers"
        found.append(ekf.estimate())
    np.testing.assert_allclose(found[0].mean, found[1].mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found[0].covariance, found[1].covariance, rtol=1e-9)


def test_a_spike_of_the_current_says_nothing_and_is_an_outlier() -> None:
    clean = rows(record(4.0))
    spiked, missing = clean.copy(), clean.copy()
    where = np.arange(len(clean)) % 300 == 299
    spiked[where, 4:7] = np.column_stack([clean[where, 4] + 40.0, np.zeros(where.sum()), np.full(where.sum(), SPIKE)])
    missing[where, 4:6] = 0.0
    found = []
    for samples in (spiked, missing):
        ekf = started(wrong=0.1)
        gated = ekf.update(samples).gated[3:]
        assert gated.any(axis=1).tolist() == (samples[3:, 6] > 1.0).tolist()
        found.append(ekf.estimate())
    np.testing.assert_allclose(found[0].mean, found[1].mean, rtol=0, atol=1e-4 * found[1].std.min())
    np.testing.assert_allclose(found[0].std, found[1].std, rtol=1e-5)


@pytest.mark.parametrize("engine", ["compiled", "filterpy"])
def test_what_was_not_measured_is_nothing_in_a_likelihood(engine: str) -> None:
    """Whatever the noise is taken for: the likelihood of filled gaps would have it smaller."""
    samples = rows(record(0.3))
    missing = np.arange(len(samples)) % 5 == 4
    samples[missing, 5], samples[missing, 8] = 0.0, 0.0
    samples[0, 5] = 0.0
    found = started(wrong=0.1, engine=engine).update(samples)
    assert (found.innovation[missing] == 0.0).all() and (found.variance[missing] == 1.0).all()
    assert found.measured[~missing][1:].all() and not found.measured[missing].any()
    assert (found.variance[~missing][1:] != 1.0).all()


@pytest.mark.parametrize("effects", [(), ("coulomb_friction", "gravity_load", "winding_heating")])
def test_compiled_and_filterpy_agree(effects: tuple[str, ...]) -> None:
    """Also where a parameter is held, a channel is missing, a sample is an outlier and time stamps repeat."""
    samples = rows(record(0.6))
    samples[100:140, 5] = 0.0  # no current
    samples[200, 7] += 0.02  # an encoder glitch
    samples[300, 1] = 0.0  # the same time stamp twice
    samples[400, 3] = 4.0  # voltage hardly known
    samples[450, 2], samples[451, 10] = samples[450, 2] + 20.0, -20.0  # one that was misread, and put right
    samples[500, 4:7] = samples[500, 4] + 30.0, 0.0, SPIKE  # a current that spiked
    plant = build_plant(effects)
    results = []
    for engine in ("compiled", "filterpy"):
        ekf = started(plant, engine=engine)
        innovations = [ekf.update(samples[:250])]
        active = np.ones(len(plant.parameters))
        active[1] = 0.0
        ekf.set_active(active, 1e-8 * active)
        ekf.use_instrumental_trajectory(True)
        innovations.append(ekf.update(samples[250:]))
        flat = np.concatenate(
            [np.ravel(getattr(i, f)) for i in innovations for f in ("innovation", "variance", "gated")]
        )
        sums = [x for s in ekf.take_statistics().values() for x in astuple(s)]
        results.append((ekf.mean, ekf.covariance, flat, ekf.take_information(), np.array(sums)))
    spread = np.sqrt(np.diag(results[1][1]))  # a state known to kelvins need not agree to microkelvins
    for ours, theirs in zip(*results, strict=True):
        scale = np.abs(theirs).max()
        tolerance = (
            {1: 2e-5 * spread, 2: 2e-5 * np.outer(spread, spread)}[np.ndim(theirs)]
            if len(theirs) == len(spread)
            else 1e-9 * scale
        )
        excess = np.abs(ours - theirs) - 1e-6 * np.abs(theirs) - tolerance
        assert (excess <= 0).all(), (ours, theirs)


@pytest.mark.parametrize("effects", [(), ("coulomb_friction",)])
def test_with_parameters_that_are_known_the_short_step_says_the_same(effects: tuple[str, ...]) -> None:
    """In pieces as in one, and the filter's state after it is the one that the whole step leaves."""
    ekf, data = started(build_plant(effects), wrong=0.01), rows(record(2.0))
    n = len(ekf.plant.parameters)
    ekf.start(Gaussian(ekf.plant.parameter_names, ekf.coordinates, np.zeros((n, n))))
    ekf.set_active(np.zeros(n), np.zeros(n))
    begin = ekf.snapshot()
    whole = ekf.update(data, again=True)
    x, var = ekf.x, ekf.state_var
    ekf.restore(begin)
    pieces = [ekf.predict_held(np.ascontiguousarray(part)) for part in np.split(data, [7, 1200])]
    for name in ("innovation", "variance", "gated"):
        found = np.concatenate([getattr(piece, name) for piece in pieces])
        np.testing.assert_allclose(found, getattr(whole, name), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(ekf.x, x, rtol=1e-9)
    np.testing.assert_allclose(ekf.state_var, var, rtol=1e-9)


def test_a_held_parameter_does_not_move_but_still_shows_what_it_could_learn() -> None:
    ekf = started()
    active = np.array([1.0, 1.0, 1.0, 0.0, 1.0])
    ekf.set_active(active, 1e-8 * active)
    before = ekf.estimate()
    ekf.update(rows(record(5.0)))
    after = ekf.estimate()
    assert after.mean[3] == before.mean[3]
    assert after.covariance[3, 3] == pytest.approx(before.covariance[3, 3], rel=1e-9)
    assert ekf.take_information()[3] > 100
    assert ekf.is_sound()


def test_an_encoder_glitch_moves_nothing_and_is_counted() -> None:
    clean, spoilt = started(), started()
    samples = rows(record(6.0))
    bad = samples.copy()
    bad[5000:5003, 7] += 0.5
    clean.update(samples)
    gated = spoilt.update(bad).gated[:, 1]
    assert gated[5000] == 1 and gated[5003] == 1  # there and back: the state has followed in between
    shift = np.abs(spoilt.estimate().mean - clean.estimate().mean)
    assert (shift < 1.0 * clean.estimate().std).all()


def test_a_model_that_has_gone_wrong_is_not_locked_out() -> None:
    """Parameters 50 % off at full confidence: every sample is beyond the gate, and with the drift that the daemon
    assumes (1 % in √min) they are found all the same."""
    ekf = started(wrong=0.0, drift=0.01**2 / 60)
    samples = rows(record(30.0))
    ekf.update(samples[:3000])
    z = ekf.estimate()
    ekf.start(Gaussian(z.names, z.mean + 0.4, z.covariance), x=ekf.x)
    ekf.update(samples[3000:])
    assert (np.abs(ekf.estimate().mean - TRUE) < 0.05).all()


def test_without_a_channel_it_predicts_and_stays_definite() -> None:
    ekf = started()
    samples = rows(record(10.0))
    ekf.update(samples[:5000])
    known = ekf.estimate().std
    samples[5000:, 5] = samples[5000:, 8] = 0.0
    ekf.update(samples[5000:])
    assert ekf.is_sound()
    assert (ekf.estimate().std >= known * 0.999).all()


def test_stays_sound_through_gaps_and_bursts() -> None:
    rng = np.random.default_rng(8)
    samples = rows(record(30.0))
    samples[:, 1] *= rng.choice([0.0, 0.5, 1.0, 20.0, 300.0], size=len(samples), p=[0.05, 0.1, 0.8, 0.04, 0.01])
    samples[:, 5] = rng.random(len(samples)) < 0.7
    samples[:, 8] = rng.random(len(samples)) < 0.7
    samples[rng.random(len(samples)) < 0.01, 4] = 1e6
    ekf = started()
    for part in np.array_split(samples, 30):
        ekf.update(np.ascontiguousarray(part))
        assert ekf.is_sound()


@pytest.mark.slow
def test_ten_million_steps_keep_the_covariance_definite() -> None:
    """A long life in short: the same minute over and over, tiny drift, far more exact than a sensor could be."""
    ekf = started(drift=1e-12)
    ekf.set_noise(NoiseLevels(1e-8, 1e-16, (1e-8, 1e-14)))
    samples = rows(record(50.0))
    for _ in range(200):
        ekf.update(samples)
        assert ekf.is_sound()
    eigenvalues = np.linalg.eigvalsh(ekf.covariance[3:, 3:])
    assert eigenvalues.min() > 0


def test_bounds_are_kept() -> None:
    ekf = started()
    samples = rows(record(2.0))
    samples[:, 4] = 0.0  # no current whatever the voltage: R would have to be infinite
    ekf.update(samples)
    upper = np.log([p.upper for p in ekf.plant.parameters])
    lower = np.log([p.lower for p in ekf.plant.parameters])
    assert (ekf.estimate().mean <= upper).all() and (ekf.estimate().mean >= lower).all()
    assert np.isfinite(ekf.mean).all()


def test_intervals_contain_the_truth_as_often_as_they_say() -> None:
    """Twenty motors' worth of noise: pooled 95 % intervals of five parameters at three times."""
    inside = []
    for seed in range(20):
        ekf = started(drift=1e-10)
        samples = rows(record(6.0, seed=100 + seed))
        for part in np.split(samples, [2000, 4000]):
            ekf.update(np.ascontiguousarray(part))
            found = ekf.estimate()
            inside.append(np.abs(found.mean - TRUE) < 1.96 * found.std)
    assert 0.88 < np.mean(inside) <= 1.0


def test_what_was_known_before_can_be_recalled() -> None:
    """Opened and given back what was known: as if it had never been opened, but for what was learned meanwhile."""
    ekf = started(wrong=0.0)
    ekf.update(rows(record(5.0)))
    before = ekf.estimate()
    ekf.widen_parameters(np.full(5, 0.2**2))
    assert (ekf.coordinate_std > 0.19).all()
    ekf.take_in(np.arange(4), before.mean[:4], before.covariance[:4, :4])
    np.testing.assert_allclose(ekf.coordinate_std[:4], before.std[:4], rtol=0.05)
    np.testing.assert_allclose(ekf.coordinates, before.mean, atol=1e-6)
    assert ekf.coordinate_std[4] > 0.1
    assert ekf.is_sound()


def test_the_instrumental_trajectory_takes_no_noise_for_excitation() -> None:
    """Hardly any voltage but its own noise, in a winding far faster than the sampling: what the current says of L is
    the colour of the noise. Along the filter's own states L is soon "known", along the instrumental trajectory it is
    not."""
    rng = np.random.default_rng(4)
    plant = build_plant()
    n, h, noise_V = 20_000, 1e-3, 0.05
    p = np.array([1.13, 0.33e-3, 60.3e-3, 4e-5, 3e-5])
    x, shown = np.zeros(3), np.empty((n, 2))
    voltage = 0.3 * np.sin(2.0 * np.arange(n) * h)
    for k in range(n):
        shown[k] = x[0] + 9e-3 * rng.normal(), x[2] + 4e-4 * rng.normal()
        x = np.asarray(plant.step(x, voltage[k] + noise_V * rng.normal(), p, 0.0, h)).reshape(-1)
    samples = np.ones((n, 11))
    samples[:, 10] = 0.0
    samples[:, 0], samples[:, 1], samples[:, 2], samples[:, 3] = np.arange(n) * h, h, voltage, 0.0
    samples[:, 4], samples[:, 7] = shown[:, 0], shown[:, 1]
    std = []
    for use in (True, False):
        ekf = Ekf(plant, CHANNELS)
        ekf.start(Gaussian(plant.parameter_names, np.log(p), np.eye(5) * 0.3**2))
        ekf.set_noise(NoiseLevels(noise_V**2, 0.0, (9e-3**2, 4e-4**2)))
        ekf.set_active(np.ones(5), np.zeros(5))
        ekf.use_instrumental_trajectory(use)
        ekf.update(samples)
        std.append(ekf.coordinate_std[1])
    assert std[1] < 0.1
    assert std[0] > 0.2
