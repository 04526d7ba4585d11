"""A fit over shorter free runs, which is believed where it contradicts that over longer ones."""

from __future__ import annotations

from pathlib import Path

import pytest
from threadpoolctl import threadpool_limits

from servo_daemon.captures import read_capture
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.full_data_fit import fit_runs
from servo_daemon.diagnosis.trial.split import segment_length_s
from servo_daemon.diagnosis.trial.trial import fit_trial
from servo_daemon.diagnosis.verdict.adequacy import _unbiased
from servo_daemon.identification.output_error import Recording
from tests.recovery.generator import MOTORS, Scenario, generate, typical


@pytest.mark.slow
def test_a_ripple_is_not_given_up_for_the_speeds_that_shorter_runs_begin_with(tmp_path: Path) -> None:
    """An RE 40 in steps, whose commutator passes up to 0.8 times a sample; its ripple was named, and published as 10⁻⁶,
    as long as a step took the torque constant at its mean."""
    motor, seconds = MOTORS["re40"], 20.0
    effects = typical("torque_ripple", motor, 0.2, seconds=seconds)
    path = tmp_path / "capture.csv"
    generate(motor, Scenario("steps", seconds=seconds, effects=effects, seed=49140)).write_csv(path)
    recordings = [Recording("capture", read_capture(path).block())]
    hidden = {name: float(value) for name, value in effects["torque_ripple"].items()}
    truth = {n: getattr(motor, n) for n in ("R", "L", "K", "J", "B")} | hidden
    with threadpool_limits(limits=1):
        data = Data.of(recordings, {}, (), segment_length_s(recordings))
        trial = fit_trial(data, ("torque_ripple",), truth)
        assert trial is not None
        longer = fit_runs(data, trial, trial.values, data.split.segment_s)
        found = _unbiased(data, trial, longer).parameters
    k_rip = found["k_rip"]
    assert k_rip.value == pytest.approx(hidden["k_rip"], rel=0.05)
    assert found["B"].value == pytest.approx(motor.B, rel=0.2)
    assert k_rip.std is not None and abs(k_rip.value - hidden["k_rip"]) < 4 * k_rip.std + 0.02 * hidden["k_rip"]
