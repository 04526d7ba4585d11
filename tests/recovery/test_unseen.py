"""Nothing that decides counts the part that measures: with other measurements there the same models are fitted, the
same effects are chosen, the same judge decides. Only the gain is another. (Screening knows from it where the motor was,
and fits begin where screening puts them: the same end, to some digits.)"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from servo_daemon.captures import Capture, read_capture
from servo_daemon.diagnosis.diagnose import diagnose
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.split import segment_length_s
from servo_daemon.identification.output_error import Recording
from tests.recovery.generator import PAPER, EffectValues, Scenario, generate

pytestmark = pytest.mark.slow


def both(folder: Path, effects: dict[str, EffectValues], seconds: float) -> tuple[Capture, Capture]:
    """A capture, and the same with noise of 1 mrad on the position wherever it is held out."""
    path = folder / "capture.csv"
    generate(PAPER, Scenario("multisine", seconds=seconds, effects=effects, seed=6)).write_csv(path)
    capture = read_capture(path)
    recordings = [Recording("capture", capture.block())]
    seen = Data.of(recordings, {}, (), segment_length_s(recordings)).recordings[0].seen
    assert seen is not None
    assert capture.position_rad is not None
    noise = np.random.default_rng(0).normal(0.0, 1e-3, len(seen))
    return capture, replace(capture, position_rad=np.where(seen, capture.position_rad, capture.position_rad + noise))


@pytest.mark.timeout(1200)
@pytest.mark.parametrize("effects", [{"coulomb_friction": {"Tc": 0.2}}, {"drive_lag": {"t_lag": 0.4e-3}}])
def test_nothing_that_decides_sees_what_measures(tmp_path: Path, effects: dict[str, EffectValues]) -> None:
    one, two = (diagnose([c]) for c in both(tmp_path, effects, 8.0))
    assert one.verdict == two.verdict == "found"
    assert one.judged_by == two.judged_by
    assert one.measured_on == two.measured_on == "unseen"
    assert [(e.name, e.equivalent) for e in one.effects] == [(e.name, e.equivalent) for e in two.effects]
    for a, b in zip(*([c for c in d.candidates if c.taken] for d in (one, two)), strict=True):
        assert (a.name, a.beside) == (b.name, b.beside)
        assert a.nrmse == pytest.approx(b.nrmse, rel=1e-5)
        assert a.delta_bic == pytest.approx(b.delta_bic, rel=1e-5)
    assert (one.deviance_gain is None) is (two.deviance_gain is None)
    if one.deviance_gain is not None:
        assert one.deviance_gain == pytest.approx(two.deviance_gain, rel=1e-3)
    assert one.extended_score is not None
    assert two.extended_score is not None
    assert one.extended_score.rmse["position_rad"] < 0.5e-3 < two.extended_score.rmse["position_rad"]
    assert one.error_removed != two.error_removed
