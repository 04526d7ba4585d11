"""State kept over a restart: used only where it fits, replaced atomically, and never fatal."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servo_daemon.config import DriveConfig
from servo_daemon.daemon.persist import SCHEMA_VERSION, StateFile
from servo_daemon.daemon.state_keeper import StateKeeper
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.pipeline.publish import Adopted, SavedState
from servo_daemon.simulate import DEFAULT_NOMINAL, PAPER_MOTOR, SimulatedDrive, make_settings

NAMES = ("R", "L", "K", "J", "B")
CONFIG = DriveConfig(name="axis1", driver="sim")
STATE = SavedState(
    (),
    NAMES,
    tuple(math.log(PAPER_MOTOR[name]) for name in NAMES),
    tuple(tuple(float(v) for v in row) for row in np.diag([1e-3, 2e-3, 1e-3, 1e-3, 3e-3])),
)


@pytest.fixture
def file(tmp_path: Path) -> StateFile:
    return StateFile(tmp_path, "axis1")


def path(tmp_path: Path) -> Path:
    return tmp_path / "axis1.state.json"


def test_what_was_saved_comes_back_exactly(file: StateFile, tmp_path: Path) -> None:
    assert file.load("motor", ()) is None
    assert file.save("motor", STATE)
    assert file.load("motor", ()) == STATE
    assert StateFile(tmp_path, "axis2").load("motor", ()) is None
    assert [p.name for p in tmp_path.iterdir()] == ["axis1.state.json"], "no temporary file is left"


def test_a_directory_is_made_and_an_older_file_replaced(tmp_path: Path) -> None:
    file = StateFile(tmp_path / "a" / "b", "axis1")
    assert file.save("motor", STATE)
    newer = replace(STATE, mean=tuple(m + 0.1 for m in STATE.mean))
    assert file.save("motor", newer)
    assert file.load("motor", ()) == newer


def test_another_device_or_model_does_not_get_it(
    file: StateFile, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    file.save("motor", STATE)
    assert file.load("other motor", ()) is None
    assert file.load("motor", ("coulomb_friction",)) is None
    assert caplog.text.count("of another device or model") == 2
    assert path(tmp_path).exists(), "it may be plugged in again"
    assert file.load("motor", ()) == STATE


def test_without_a_directory_nothing_is_kept_and_nothing_is_wrong(caplog: pytest.LogCaptureFixture) -> None:
    file = StateFile(None, "axis1")
    assert file.save("motor", STATE)
    assert file.load("motor", ()) is None
    file.forget()
    assert not caplog.records


def _changed(**changes: Any) -> Callable[[dict[str, Any]], Any]:
    return lambda data: data | changes


def _without(key: str) -> Callable[[dict[str, Any]], Any]:
    return lambda data: {k: v for k, v in data.items() if k != key}


ALMOST = [
    _changed(schema=SCHEMA_VERSION + 1),
    _changed(schema=None),
    *[_without(key) for key in ("schema", "identity", "model", "names", "mean", "covariance")],
    _changed(names=[]),
    _changed(names=["R", "R", "K", "J", "B"]),
    _changed(names=["R", "L", "K", "J", "Q"]),
    _changed(names=5),
    _changed(model=None),
    _changed(mean=[0.0]),
    _changed(mean="abc"),
    _changed(mean=[None] * 5),
    _changed(mean=[math.nan] * 5),
    _changed(mean=[math.inf, 0, 0, 0, 0]),
    _changed(mean=[10**400, 0, 0, 0, 0]),
    _changed(mean=[100.0, -6, -1, -4, -0.7]),  # R of e^100 Ω
    _changed(covariance=[]),
    _changed(covariance=[[math.nan] * 5] * 5),
    _changed(covariance=(-np.eye(5)).tolist()),
    _changed(covariance=np.triu(np.ones((5, 5))).tolist()),
    _changed(covariance=(100 * np.eye(5)).tolist()),
    lambda data: [data],
    lambda data: None,
    lambda data: "state",
]


@pytest.mark.parametrize("damage", ALMOST, ids=range(len(ALMOST)))
def test_a_file_that_makes_no_sense_is_set_aside(
    file: StateFile, tmp_path: Path, caplog: pytest.LogCaptureFixture, damage: Callable[[Any], Any]
) -> None:
    file.save("motor", STATE)
    data = damage(json.loads(path(tmp_path).read_text()))
    path(tmp_path).write_text(json.dumps(data))
    assert file.load("motor", ()) is None
    assert not path(tmp_path).exists()
    assert (tmp_path / "axis1.state.bad").exists()
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert "is unusable" in record.message and "set aside as axis1.state.bad" in record.message
    assert file.load("motor", ()) is None and len(caplog.records) == 1, "said once"
    assert file.save("motor", STATE) and file.load("motor", ()) == STATE, "and the next one is written as ever"


@pytest.mark.parametrize(
    "content", [b"", b"{", b"\xff\xfe\x00", b"[" * 100_000, b"nul"], ids=["empty", "half", "binary", "deep", "word"]
)
def test_a_file_that_is_no_json_is_set_aside(
    file: StateFile, tmp_path: Path, caplog: pytest.LogCaptureFixture, content: bytes
) -> None:
    path(tmp_path).write_bytes(content)
    assert file.load("motor", ()) is None
    assert (tmp_path / "axis1.state.bad").read_bytes() == content
    assert len(caplog.records) == 1


def test_a_file_cut_anywhere_is_set_aside_or_whole(tmp_path: Path) -> None:
    """Not that the atomic replacement could leave one, but a disk can."""
    file = StateFile(tmp_path, "axis1")
    file.save("motor", STATE)
    whole = path(tmp_path).read_bytes()
    for n in range(0, len(whole) - 1, 7):
        path(tmp_path).write_bytes(whole[:n])
        assert file.load("motor", ()) is None, n


@given(st.recursive(st.none() | st.booleans() | st.floats() | st.text(max_size=5),
                    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(
                        st.sampled_from(["schema", "identity", "model", "names", "mean", "covariance"]), inner),
                    max_leaves=12))  # fmt: skip
@settings(max_examples=150, deadline=None, derandomize=True)
def test_any_json_is_survived(tmp_path_factory: pytest.TempPathFactory, data: Any) -> None:
    folder = tmp_path_factory.mktemp("state")
    path(folder).write_text(json.dumps(data))
    assert StateFile(folder, "axis1").load("motor", ()) is None


def test_a_place_that_cannot_be_written_is_said_once_until_it_works(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    blocked = tmp_path / "blocked"
    blocked.write_text("a file where the directory should be")
    file = StateFile(blocked / "state", "axis1")
    assert file.load("motor", ()) is None
    assert [file.save("motor", STATE) for _ in range(3)] == [False] * 3
    assert [r.message.split(": ")[1] for r in caplog.records] == ["state cannot be kept"]
    blocked.unlink()
    assert file.save("motor", STATE), "as soon as it can be"
    blocked_again = tmp_path / "blocked" / "state"
    for entry in blocked_again.iterdir():
        entry.unlink()
    blocked_again.rmdir()
    blocked_again.write_text("")
    assert not file.save("motor", STATE)
    assert len(caplog.records) == 2, "a new trouble is said again"


def test_what_a_full_disk_refused_is_written_when_there_is_room(tmp_path: Path) -> None:
    """Also where nothing newer comes: after a restart of the drive nothing is known that is worth keeping."""
    (tmp_path / "blocked").touch()  # where the folder should be
    keeper = StateKeeper(tmp_path / "blocked", CONFIG)
    keeper.offer("motor", STATE, CONFIG)
    keeper.write()
    keeper.offer("motor", None, CONFIG)
    assert keeper.unwritable
    (tmp_path / "blocked").unlink()
    keeper.write()
    assert not keeper.unwritable and keeper.load("motor") == STATE


def test_a_reset_leaves_nothing_to_be_written(tmp_path: Path) -> None:
    (tmp_path / "blocked").touch()
    keeper = StateKeeper(tmp_path / "blocked", CONFIG)
    keeper.offer("motor", STATE, CONFIG)
    keeper.write()
    (tmp_path / "blocked").unlink()
    keeper.forget()
    keeper.write()
    assert not keeper.unwritable and keeper.load("motor") is None


def test_a_write_that_fails_leaves_the_old_file(
    file: StateFile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file.save("motor", STATE)

    def full(_fd: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr("os.fsync", full)
        assert not file.save("motor", replace(STATE, mean=tuple(m + 1 for m in STATE.mean)))
    assert file.load("motor", ()) == STATE
    assert [p.name for p in tmp_path.iterdir()] == ["axis1.state.json"]


def test_forgetting(file: StateFile) -> None:
    file.save("motor", STATE)
    file.forget()
    file.forget()
    assert file.load("motor", ()) is None


# -- what the pipeline makes of it -------------------------------------------------------------------------------


def _learned() -> tuple[SimulatedDrive, Pipeline]:
    drive = SimulatedDrive(make_settings(seed=2))
    pipeline = Pipeline(DriveConfig(nominal=dict(DEFAULT_NOMINAL)), drive.info)
    pipeline.process(drive.next_block(6000))
    return drive, pipeline


def test_a_pipeline_goes_on_from_what_it_knew(file: StateFile) -> None:
    drive, first = _learned()
    saved = first.save()
    assert saved is not None
    file.save(drive.info.identity, saved)
    restored = file.load(drive.info.identity, ())
    assert restored == saved
    second = Pipeline(DriveConfig(nominal=dict(DEFAULT_NOMINAL)), drive.info, restored)
    early = [e for _ in range(5) for e in second.process(drive.next_block(120))]
    assert [m[1] for m in second.messages] == ["filter started from the saved state"]
    last = early[-1]
    for p in last.parameters:
        if p.name in NAMES:
            assert p.value == pytest.approx(PAPER_MOTOR[p.name], rel=0.05), p
            assert p.status == "tracking", p


def test_nothing_is_kept_before_something_is_known() -> None:
    drive = SimulatedDrive(make_settings(seed=2))
    pipeline = Pipeline(DriveConfig(), drive.info)
    assert pipeline.save() is None
    pipeline.process(drive.next_block(300))
    assert pipeline.save() is None


def test_what_is_known_is_kept_while_one_parameter_is_not() -> None:
    """Else a drive whose motion never shows one of them would learn everything anew after every power cut."""
    drive = SimulatedDrive(make_settings(seed=2, motion="speed", dither_rms_V=0.1))  # L shows, R and K only together
    pipeline = Pipeline(DriveConfig(), drive.info)
    pipeline.process(drive.next_block(8000))
    estimate = pipeline.current()
    assert estimate is not None
    known = {p.name for p in estimate.parameters if p.status in ("tracking", "unexcited")}
    saved = pipeline.save()
    assert known < {*NAMES} and saved is not None, "or this motion is no example"
    assert {*saved.names} == known


def test_what_a_state_lacks_is_found_beside_it(file: StateFile) -> None:
    drive, first = _learned()
    whole = first.save()
    assert whole is not None
    keep = [whole.names.index(n) for n in ("R", "K", "J", "B")]
    covariance = tuple(tuple(whole.covariance[j][k] for k in keep) for j in keep)
    part = SavedState((), tuple(whole.names[k] for k in keep), tuple(whole.mean[k] for k in keep), covariance)
    file.save(drive.info.identity, part)
    restored = file.load(drive.info.identity, ())
    assert restored == part
    second = Pipeline(DriveConfig(nominal=dict(DEFAULT_NOMINAL)), drive.info, restored)
    early = second.process(drive.next_block(600))
    assert {p.status for p in early[-1].parameters} == {"estimating"}, "L is waited for"
    late = second.process(drive.next_block(6000))[-1]
    assert [m[1] for m in second.messages] == ["filter started from the saved state"]
    for p in late.parameters:
        if p.name in NAMES:
            assert p.value == pytest.approx(PAPER_MOTOR[p.name], rel=0.05), p
            assert p.status == "tracking", p


def test_a_state_of_other_parameters_does_not_start_a_filter() -> None:
    drive = SimulatedDrive(make_settings(seed=2))
    other = SavedState((), ("R", "Tc"), (0.0, 0.0), ((1e-3, 0.0), (0.0, 1e-3)))
    pipeline = Pipeline(DriveConfig(nominal=dict(DEFAULT_NOMINAL)), drive.info, other)
    pipeline.process(drive.next_block(3000))
    assert [m[1] for m in pipeline.messages] == ["filter started from regression and nominal values"]
    estimate = pipeline.current()
    assert estimate is not None and estimate.is_finite


def test_a_reset_forgets_the_saved_state() -> None:
    drive, first = _learned()
    pipeline = Pipeline(DriveConfig(nominal=dict(DEFAULT_NOMINAL)), drive.info, first.save())
    pipeline.reset()
    pipeline.process(drive.next_block(3000))
    assert [m[1] for m in pipeline.messages] == ["filter started from regression and nominal values"]


ADOPTED = replace(STATE, model=("coulomb_friction",), adopted=Adopted((), {"Tc": 0.0125}))


def test_an_adopted_model_is_used_while_the_configuration_is_as_it_was(file: StateFile) -> None:
    assert file.save("motor", ADOPTED)
    assert file.load("motor", ()) == ADOPTED
    assert file.load("motor", ("gravity_load",)) is None, "the user has changed the model since: his counts"
    assert file.load("motor", ("coulomb_friction",)) == replace(ADOPTED, adopted=None), "he has written it down"
    assert file.load("another", ()) is None


def test_an_adopted_model_is_kept_without_estimates(file: StateFile) -> None:
    alone = SavedState(("coulomb_friction",), (), (), (), Adopted((), {"Tc": 0.0125}))
    assert file.save("motor", alone)
    assert file.load("motor", ()) == alone
    config = DriveConfig(nominal=dict(DEFAULT_NOMINAL))
    assert alone.adopted is not None
    now = alone.adopted.configure(config, alone.model)
    assert now.model == ("coulomb_friction",) and now.nominal == {**DEFAULT_NOMINAL, "Tc": 0.0125}


@pytest.mark.parametrize(
    "damage",
    [
        {"model": ["flux_capacitor"]},
        {"model": ["coulomb_friction", "stribeck_friction"]},
        {"adopted": {"configured": [], "nominal": {"Ts": 1.0}}},
        {"adopted": {"configured": [], "nominal": {"Tc": -1.0}}},
        {"adopted": {"configured": [], "nominal": [1]}},
        {"adopted": {"nominal": {}}},
        {"adopted": None},
    ],
)
def test_an_adopted_model_that_cannot_be_is_set_aside(file: StateFile, tmp_path: Path, damage: dict[str, Any]) -> None:
    file.save("motor", ADOPTED)
    data = json.loads(path(tmp_path).read_text()) | damage
    path(tmp_path).write_text(json.dumps(data))
    assert file.load("motor", ()) is None
    assert path(tmp_path).with_suffix(".bad").exists()
