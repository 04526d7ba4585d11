"""Knowledge over a restart of the program: the next run tracks at once, and no file can keep it from starting."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import pytest

from servo_daemon.simulate import PAPER_MOTOR
from tests.system.harness import all_tracking, assert_close, daemon, nominal_table, statuses, write_config


def config(tmp_path: Path, seed: int = 1, model: str = "", speed: float = 1.0) -> Path:
    drive = f"model = [{model}]\n{nominal_table()}[drive.options]\nspeed = {speed}"
    return write_config(tmp_path / "c.toml", f"{drive}\nseed = {seed}", head="[storage]\nsave_interval_s = 0.2\n")


@pytest.mark.slow
def test_the_next_run_starts_from_what_the_last_one_knew(tmp_path: Path) -> None:
    """Power just disappears (SIGKILL), then another motor is attached, then a model with more in it."""
    state, file = tmp_path / "state", tmp_path / "state" / "axis1.state.json"
    with daemon("--config", config(tmp_path), "--state-dir", state) as program:
        program.until(all_tracking, "tracks")
        program.until(lambda d: file.exists(), "saved while it runs")
        program.send(signal.SIGKILL)
        program.wait()
    saved = json.loads(file.read_text())
    assert saved["schema"] == 1 and saved["names"] == list(PAPER_MOTOR)

    unhurried = config(tmp_path, speed=0.2)  # so that even a slow machine looks before a second of samples is there
    with daemon("--config", unhurried, "--state-dir", state) as program:
        first = program.until(lambda d: statuses(d) != {"estimating"}, "the first estimates")
        assert first["samples"] < 1000, "sooner than a regression could have found anything"
        assert_close(program.until(all_tracking, "tracks"), PAPER_MOTOR)
        assert program.foreground_events() == ["connected", "state_restored", "filter_started"]
        assert program.said("estimates of the last run restored") == 1
        assert program.said("filter started from the saved state") == 1
        program.stop()

    kept = file.read_bytes()
    for seed, model in ((2, ""), (1, '"coulomb_friction"')):
        slow = config(tmp_path, seed, model, speed=0.1)  # so that nothing new is known before this test has looked
        with daemon("--config", slow, "--state-dir", state) as program:
            program.until(lambda d: d["samples"] > 100, "samples came")
            assert program.said("of another device or model") == 1
            assert "state_restored" not in program.events()
            assert statuses(program.estimates()) == {"estimating"}
            assert file.read_bytes() == kept, "nothing is written before something is known"


def test_a_damaged_file_is_set_aside_and_said_once(tmp_path: Path) -> None:
    state = tmp_path / "state"
    state.mkdir()
    (state / "axis1.state.json").write_text('{"schema": 1, "identity": "simu')
    with daemon("--config", config(tmp_path), "--state-dir", state) as program:
        program.until(all_tracking, "tracks as on its first day")
        assert program.said("axis1.state.json is unusable") == 1
        assert (state / "axis1.state.bad").read_text().endswith("simu")
        program.until(lambda d: (state / "axis1.state.json").exists(), "a new one is written")
        assert program.get("/health")["status"] == "ok"


def test_nothing_is_kept_of_the_motor_of_the_demonstration(tmp_path: Path) -> None:
    environment = dict(os.environ, HOME=str(tmp_path), PYTHONUNBUFFERED="1")
    environment.pop("XDG_STATE_HOME", None)
    environment.setdefault("XDG_CACHE_HOME", str(Path.home() / ".cache"))  # compiled code may stay where it is
    with daemon(env=environment) as program:
        program.until(all_tracking, "tracks")
        program.stop()
    assert not list(tmp_path.rglob("*.state.*"))
