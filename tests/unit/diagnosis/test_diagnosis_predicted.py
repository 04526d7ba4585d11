"""What predictions are judged on, and what their gain is measured on: parts that the fits have not seen."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import pytest

from servo_daemon.diagnosis.missing.noise_levels import NoiseLevels
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.full_data_fit import fit_whole
from servo_daemon.diagnosis.trial.scored import Scored
from servo_daemon.diagnosis.trial.split import CHOICE, HELD_OUT, TRAIN
from servo_daemon.diagnosis.trial.trial import Trial, fit_trial
from servo_daemon.diagnosis.verdict import predicted as module
from servo_daemon.diagnosis.verdict.predicted import Predicted, Seen, Times, predicted, predictions_of_both, times_of
from servo_daemon.identification.output_error import OutputErrorFit, Recording
from servo_daemon.samples import make_block
from tests.recovery.generator import PAPER, Scenario, Sensors, generate

SECONDS = 8.0
TRUE = {"R": PAPER.R, "L": PAPER.L, "K": PAPER.K, "J": PAPER.J, "B": PAPER.B}
LEVELS = NoiseLevels({}, 0.024**2, {"current_A": 0.045**2, "position_rad": 1.1e-4**2})


def recorded(seconds: float) -> Recording:
    made = generate(PAPER, Scenario("multisine", seconds=seconds, sensors=Sensors.laboratory(PAPER), seed=7))
    block = make_block(made.time_s, voltage_V=made.voltage_V, current_A=made.current_A, position_rad=made.position_rad)
    return Recording("capture", block)


@dataclass
class Fit:
    """A fit that has seen some times."""

    name: str
    seen: tuple[np.ndarray[Any, Any], ...]

    @property
    def likeliest(self) -> bool:
        return True


@dataclass
class Model:
    effects: tuple[str, ...] = ()


def judged(
    data: Data, monkeypatch: pytest.MonkeyPatch, better_by: float = 10.0
) -> tuple[list[tuple[Fit, Times]], object]:
    """What was predicted by which fit, and what came of it; the richer model is better on every free run."""
    asked: list[tuple[Fit, Times]] = []
    seen = tuple(r.seen for r in data.recordings if r.seen is not None)

    def without(_data: Data, _trial: Trial, fit: Fit, times: Times) -> Fit:
        return Fit(fit.name, tuple(m & (runs < 0) for m, runs in zip(seen, times, strict=True)))

    def asking(fit: Fit, times: Times, _levels: NoiseLevels) -> Predicted:
        asked.append((fit, times))
        deviance = np.full(6, 0.0 if fit.name == "rich" else better_by)
        return Predicted(deviance, cast(Scored, None), cast(Scored, None))

    monkeypatch.setattr(module, "_fitted_without", without)
    monkeypatch.setattr(module, "predicted", asking)
    monkeypatch.setattr(module, "longest_missing", lambda *_: None)
    monkeypatch.setattr(module, "measured_levels", lambda _: LEVELS)
    simple, rich = ((Model(), Fit(name, seen)) for name in ("simple", "rich"))
    return asked, predictions_of_both(data, cast(Seen, simple), cast(Seen, rich))


def touched(asked: tuple[Fit, Times]) -> bool:
    """Whether the fit has seen some of the times that it predicts."""
    fit, times = asked
    return any((seen & (runs >= 0)).any() for seen, runs in zip(fit.seen, times, strict=True))


def parts_of(data: Data, times: Times) -> set[int]:
    return {int(data.split.part[k]) for runs in times for k in runs[runs >= 0]}


def test_chosen_on_one_part_and_measured_on_another(monkeypatch: pytest.MonkeyPatch) -> None:
    data = Data.of([recorded(SECONDS)], {}, (), 0.5)
    asked, both = judged(data, monkeypatch)
    assert both is not None
    assert [parts_of(data, times) for _, times in asked] == [{CHOICE}, {CHOICE}, {HELD_OUT}, {HELD_OUT}]
    assert not any(map(touched, asked))
    measuring = asked[-1][0]
    of = times_of(data, (), TRAIN), times_of(data, (), CHOICE)
    assert all(touched((measuring, times)) for times in of), "fitted to all the rest"


def test_too_short_for_three_parts_it_is_measured_where_it_was_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    data = Data.of([recorded(4.5)], {}, (), 0.5)
    asked, both = judged(data, monkeypatch)
    assert both is not None
    assert [parts_of(data, times) for _, times in asked] == [{CHOICE}, {CHOICE}]
    assert not any(map(touched, asked))


def test_what_decides_is_not_what_measures(monkeypatch: pytest.MonkeyPatch) -> None:
    data = Data.of([recorded(SECONDS)], {}, (), 0.5)
    asked, both = judged(data, monkeypatch, better_by=-10.0)
    assert both is None
    assert [parts_of(data, times) for _, times in asked] == [{CHOICE}, {CHOICE}]


@pytest.fixture(scope="module")
def fits() -> tuple[Data, OutputErrorFit, OutputErrorFit]:
    """Fitted in one run to what may be seen; again with another position where it may not."""
    data = Data.of([recorded(SECONDS)], {}, (), 0.5)
    (recording,) = data.recordings
    position, seen = recording.block.position_rad, recording.seen
    assert position is not None
    assert seen is not None
    shifted = position + 0.2 + np.random.default_rng(2).normal(0.0, 1e-3, len(position))
    other = replace(recording.block, position_rad=np.where(seen, position, shifted))
    changed = replace(data, recordings=(replace(recording, block=other),))
    trial = fit_trial(data, (), TRUE)
    assert trial is not None
    one, two = (fit_whole(d, trial) for d in (data, changed))
    assert one is not None
    assert two is not None
    return data, one, two


def test_a_fit_in_one_run_does_not_see_what_is_held_out(fits: tuple[Data, OutputErrorFit, OutputErrorFit]) -> None:
    _, one, two = fits
    assert one.values == two.values
    assert one.deviance == two.deviance
    assert one.white


def test_errors_and_noise_are_those_of_the_times_asked_for(fits: tuple[Data, OutputErrorFit, OutputErrorFit]) -> None:
    data, one, two = fits
    times = {part: times_of(data, (), part) for part in (CHOICE, HELD_OUT)}
    right = predicted(one, times[HELD_OUT], LEVELS)
    assert right is not None
    assert right.errors.counts.sum() == 2 * sum((runs >= 0).sum() for runs in times[HELD_OUT])
    assert right.expected.nrmse == pytest.approx(right.errors.nrmse, rel=0.05)
    louder = predicted(one, times[HELD_OUT], replace(LEVELS, channel_var={"current_A": 1.0, "position_rad": 1.0}))
    assert louder is not None
    assert louder.errors.nrmse == right.errors.nrmse
    assert louder.expected.nrmse > 10.0 * right.expected.nrmse
    # Where the position jumps by 0.2 rad and back the predictions are wrong.
    jumped = predicted(two, times[HELD_OUT], LEVELS)
    assert jumped is not None
    assert jumped.errors.mse[1] > 100.0 * right.errors.mse[1]
