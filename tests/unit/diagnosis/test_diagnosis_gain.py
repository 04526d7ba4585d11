"""The gain: the formula of docs/diagnosis.md, of blocks that nothing else has touched, over noise that signals show."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from servo_daemon.diagnosis.inverse.rows import balance_rows
from servo_daemon.diagnosis.missing.noise_levels import NoiseLevels
from servo_daemon.diagnosis.screening.dependence import dependences
from servo_daemon.diagnosis.search.select import Selection
from servo_daemon.diagnosis.trial.compare import error_removed
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.model_discrepancy import longest_missing
from servo_daemon.diagnosis.trial.noise_floor import measured_levels, noise_floor, third_differences
from servo_daemon.diagnosis.trial.scored import Scored
from servo_daemon.diagnosis.trial.split import CHOICE, HELD_OUT, TRAIN, divide
from servo_daemon.diagnosis.trial.trial import Trial, fit_trial
from servo_daemon.diagnosis.verdict import gain as gain_module
from servo_daemon.diagnosis.verdict.adequacy import Believed
from servo_daemon.diagnosis.verdict.gain import Gain, gain, measured_on
from servo_daemon.errors import BadInputError
from servo_daemon.identification.output_error import Recording
from servo_daemon.samples import F64, make_block
from tests.recovery.generator import PAPER, Scenario, Sensors, generate

TRUE = {"R": PAPER.R, "L": PAPER.L, "K": PAPER.K, "J": PAPER.J, "B": PAPER.B}
TC = 0.12
SECONDS = 10.0


def scored(*runs: float) -> Scored:
    """Of runs of ten samples with these RMS errors, of a signal of 1."""
    squares = 10.0 * np.square(np.array(runs))[:, None]
    return Scored(squares, np.full_like(squares, 10.0), np.ones(1))


def of_size(rms: float) -> Scored:
    return scored(*[rms] * 12)


@pytest.mark.parametrize(
    ("b", "e", "n", "removed"),
    [
        (0.5, 0.3, 0.1, (0.25 - 0.09) / (0.25 - 0.01)),
        (0.5, 0.1, 0.2, (0.25 - 0.01) / (0.25 - 0.04)),  # less is left than noise should leave: above 1
        (0.5, 0.6, 0.1, (0.25 - 0.36) / (0.25 - 0.01)),  # worse: below 0, and below -1 where it is far worse
        (0.5, 1.5, 0.1, (0.25 - 2.25) / (0.25 - 0.01)),
    ],
)
def test_the_share_is_the_contracts_and_not_clipped(b: float, e: float, n: float, removed: float) -> None:
    share, ci95 = error_removed(of_size(b), of_size(e), of_size(n))
    assert share == pytest.approx(removed)
    assert ci95 == pytest.approx((removed, removed))  # all runs alike


@pytest.mark.parametrize("n", [0.5, 0.7, np.inf])
def test_where_noise_leaves_as_much_there_is_no_share(n: float) -> None:
    assert error_removed(of_size(0.5), of_size(0.3), of_size(n)) == (None, None)


def test_the_interval_is_of_runs_drawn_again_and_may_be_open() -> None:
    n = of_size(0.1)
    base = scored(*[0.3, 0.5] * 6)
    share, ci95 = error_removed(base, scored(*[0.29, 0.2] * 6), n)
    assert share is not None
    assert ci95 is not None
    assert ci95[0] < share - 0.05 < share + 0.05 < ci95[1] < 1.0
    _, ci95 = error_removed(scored(*[0.05] * 9, *[0.2] * 3), of_size(0.04), n)
    assert ci95 is not None
    assert np.isinf(ci95[1]), "of some resamples noise would leave all"


def test_what_a_recording_begins_with_is_not_held_out_and_a_dozen_runs_make_three_parts() -> None:
    for n in range(8, 60):
        split = divide(n, 0.5, (0, n // 2))
        assert (split.part[[0, n // 2]] != HELD_OUT).all()
        assert {TRAIN, CHOICE} <= set(split.part.tolist())
        measuring = np.count_nonzero(split.part == HELD_OUT)
        few = measuring == 0
        assert few or measuring >= 3, "fewer have no interval"
        assert few or n > 11
        assert not few or n < 20
        assert split.measuring == (CHOICE if few else HELD_OUT)
        assert split.before_measuring == ((TRAIN,) if few else (TRAIN, CHOICE))
        assert measured_on(split) == ("choosing" if few else "unseen")
    with pytest.raises(BadInputError, match="too short"):
        divide(7, 0.5)


def recorded(Tc: float, *, seconds: float = SECONDS, sensors: Sensors | None = None, seed: int = 4) -> Recording:
    effects = {"coulomb_friction": {"Tc": Tc}} if Tc else {}
    made = generate(PAPER, Scenario("multisine", seconds=seconds, effects=effects, sensors=sensors, seed=seed))
    block = make_block(made.time_s, voltage_V=made.voltage_V, current_A=made.current_A, position_rad=made.position_rad)
    return Recording("capture", block)


@pytest.fixture(scope="module")
def data() -> Data:
    return Data.of([recorded(TC)], {}, (), 0.5)


def fitted(data: Data, *effects: str) -> Trial:
    trial = fit_trial(data, effects, {**TRUE, "Tc": TC})
    assert trial is not None
    return trial


LEVELS = NoiseLevels({}, 0.0, {"current_A": 0.045**2, "position_rad": 1e-4**2})


def gained(data: Data) -> tuple[Gain, list[Trial]]:
    """The gain of Coulomb friction, and the models that were fitted for it."""
    fits: list[Trial] = []

    def kept(*arguments: object, **options: object) -> Trial | None:
        trial: Trial | None = fit_trial(*arguments, **options)  # type: ignore[arg-type]
        fits.extend([trial] if trial else [])
        return trial

    selection = Selection(
        data, fitted(data), fitted(data, "coulomb_friction"), ("coulomb_friction",), (), {"coulomb_friction": ()}
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gain_module, "fit_trial", kept)
        return gain(Believed(selection, None, None, (), LEVELS)), fits


def held_out_otherwise(data: Data, change: Callable[[F64], F64]) -> Data:
    """With another position in the times that are held out."""
    (recording,) = data.recordings
    block, seen = recording.block, recording.seen
    assert block.position_rad is not None
    assert seen is not None
    other = replace(block, position_rad=np.where(seen, block.position_rad, change(block.position_rad)))
    return replace(data, recordings=(replace(recording, block=other),))


def test_the_gain_is_of_runs_that_neither_model_has_been_fitted_to(data: Data) -> None:
    """Noise of 10 mrad on the held-out positions alone: no fit moves, and it is in both errors."""
    noise = np.random.default_rng(1).normal(0.0, 0.01, len(data.recordings[0].block))
    (plain, fits), (noisy, again) = gained(data), gained(held_out_otherwise(data, lambda x: x + noise))
    assert len(fits) == 2
    assert [f.values for f in fits] == [f.values for f in again]
    assert plain.extended_score is not None
    assert noisy.extended_score is not None
    for before, after in (
        (plain.baseline_score, noisy.baseline_score),
        (plain.extended_score, noisy.extended_score),
    ):
        added = after.rmse["position_rad"] ** 2 - before.rmse["position_rad"] ** 2
        assert np.sqrt(added) == pytest.approx(0.01, rel=0.05)
        assert after.rmse["current_A"] == pytest.approx(before.rmse["current_A"], rel=0.05)


def test_the_gain_is_of_models_fitted_to_all_the_rest(data: Data) -> None:
    _, fits = gained(data)
    rest = data.split.of(TRAIN, CHOICE)
    for trial in fits:
        assert [s.begin for s in trial.fitted.segments] == [trial.problem.segments[int(k)].begin for k in rest]
        assert all(s.valid[-400:].all() for s in trial.fitted.segments)


def test_the_reported_gain_is_the_formula_of_the_reported_errors(data: Data) -> None:
    found, _ = gained(data)
    assert found.extended_score is not None
    assert found.floor is not None
    b, e, n = found.baseline_score.nrmse, found.extended_score.nrmse, found.floor
    assert found.removed == pytest.approx((b**2 - e**2) / (b**2 - n**2))
    assert found.effects[0].gain == found.removed
    assert 0.6 * e < n < 1.5 * e
    assert 0.97 < found.removed < 1.03, "the whole truth is in the model"


def test_what_is_held_out_stays_so_however_the_runs_are_cut(data: Data) -> None:
    seen = data.recordings[0].seen
    assert seen is not None
    for length in (0.07, 0.23, 0.5):
        cut = data.cut((), length)
        problem = cut.problem((), {})
        assert cut.recordings[0].seen is seen
        for segment, part in zip(problem.segments, cut.split.part.tolist(), strict=True):
            there = seen[segment.begin : segment.begin + len(segment.rows)]
            assert not segment.valid[there if part == HELD_OUT else ~there].any()
        assert {TRAIN, CHOICE, HELD_OUT} == set(cut.split.part.tolist())


def test_held_out_samples_tell_where_the_motor_is_and_nothing_else(data: Data) -> None:
    trial = fitted(data)
    one = longest_missing(data, trial)
    assert (one.seen == data.recordings[0].seen).all()
    wild = {name: np.where(one.seen, series, 1e3) for name, series in one.series.items()}
    other = replace(one, series=wild)
    assert other.mean_square == one.mean_square
    for a, b in zip(dependences(trial, other), dependences(trial, one), strict=True):
        assert (a.series, a.on) == (b.series, b.on)
        assert a.size == pytest.approx(b.size, rel=1e-5)
    assert measured_levels(other) == measured_levels(one)


def test_no_innovation_that_is_held_out_counts_for_the_levels(data: Data) -> None:
    """A quarter of the samples with noise of 10 mrad would make the sensor's variance a quarter of its square. (What is
    left of that is the state that the noisy samples hand on.)"""
    noise = np.random.default_rng(1).normal(0.0, 0.01, len(data.recordings[0].block))
    levels = longest_missing(held_out_otherwise(data, lambda x: x + noise), fitted(data)).levels
    assert levels.channel_var["position_rad"] < 0.01 * 0.25 * 0.01**2


def test_no_input_is_noisier_than_converters_are(data: Data) -> None:
    """Friction that sticks and slides passes for noise of the voltage as large as the voltage itself."""
    missing = longest_missing(data, fitted(data))
    noisy = replace(missing, levels=replace(missing.levels, input_var=1e3))
    assert measured_levels(noisy).input_var == pytest.approx(0.05**2 * np.mean(missing.input**2))


@pytest.mark.parametrize("effects", [("coulomb_friction",), ()])
def test_the_levels_are_the_noise_and_not_what_a_model_gets_wrong(data: Data, effects: tuple[str, ...]) -> None:
    """Also where the model lacks the friction, and its free runs are off by several times the noise."""
    trial, right, true = fitted(data, *effects), fitted(data, "coulomb_friction"), Sensors.laboratory(PAPER)
    levels = measured_levels(longest_missing(data, trial))
    assert levels.channel_var["current_A"] ** 0.5 == pytest.approx(true.current_noise_A, rel=0.1)
    assert levels.channel_var["position_rad"] ** 0.5 == pytest.approx(
        2 * np.pi / PAPER.counts_per_rev / np.sqrt(12.0), rel=0.2
    )
    floor, error = noise_floor(levels, right, HELD_OUT).nrmse, right.held_out.nrmse
    assert 0.6 * error < floor < 1.5 * error
    if not effects:
        assert trial.held_out.nrmse > 5.0 * floor


def test_noise_of_the_input_adds_up_in_the_floor(data: Data) -> None:
    trial = fitted(data, "coulomb_friction")
    quiet, loud = (noise_floor(replace(LEVELS, input_var=std**2), trial, HELD_OUT).mse for std in (0.0, 0.5))
    assert np.sqrt(quiet) == pytest.approx([0.045, 1e-4], rel=0.1)
    assert (loud > 1.5 * quiet).all()


def test_third_differences_hold_the_noise_and_hardly_the_motion() -> None:
    rng, t = np.random.default_rng(3), np.arange(20_000) / 1000.0
    noise = rng.normal(0.0, 0.01, len(t))
    motion = np.sin(2 * np.pi * t) + 5.0 * (np.floor(t) % 2)  # with a step every second
    assert third_differences([noise + motion]) ** 0.5 == pytest.approx(0.01, rel=0.03)
    assert third_differences([np.zeros(2)]) == np.inf


def test_the_balance_has_the_same_division(data: Data) -> None:
    """Rows of free runs that nothing else may look at are in the part that measures, and no others."""
    (recording,) = data.recordings
    turned = replace(recording, block=replace(recording.block, voltage_V=None))
    rows = balance_rows(replace(data, recordings=(turned,)), (), TRUE)
    assert rows is not None
    runs, counts = np.unique(rows.run[rows.run >= 0], return_counts=True)
    assert set(range(1, len(data.split.part) - 1)) <= set(runs.tolist())
    assert counts.max() <= 1.1 * np.median(counts)
    assert (rows.part[rows.run >= 0] == data.split.part[rows.run[rows.run >= 0]]).all()
