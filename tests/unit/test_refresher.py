"""The learned model inside the pipeline: published as `grnn`, the same however samples arrive, its own drive only."""

from __future__ import annotations

import csv
import dataclasses
import json
from pathlib import Path

import pytest

from servo_daemon.captures import write_capture
from servo_daemon.cli import main
from servo_daemon.config import DriveConfig, EstimationConfig
from servo_daemon.errors import ConfigError
from servo_daemon.estimates_csv import EstimatesWriter
from servo_daemon.learning import DEFAULT_MOTORS
from servo_daemon.learning.drawing import CORE
from servo_daemon.learning.model import LearnedModel
from servo_daemon.learning.model_file import save_model
from servo_daemon.samples import SampleBlock
from servo_daemon.service.model_change import ModelRequest
from servo_daemon.service.pipeline import Pipeline
from servo_daemon.service.refresher import Refresher
from servo_daemon.service.snapshot import Estimate
from servo_daemon.service.training_spec import training_spec
from servo_daemon.simulate import PAPER_MOTOR, SimulatedDrive, make_settings
from tests.learned_models import SPEC, small_model

DRIVE = DriveConfig(nominal=dict(PAPER_MOTOR), estimation=EstimationConfig(refresh_every_s=2.0, refresh_window_s=2.0))


@pytest.fixture(scope="module")
def model() -> LearnedModel:
    return small_model()


@pytest.fixture(scope="module")
def recording() -> SampleBlock:
    return SimulatedDrive(make_settings(rate_hz=500.0)).next_block(6000)


def run(model: LearnedModel | None, block: SampleBlock, size: int, drive: DriveConfig = DRIVE) -> list[Estimate]:
    pipeline, out = Pipeline(drive), []
    pipeline.use_learned(model)
    for k in range(0, len(block), size):
        out += pipeline.process(block.slice(k, min(k + size, len(block))))
    return out


def test_the_same_however_samples_arrive(model: LearnedModel, recording: SampleBlock) -> None:
    assert run(model, recording, 37) == run(model, recording, 5000)


def test_what_is_published(model: LearnedModel, recording: SampleBlock) -> None:
    estimates = run(model, recording, 500)
    first, last = estimates[0].estimators["grnn"], estimates[-1].estimators["grnn"]
    assert first.parameters == {}
    assert first.detail["mode"] == "shadow"
    assert first.detail["reason"] == "collecting the first window"
    windows = last.detail["windows"]
    assert isinstance(windows, int)
    assert windows >= 4
    assert last.detail["windows_declined"] == 0
    assert set(last.parameters) == set(CORE)  # this drive's model has no Tc
    for n, (value, std) in last.parameters.items():
        assert value is not None
        assert std is not None
        assert abs(value / PAPER_MOTOR[n] - 1) < max(0.15, 4 * std / PAPER_MOTOR[n]), n
    familiarity = last.detail["familiarity"]
    assert isinstance(familiarity, float)
    assert 0 < familiarity <= 1


def test_a_filter_that_is_well_is_as_it_would_be_without(model: LearnedModel, recording: SampleBlock) -> None:
    with_it, without = run(model, recording, 500)[-1], run(None, recording, 500)[-1]
    assert "grnn" not in without.estimators
    for p, q in zip(with_it.parameters, without.parameters, strict=True):
        assert p.value is not None
        assert q.value is not None
        assert q.std is not None
        assert abs(p.value - q.value) < q.std, p.name


def test_a_model_of_another_drive_is_not_asked(model: LearnedModel, recording: SampleBlock) -> None:
    other = DRIVE.model_copy(update={"model": ("coulomb_friction",)})
    assert "grnn" not in run(model, recording.slice(0, 2000), 500, other)[-1].estimators


def test_it_is_left_out_after_a_change_of_the_model(model: LearnedModel, recording: SampleBlock) -> None:
    pipeline = Pipeline(DRIVE)
    pipeline.use_learned(model)
    assert "grnn" in pipeline.process(recording.slice(0, 2500))[-1].estimators
    request = ModelRequest(("coulomb_friction",), {})
    config = request.configure(DRIVE)
    pipeline.change_model(request, config, pipeline.prepare(config))
    after = [e for e in pipeline.process(recording.slice(2500, 6000)) if e.model == ("coulomb_friction",)]
    assert after
    assert all("grnn" not in e.estimators for e in after)


def test_what_enters_the_filter_is_told_once(model: LearnedModel, recording: SampleBlock) -> None:
    """A filter held three times off by force, each time a window is due."""
    from servo_daemon.estimators.settings import Resolutions, TrackerSettings
    from servo_daemon.estimators.tracker import Tracker

    tracker = Tracker(recording.channels, TrackerSettings((), dict(PAPER_MOTOR), {}, "compiled"), Resolutions())
    refresher, told = Refresher(model, CORE, 2.0), []
    for k in range(0, len(recording), 50):
        tick = recording.slice(k, k + 50)
        tracker.take(tick)
        tracker.close_tick(tick)
        if tracker.ekf is not None and tracker.ekf.started:
            g = tracker.ekf.estimate()
            tracker.ekf.put_parameters(g.mean + 0.3, g.covariance)
        told += refresher.take(tick, tracker)
    applied = refresher.view.detail["applied"]
    assert isinstance(applied, int)
    assert applied >= 2
    assert [kind for kind, _, _ in told] == ["refreshed"]
    assert "R by" in told[0][1]
    assert refresher.view.detail["mode"] == "trusted"
    assert refresher.view.detail["effect_R_percent"] != 0


def capture(path: Path, block: SampleBlock) -> Path:
    write_capture(path, block)
    return path


def test_replay_writes_its_columns(
    model: LearnedModel, recording: SampleBlock, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_model(model, tmp_path / "axis.model")
    source = capture(tmp_path / "c.csv", recording)
    config = tmp_path / "c.toml"
    nominal = "\n".join(f"{n} = {v}" for n, v in PAPER_MOTOR.items())
    config.write_text(f'[[drive]]\nname = "a"\n[drive.nominal]\n{nominal}\n[drive.estimation]\nrefresh_every_s = 2\n')
    outs = []
    for size in ("100", "7000"):
        out = tmp_path / f"{size}.csv"
        options = ["--learned", str(tmp_path / "axis.model"), "--config", str(config), "--block", size]
        assert main(["replay", str(source), "--out", str(out), *options]) == 0
        outs.append(out.read_bytes())
    assert outs[0] == outs[1]
    rows = list(csv.DictReader(outs[0].decode().splitlines()))
    assert rows[0]["grnn_R"] == ""
    assert float(rows[-1]["grnn_R"]) == pytest.approx(PAPER_MOTOR["R"], rel=0.15)
    assert float(rows[-1]["grnn_R_std"]) > 0
    foreign = tmp_path / "foreign.toml"
    foreign.write_text(config.read_text().replace(f"R = {PAPER_MOTOR['R']}", "R = 3.0"))
    options = ["--learned", str(tmp_path / "axis.model"), "--config", str(foreign)]
    assert main(["replay", str(source), "--out", str(tmp_path / "x.csv"), *options]) != 0
    assert "trained around R" in capsys.readouterr().err
    assert not (tmp_path / "x.csv").exists()


def test_columns_only_where_there_is_a_model(recording: SampleBlock, tmp_path: Path) -> None:
    with EstimatesWriter(tmp_path / "e.csv", CORE, ("ekf", "rls")) as writer:
        assert not any(c.startswith("grnn_") for c in writer.columns)
        writer.write(run(None, recording.slice(0, 500), 500)[-1])


def test_what_is_trained_for_a_drive() -> None:
    drive = DRIVE.model_copy(update={"model": ("coulomb_friction",), "nominal": {**PAPER_MOTOR, "J_m": 0.005}})
    spec = training_spec(drive, rate_hz=500.0, channels=("velocity_rad_s", "current_A", "voltage_V", "torque_Nm"))
    assert spec.effects == ("coulomb_friction",)
    assert dict(spec.nominal) == PAPER_MOTOR
    assert spec.channels == ("voltage_V", "current_A", "velocity_rad_s")
    assert spec.window_s == 2.0
    assert dataclasses.replace(SPEC) == training_spec(DRIVE, rate_hz=500.0)
    with pytest.raises(ConfigError, match=r"nominal L, J missing"):
        training_spec(DRIVE.model_copy(update={"nominal": {"R": 1.0, "K": 1.0, "B": 1.0}}))


def test_the_daemon_trains_as_many_motors_as_the_command() -> None:
    from servo_daemon.config import parse_config

    assert parse_config({}).learning.motors == DEFAULT_MOTORS
    assert json.loads(parse_config({}).learning.model_dump_json())["train"] is True
