"""A voltage that is written some rows away from the other columns is named with the line that mends it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from servo_daemon.captures import read_capture
from servo_daemon.captures.meaning import findings, without_unusable
from servo_daemon.errors import CaptureError
from tests.recovery.generator import BELT_SERVO, PAPER, RE40, Motor
from tests.recovery.generator.sensors import filtered_speed
from tests.recovery.test_meaning import capture, columns, mended, right, write


@pytest.mark.parametrize(
    ("motor", "motion", "rows"), [(PAPER, "steps", 1), (RE40, "prbs", -1), (BELT_SERVO, "multisine", 2)]
)
def test_a_voltage_some_rows_away_is_brought_back(tmp_path: Path, motor: Motor, motion: str, rows: int) -> None:
    of = columns(motor, motion, 500.0, seed=8)
    path = write(tmp_path / "rows.csv", {**of, "voltage_V": np.roll(of["voltage_V"], rows)})
    read = read_capture(path)
    (found,) = findings(read)
    assert f'voltage_V = {{ signal = "voltage_V", rows_late = {rows} }}' in found.text
    assert without_unusable(read, [found]).channels == ("current_A", "position_rad")
    good = mended(path, found.text)
    assert findings(good) == ()
    right(good, motor)


@pytest.mark.parametrize("field", ["position_rad", "velocity_rad_s"])
def test_a_motion_that_answers_a_voltage_to_come(tmp_path: Path, field: str) -> None:
    """Without a current; one that answers late is a late motion, and a control loop's voltage answers the motion."""
    of = columns(RE40, "prbs", 200.0, seed=8)
    late = {**of, "voltage_V": np.roll(of["voltage_V"], 1)}
    read = read_capture(write(tmp_path / "rows.csv", late, "voltage_V", field))
    (found,) = findings(read)
    assert "rows_late = 1" in found.text
    with pytest.raises(CaptureError, match="1 row late"):
        without_unusable(read, [found])
    assert findings(mended(tmp_path / "rows.csv", found.text)) == ()
    assert findings(capture({**of, "voltage_V": np.roll(of["voltage_V"], -1)}, "voltage_V", field)) == ()


def test_a_late_or_filtered_current_is_no_voltage_of_another_row() -> None:
    of = columns(RE40, "multisine", 500.0, seed=8)
    assert findings(capture({**of, "current_A": np.roll(of["current_A"], 1)})) == ()
    for t_f in (0.001, 0.003, 0.01):
        assert findings(capture({**of, "current_A": filtered_speed(of["time_s"], of["current_A"], t_f)})) == (), t_f
