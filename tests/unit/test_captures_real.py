"""The real captures: all are read, none needs a special case."""

from __future__ import annotations

import gzip
import os
from pathlib import Path

import numpy as np
import pytest

from servo_daemon.captures import read_capture, write_capture

#: As tests/conftest.py resolves it; parametrising by file happens before fixtures exist.
FOLDER = Path(os.environ.get("SERVO_DATA", Path(__file__).resolve().parents[2].parent / "shared" / "data"))
FILES = sorted(FOLDER.glob("*.csv.gz"))

pytestmark = pytest.mark.skipif(not FILES, reason=f"no real captures in {FOLDER} (set SERVO_DATA)")

#: Beginning of the name -> channels, axis, median period s (README of the data).
KNOWN = {
    "emps": (("position_rad", "torque_Nm"), "linear", 1e-3),
    "odrive_slow": (("current_A", "position_rad"), "rotary", 2.28e-3),
    "odrive_spinup": (("current_A", "position_rad"), "rotary", 7.7e-4),
    "unal": (("voltage_V", "velocity_rad_s"), "rotary", 0.02),
    "xl330": (("voltage_V", "position_rad", "temperature_C"), "rotary", 5.3e-3),
}


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.name)
def test_real_capture(path: Path, tmp_path: Path) -> None:
    capture = read_capture(path)
    channels, axis, period_s = next(known for start, known in KNOWN.items() if path.name.startswith(start))
    assert (capture.channels, capture.axis) == (channels, axis)
    assert capture.sample_period_s == pytest.approx(period_s, rel=0.06)
    with gzip.open(path, "rt") as lines:
        rows = sum(1 for line in lines if line[0] not in "#t")
    assert len(capture) == rows
    assert capture.notes == (("unknown column ignored: supply_V",) if path.name.startswith("xl330") else ())
    # GAP_FACTOR's source: late polls of the host-side time stamps, at most two of them in one capture.
    assert np.count_nonzero(capture.quality()) <= (2 if path.name.startswith("odrive") else 0)
    write_capture(tmp_path / "copy.csv", capture.block(), metadata=capture.metadata, axis=capture.axis)
    copy = read_capture(tmp_path / "copy.csv")
    assert copy.metadata == capture.metadata
    for name in ("time_s", *capture.channels):
        np.testing.assert_array_equal(getattr(copy, name), getattr(capture, name))


def test_known_loads() -> None:
    by_name = {path.name.split("_")[0]: read_capture(path) for path in FILES}
    assert (by_name["xl330"].mass_kg, by_name["xl330"].arm_length_m) == (0.49, 0.1)
    assert by_name["odrive"].counts_per_rev == 8192
    assert by_name["emps"].mass_kg is None
