"""`servo-daemon check` of a capture that is played says of it what `fit` does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from servo_daemon.captures import Capture, read_capture, write_capture
from tests.command_line import run_command


def _turned(capture: Capture) -> Capture:
    assert capture.voltage_V is not None
    return replace(capture, voltage_V=-capture.voltage_V)


def _clipped(capture: Capture) -> Capture:
    assert capture.current_A is not None
    limit = 0.5 * float(np.max(np.abs(capture.current_A)))
    return replace(capture, current_A=np.clip(capture.current_A, -limit, limit))


@pytest.mark.parametrize("change", [_turned, _clipped])
def test_a_played_capture_is_judged_as_fit_judges_it(tmp_path: Path, change: Callable[[Capture], Capture]) -> None:
    good, odd, config = tmp_path / "good.csv", tmp_path / "odd.csv", tmp_path / "c.toml"
    assert run_command("simulate", "--out", good, "--seconds", "4", "--seed", "4").code == 0
    capture = read_capture(good)
    write_capture(odd, change(capture).block())
    remarks = {}
    for path in (good, odd):
        config.write_text(f'[[drive]]\ndriver = "replay"\n[drive.options]\npath = "{path}"\nspeed = 0\n')
        (report,) = run_command("check", "--config", config, "--json").document["drives"]
        remarks[path] = report["remarks"]
    assert remarks[good] == []
    notes = run_command("fit", odd, "--json").document["notes"]
    assert remarks[odd] and {f"{odd}: {text}" for text in remarks[odd]} <= {*notes}
