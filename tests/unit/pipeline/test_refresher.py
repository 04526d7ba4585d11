"""The learned model inside the pipeline: published as `grnn`, the same however samples arrive, its own drive only."""

from __future__ import annotations

import csv
import dataclasses
import json
from pathlib import Path

import pytest

from servo_daemon.captures import write_capture
from servo_daemon.cli import main
from servo_daemon.commands.replay.estimates_csv import EstimatesWriter
from servo_daemon.config import DriveConfig, EstimationConfig
from servo_daemon.errors import ConfigError
from servo_daemon.learning import DEFAULT_MOTORS
from servo_daemon.learning.examples.drawing import CORE
from servo_daemon.learning.model.model import LearnedModel, Predictions
from servo_daemon.learning.model.model_file import save_model
from servo_daemon.pipeline.model_change import ModelRequest
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.pipeline.refresher import Refresher
from servo_daemon.pipeline.training_spec import training_spec
from servo_daemon.published.snapshot import Estimate
from servo_daemon.samples import F64, SampleBlock
from servo_daemon.simulate import PAPER_MOTOR, SimulatedDrive, make_settings
from tests.learned_models import SPEC, Once, small_model

DRIVE = DriveConfig(nominal=dict(PAPER_MOTOR), estimation=EstimationConfig(refresh_every_s=2.0, refresh_window_s=2.0))


@pytest.fixture(scope="module")
def model(once: Once) -> LearnedModel:
    return small_model(once)


@pytest.fixture(scope="module")
def recording() -> SampleBlock:
    return SimulatedDrive(make_settings(rate_hz=500.0)).next_block(6000)


def run(model: LearnedModel | None, block: SampleBlock, size: int, drive: DriveConfig = DRIVE) -> list[Estimate]:
    pipeline, out = Pipeline(drive), []
    pipeline.use_learned(model)
    for k in range(0, len(block), size):
        out += pipeline.process(block.slice(k, min(k + size, len(block))))
    return out


@pytest.fixture(scope="module")
def estimates(model: LearnedModel, recording: SampleBlock) -> list[Estimate]:
    return run(model, recording, 500)


def test_the_same_however_samples_arrive(
    model: LearnedModel, recording: SampleBlock, estimates: list[Estimate]
) -> None:
    assert run(model, recording, 37) == estimates


def test_what_is_published(estimates: list[Estimate]) -> None:
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


def test_a_filter_that_is_well_is_as_it_would_be_without(recording: SampleBlock, estimates: list[Estimate]) -> None:
    with_it, without = estimates[-1], run(None, recording, 500)[-1]
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
    from servo_daemon.tracking.plan.settings import Resolutions, TrackerSettings
    from servo_daemon.tracking.plant_tracker import make_tracker

    tracker = make_tracker(recording.channels, TrackerSettings((), dict(PAPER_MOTOR), {}, "compiled"), Resolutions())
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


@pytest.fixture(scope="module")
def rubbing() -> SampleBlock:
    """Of a motor with dry friction."""
    friction = {"coulomb_friction": {"Tc": 0.08 * PAPER_MOTOR["K"] * 15.0}}
    return SimulatedDrive(make_settings(rate_hz=500.0, effects=friction)).next_block(9000)


class _SureOfJ(LearnedModel):
    """J is known to 10 %: what a model of so few motors claims itself hangs on the last bit of its training."""

    def predict(self, features: F64) -> Predictions:
        found = super().predict(features)
        std = found.std.copy()
        std[:, CORE.index("J")] = 0.1 * found.value[:, CORE.index("J")]
        return dataclasses.replace(found, std=std)


def test_what_the_filter_lacks_is_published_as_the_windows_have_it(model: LearnedModel, rubbing: SampleBlock) -> None:
    """A filter without friction, wrong nominal values: never back to these, and R and K are not given up."""
    model = _SureOfJ(**{f.name: getattr(model, f.name) for f in dataclasses.fields(model)})
    nominal = {n: 1.3 * v for n, v in PAPER_MOTOR.items()}
    config = DriveConfig(nominal=nominal, estimation=DRIVE.estimation)
    pipeline = Pipeline(config)
    pipeline.use_learned(model)
    estimates = pipeline.process(rubbing)
    first = next(e.time_s for e in estimates if e.estimators["grnn"].detail["mode"] == "trusted")
    assert first < 9.0
    widths = []
    for e in (e for e in estimates if e.time_s > first):
        shown = {p.name: p for p in e.parameters}
        value, std = shown["J"].value, shown["J"].std
        assert value is not None
        assert std is not None
        assert abs(value - PAPER_MOTOR["J"]) < min(0.1 * PAPER_MOTOR["J"], 3 * std), e.time_s
        assert "RF+GRNN" in (shown["J"].reason or ""), e.time_s
        widths.append(std / value)
        for name in ("R", "K"):  # the filter's, except where a window knows it still better
            value, std, truth = shown[name].value, shown[name].std, PAPER_MOTOR[name]
            assert shown[name].status == "tracking" and value is not None and std is not None, e.time_s
            assert std < 0.03 * truth and abs(value - truth) < max(0.01 * truth, 2 * std), e.time_s
    assert 0.05 < max(widths) < 0.15  # wider than what a filter may begin with, no wider than what it may keep


def test_windows_of_before_a_jump_do_not_count(model: LearnedModel, recording: SampleBlock) -> None:
    from servo_daemon.tracking.plan.settings import Resolutions, TrackerSettings
    from servo_daemon.tracking.plant_tracker import make_tracker
    from servo_daemon.tracking.validity.fusion import Fused

    tracker = make_tracker(recording.channels, TrackerSettings((), dict(PAPER_MOTOR), {}, "compiled"), Resolutions())
    refresher, unknown = Refresher(model, CORE, 2.0), Fused(1.0, None, "estimating", "known to ± 20 % so far")
    jump_s, shown = 7.0, []
    for k in range(0, len(recording), 50):
        tick = recording.slice(k, k + 50)
        tracker.take(tick)
        tracker.close_tick(tick)
        now_s = float(tick.time_s[-1])
        told = [("parameter_jump", "", {"time_s": jump_s})] if jump_s + 0.3 <= now_s < jump_s + 0.4 else []
        refresher.take(tick, tracker, told)
        shown.append((now_s, refresher.instead_of("L", unknown, now_s) is not unknown))
    assert all(learned for now_s, learned in shown if 6.7 < now_s < jump_s + 0.3)
    assert not any(learned for now_s, learned in shown if jump_s + 0.4 < now_s < jump_s + 2.0)
    assert shown[-1][1]


def test_while_a_jump_is_examined_only_what_the_filter_followed_stands(
    model: LearnedModel, recording: SampleBlock, monkeypatch: pytest.MonkeyPatch
) -> None:
    from servo_daemon.tracking.plan.settings import Resolutions, TrackerSettings
    from servo_daemon.tracking.plant_tracker import PlantTracker, make_tracker
    from servo_daemon.tracking.validity.fusion import Fused

    tracker = make_tracker(recording.channels, TrackerSettings((), dict(PAPER_MOTOR), {}, "compiled"), Resolutions())
    refresher = Refresher(model, CORE, 2.0)
    opened = Fused(PAPER_MOTOR["L"], 0.13 * PAPER_MOTOR["L"], "tracking", None)
    held = dataclasses.replace(opened, status="unexcited")
    for k in range(0, 3500, 50):
        tick = recording.slice(k, k + 50)
        tracker.take(tick)
        tracker.close_tick(tick)
        refresher.take(tick, tracker)
    now_s = float(tick.time_s[-1])
    assert refresher.instead_of("L", opened, now_s) is not opened
    monkeypatch.setattr(PlantTracker, "examines_jump", True)
    refresher.take(recording.slice(3500, 3550), tracker)
    assert refresher.instead_of("L", opened, now_s) is opened
    assert refresher.instead_of("L", held, now_s) is not held


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
