"""Diagnoses in the daemon: begun by request or by the mismatch watch, in a process of their own, with what comes of it.

The program that is called is `tests/fake_diagnose.py`; a gate file holds it back where the order matters.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servo_daemon.captures import read_capture
from servo_daemon.config import Config, load_config, parse_config
from servo_daemon.daemon.diagnosis import low_priority
from servo_daemon.daemon.diagnosis import runner as diagnosis_runner
from servo_daemon.daemon.diagnosis.files import CAPTURE, DRIVE, drive_toml, start_values
from servo_daemon.errors import BusyError, RefusedError
from servo_daemon.published.diagnosis_state import DiagnosisView
from servo_daemon.published.metrics import render_metrics
from servo_daemon.samples import concatenate
from servo_daemon.simulate import DEFAULT_NOMINAL
from tests.daemon_rig import PATIENCE_S, Rig, configuration, starter
from tests.fake_diagnose import REPORT, document

FAKE = Path(__file__).resolve().parents[2] / "fake_diagnose.py"
FRICTION = ("coulomb_friction",)
Start = Callable[..., Rig]


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch) -> Iterator[Start]:
    with starter(monkeypatch) as begin:
        yield begin


def configured(
    what: str,
    *gate: Path,
    names: tuple[str, ...] = ("axis1",),
    limit_s: float = 60.0,
    nice: int = 0,
    **estimation: Any,
) -> Config:
    """Drives with a ring of 4 s; diagnosed by request only, unless told otherwise."""
    settings = {"ring_s": 4.0, "diagnose": "on_request", **estimation}
    config = configuration(*names, estimation=settings)
    command = [sys.executable, str(FAKE), what, *map(str, gate), "--"]
    diagnosis = parse_config({"diagnosis": {"command": command, "time_limit_s": limit_s, "nice": nice}}).diagnosis
    return config.model_copy(update={"diagnosis": diagnosis})


def filled(rig: Rig, name: str = "axis1", n: int = 6000) -> Rig:
    rig.driver(name).feed(n)
    rig.until_samples(n, name)
    return rig


def view(rig: Rig, name: str = "axis1") -> DiagnosisView:
    return rig.runtime(name).diagnosis


def diagnosed(rig: Rig, name: str = "axis1") -> Rig:
    rig.runtime(name).request_diagnosis()
    rig.until(lambda: view(rig, name).diagnosis.status in ("done", "failed"), "the verdict")
    return rig


def test_a_request_is_answered_while_the_samples_flow(start: Start, tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    rig = filled(start(configured("found", gate)))
    assert view(rig).diagnosis.status == "idle" and view(rig).allowed
    rig.runtime().request_diagnosis()
    rig.until(lambda: (view(rig).diagnosis.progress or 0) >= 0.5, "half way")
    now = view(rig)
    assert now.diagnosis.status == "running" and now.diagnosis.step == "round 1: fitting coulomb_friction"
    assert now.diagnosis.trigger == "request" and now.diagnosis.model == ()
    assert 3900 <= now.diagnosis.samples <= 4001 and now.diagnosis.span_s == pytest.approx(4.0, abs=0.1)
    assert not now.allowed and "running" in str(now.reason) and not now.adoption.allowed
    with pytest.raises(BusyError):
        rig.runtime().request_diagnosis()
    rig.driver().feed(3000)
    rig.until_samples(9000)
    assert rig.snapshot().counters["samples_lost"] == 0 and rig.statuses() == {"tracking"}
    gate.touch()
    rig.until(lambda: view(rig).diagnosis.status == "done", "the verdict")
    done = view(rig).diagnosis
    assert done.verdict == "found" and done.effects == FRICTION and done.progress == 1.0 and done.reason is None
    assert done.report is not None and done.report.read_text() == REPORT
    assert done.started is not None and done.finished is not None and done.finished >= done.started
    assert view(rig).counts == {"found": 1} and view(rig).allowed
    kinds = rig.kinds()
    assert kinds[-2:] == ["diagnosis_started", "diagnosis_done"]
    event = rig.daemon.drives["axis1"].events()[-1]
    assert event.data == {"verdict": "found", "effects": "coulomb_friction", "error_removed": 0.93}
    assert "coulomb_friction" in event.message and "93 %" in event.message


def test_what_was_found_is_adopted_on_request_with_its_values(start: Start) -> None:
    rig = diagnosed(filled(start(configured("found"))))
    adoption = view(rig).adoption
    assert adoption.allowed and adoption.effects == FRICTION
    future = rig.runtime().request_model(FRICTION, {})
    rig.until(lambda: future.done() or not rig.driver().feed(100), "the model is exchanged")
    Tc = {p.name: p for p in rig.snapshot().estimate.parameters}["Tc"]  # type: ignore[union-attr]
    assert Tc.nominal == 0.02, "where the diagnosis found it"
    assert not view(rig).adoption.allowed and "has this model" in str(view(rig).adoption.reason)


def test_auto_adopts_by_itself_and_says_so(start: Start) -> None:
    rig = diagnosed(filled(start(configured("found", adopt="auto"))))
    rig.until(lambda: rig.runtime().model == FRICTION or not rig.driver().feed(100), "the model is exchanged")
    assert [k for k in rig.kinds() if "diagnosis" in k or "model" in k] == [
        "diagnosis_started", "diagnosis_done", "diagnosis_adopted", "model_changed",
    ]  # fmt: skip


@pytest.mark.parametrize("what", ["none", "unexplained"])
def test_nothing_found_is_nothing_to_adopt(start: Start, what: str) -> None:
    rig = diagnosed(filled(start(configured(what, adopt="auto"))))
    assert view(rig).diagnosis.verdict == what and view(rig).counts == {what: 1}
    assert view(rig).adoption.effects is None and not view(rig).adoption.allowed
    assert rig.runtime().model == () and rig.kinds()[-1] == "diagnosis_done"
    if what == "unexplained":
        assert "it follows speed" in rig.daemon.drives["axis1"].events()[-1].message


def test_never_is_never(start: Start) -> None:
    rig = diagnosed(filled(start(configured("found", adopt="never"))))
    assert not view(rig).adoption.allowed and "never" in str(view(rig).adoption.reason)
    rig = filled(start(configured("found", diagnose="never")))
    with pytest.raises(RefusedError, match="never"):
        rig.runtime().request_diagnosis()
    assert not view(rig).allowed and "never" in str(view(rig).reason)
    with pytest.raises(RefusedError, match="ring_s"):
        start(configured("found", ring_s=0.0)).runtime().request_diagnosis()


def test_too_few_samples_are_told(start: Start) -> None:
    rig = filled(start(configured("found")), n=1000)
    with pytest.raises(BusyError, match=r"0.9 s of samples are there, 3.6 s are needed|1.0 s"):
        rig.runtime().request_diagnosis()


@pytest.mark.parametrize(
    ("what", "reason"),
    [
        ("fail", "exit code 1: error: nothing moves in this recording"),
        ("empty", "no usable diagnosis.json"),
        ("garbage", "no usable diagnosis.json"),
        ("nonsense", "no usable diagnosis.json: verdict 'nonsense'"),
    ],
)
def test_a_failure_says_why_and_is_not_the_end(start: Start, what: str, reason: str) -> None:
    rig = diagnosed(filled(start(configured(what))))
    now = view(rig)
    assert now.diagnosis.status == "failed" and reason in str(now.diagnosis.reason)
    assert now.diagnosis.result is None and now.counts == {"failed": 1} and now.allowed
    assert rig.kinds()[-1] == "diagnosis_failed"
    diagnosed(rig)
    assert view(rig).counts == {"failed": 2}


def test_a_program_that_is_not_there(start: Start) -> None:
    config = configured("found")
    gone = config.diagnosis.model_copy(update={"command": ("/nowhere/diagnose",)})
    rig = diagnosed(filled(start(config.model_copy(update={"diagnosis": gone}))))
    assert "/nowhere/diagnose: cannot be started" in str(view(rig).diagnosis.reason)


def wait_for(condition: Callable[[], object], what: str) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.01)


def alive(marker: Path) -> bool:
    """Whether a process works on a file in there."""
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if str(marker).encode() in (entry / "cmdline").read_bytes():
                return True
        except OSError:
            continue
    return False


def test_the_time_limit_ends_it(start: Start, tmp_path: Path) -> None:
    rig = filled(start(configured("hang", limit_s=1.0), state=tmp_path))
    diagnosed(rig)
    assert "time limit of 1 s" in str(view(rig).diagnosis.reason)
    assert not alive(tmp_path) and not list((tmp_path / "diagnosis" / "axis1").iterdir())


def test_an_unfinished_one_is_told_and_the_next_request_goes_on_with_its_recording(
    start: Start, tmp_path: Path
) -> None:
    rig = filled(start(configured("short"), state=tmp_path))
    folder = tmp_path / "diagnosis" / "axis1"
    diagnosed(rig)
    first = view(rig).diagnosis
    assert first.status == "done" and first.unfinished
    recorded = (folder / "unfinished" / "capture.csv").read_bytes()
    filled(rig, n=3000)
    diagnosed(rig)
    second = view(rig).diagnosis
    assert not second.unfinished, "the journal was handed over"
    assert (second.samples, second.span_s) == (first.samples, first.span_s)
    assert recorded and not (folder / "unfinished").exists()
    assert any("not finished" in e.message for e in rig.runtime().events())


def test_it_does_not_outlive_the_daemon(start: Start, tmp_path: Path) -> None:
    rig = filled(start(configured("hang"), state=tmp_path))
    rig.runtime().request_diagnosis()
    rig.until(lambda: (view(rig).diagnosis.progress or 0) >= 0.5, "it hangs")
    assert alive(tmp_path)
    rig.daemon.stop()
    assert not alive(tmp_path)
    with pytest.raises(BusyError):
        rig.runtime().request_diagnosis()


def test_one_at_a_time_in_the_whole_daemon(start: Start, tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    rig = start(configured("none", gate, names=("one", "two")))
    for name in ("one", "two"):
        filled(rig, name)
    rig.runtime("one").request_diagnosis()
    with pytest.raises(BusyError, match="drive one is running"):
        rig.runtime("two").request_diagnosis()
    assert view(rig, "two").diagnosis.status == "idle"
    gate.touch()
    rig.until(lambda: view(rig, "two").allowed, "the first is done")
    diagnosed(rig, "two")
    assert view(rig, "two").diagnosis.verdict == "none"


def test_the_mismatch_watch_begins_one_and_does_not_repeat_itself(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = start(configured("found", diagnose="on_mismatch"))
    pipeline_of = rig.runtime()._estimation.diagnoses.watch

    def unexplained(estimate: Any) -> None:
        estimate.health["innovation_white"] = False
        pipeline_of(estimate)

    monkeypatch.setattr(rig.runtime()._estimation.diagnoses, "watch", unexplained)
    for k in range(1, 70):
        rig.driver().feed(100)
        rig.until_samples(100 * k)
    rig.until(lambda: view(rig).diagnosis.status == "done", "begun by itself, and done")
    assert view(rig).diagnosis.trigger == "mismatch"
    for k in range(70, 140):
        rig.driver().feed(100)
        rig.until_samples(100 * k)
    assert view(rig).counts == {"found": 1} and rig.kinds().count("diagnosis_started") == 1


def test_the_last_result_survives_a_restart_of_the_daemon(start: Start, tmp_path: Path) -> None:
    first = diagnosed(filled(start(configured("found"), state=tmp_path)))
    before = view(first).diagnosis
    first.daemon.stop()
    folder = tmp_path / "diagnosis" / "axis1"
    assert sorted(p.name for p in folder.iterdir()) == ["diagnosis.json", "record.json", "report.html"]
    again = start(configured("found"), state=tmp_path)
    assert view(again).diagnosis == before
    assert view(again).adoption.allowed, "it can still be adopted"
    again.daemon.stop()
    (folder / "record.json").write_text("{")
    assert view(start(configured("found"), state=tmp_path)).diagnosis.status == "idle"


def test_the_drive_is_handed_over_as_it_is_now(start: Start, tmp_path: Path) -> None:
    """Its present model, its published parameters in the place of the datasheet's, its recording with its metadata."""
    rig = filled(start(configured("none", tmp_path / "gate"), state=tmp_path))
    rig.runtime().request_diagnosis()
    rig.until(lambda: (view(rig).diagnosis.progress or 0) >= 0.5, "half way")
    (scratch,) = (tmp_path / "diagnosis" / "axis1").glob("run-*")
    (drive,) = tomllib.loads((scratch / DRIVE).read_text())["drive"]
    assert load_config(scratch / DRIVE, {}).drive_named("axis1").nominal == drive["nominal"]
    capture = read_capture(scratch / CAPTURE)
    (tmp_path / "gate").touch()
    rig.until(lambda: view(rig).diagnosis.status == "done" and not scratch.exists(), "done and cleaned up")
    assert drive["name"] == "axis1" and drive["model"] == []
    estimate = rig.snapshot().estimate
    assert estimate is not None
    for p in estimate.parameters:
        if p.name != "J_d":
            assert drive["nominal"][p.name] == pytest.approx(p.value, rel=0.01)
    assert drive["nominal"]["J_m"] == DEFAULT_NOMINAL["J_m"] and "J_d" not in drive["nominal"]
    assert capture.channels == ("voltage_V", "current_A", "position_rad")
    kept = concatenate(rig.runtime().ring.blocks())
    assert np.array_equal(capture.time_s, kept.time_s) and np.array_equal(capture.current_A, kept.current_A)
    assert capture.metadata["drive"] == "axis1" and capture.metadata["identity"]
    assert float(capture.metadata["counts_per_rev"]) == 8192.0


def test_any_drive_fits_into_toml() -> None:
    config = configuration(
        load={"mass_kg": 0.5, "counts_per_rev": 4096},
        limits={"voltage_V": 24, "R_max": "+30 %"},
        model=["cogging_torque", "measurement_delay"],
        nominal={"R": 1e-4, "n_cog": 7.0, "channel": "position_rad", "phi_cog": -1.5},
    ).drive[0]
    back = parse_config(tomllib.loads(drive_toml(config, None))).drive[0]
    assert (back.name, back.model, back.nominal, back.load, back.limits) == (
        config.name, config.model, config.nominal, config.load, config.limits,
    )  # fmt: skip


def test_start_values_are_what_a_model_can_begin_with() -> None:
    found = document("found", 0.02)
    found["extended"]["parameters"] = {
        "R": {"value": 1.0, "std": 0.01, "unit": "Ω"},
        "K": {"value": None, "std": 0.01},
        "B": {"value": -1.0, "std": 0.01},
        "J": {"value": 0.01, "std": None},
        "Ts": {"value": 1.0, "std": 0.1},
        "L": 3.0,
    }
    assert start_values(found, FRICTION) == {
        "R": (1.0, 0.01), "J": (0.01, None), "Tc": (0.02, 0.0002), "L": (3.0, None),
    }  # fmt: skip


def test_metrics(start: Start) -> None:
    rig = diagnosed(filled(start(configured("found"))))
    text = render_metrics(rig.daemon)
    for line in (
        'servo_daemon_diagnosis_status{drive="axis1",status="done"} 1',
        'servo_daemon_diagnosis_status{drive="axis1",status="running"} 0',
        'servo_daemon_diagnoses_total{drive="axis1",verdict="found"} 1',
        'servo_daemon_diagnoses_total{drive="axis1",verdict="failed"} 0',
        'servo_daemon_diagnosis_found{drive="axis1",effect="coulomb_friction"} 1',
        'servo_daemon_model_info{drive="axis1",model=""} 1',
    ):
        assert line in text.splitlines()


def test_the_child_runs_at_low_priority(start: Start, tmp_path: Path) -> None:
    rig = filled(start(configured("hang", nice=15), state=tmp_path))
    rig.runtime().request_diagnosis()
    rig.until(lambda: (view(rig).diagnosis.progress or 0) >= 0.5, "it hangs")
    process = rig.daemon._diagnoses._process
    assert process is not None
    assert os.getpriority(os.PRIO_PROCESS, process.pid) == min(19, os.getpriority(os.PRIO_PROCESS, 0) + 15)
    assert os.getpgid(process.pid) == process.pid and os.getsid(process.pid) == os.getsid(0)


def test_the_child_dies_with_a_daemon_that_is_killed(tmp_path: Path) -> None:
    """SIGKILL: nobody is left to end it."""
    started = tmp_path / "started"
    child = f"import pathlib, time; pathlib.Path({str(started)!r}).touch(); time.sleep(60)"
    parent = (
        "import os, subprocess, sys, time\n"
        f"subprocess.Popen([sys.executable, {low_priority.__file__!r}, str(os.getpid()), '5', sys.executable, '-c', "
        f"{child!r}], process_group=0)\n"
        "time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", parent]) as process:
        wait_for(lambda: started.exists() and alive(started), "the child runs")
        process.kill()
        process.wait()
    wait_for(lambda: not alive(started), "the child is gone")


def test_a_child_whose_parent_is_gone_already_does_not_begin(tmp_path: Path) -> None:
    touched = tmp_path / "touched"
    program = [sys.executable, "-c", f"open({str(touched)!r}, 'w')"]
    done = subprocess.run([sys.executable, low_priority.__file__, "1", "0", *program], check=False)  # 1: not our parent
    assert done.returncode == 1 and not touched.exists()


def test_progress_lines_that_are_none() -> None:
    read = diagnosis_runner._progress
    assert read(json.dumps({"progress": 0.35, "step": "fit"})) == (0.35, "fit")
    assert read(json.dumps({"step": "fit"})) == (None, "fit")
    assert read(json.dumps({"progress": 7, "step": 3})) == (None, "3")
    for line in ("", "fit", "{", "[1]", json.dumps({"a": 1})):
        assert read(line) is None
