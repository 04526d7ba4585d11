"""The real captures: all are read, none needs a special case."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from servo_daemon.captures import read_capture, write_capture

#: Beginning of the name -> channels, axis, median period s (README of the data).
KNOWN = {
    "emps": (("position_rad", "torque_Nm"), "linear", 1e-3),
    "odrive_slow": (("current_A", "position_rad"), "rotary", 2.28e-3),
    "odrive_spinup": (("current_A", "position_rad"), "rotary", 7.7e-4),
    "unal": (("voltage_V", "velocity_rad_s"), "rotary", 0.02),
    "xl330": (("voltage_V", "position_rad", "temperature_C"), "rotary", 5.3e-3),
}


@pytest.mark.parametrize("family", KNOWN)
def test_real_captures(family: str, servo_data: Path, tmp_path: Path) -> None:
    paths = sorted(servo_data.glob(f"{family}_*.csv.gz"))
    assert paths
    for path in paths:
        check(path, family, tmp_path / "copy.csv")


def check(path: Path, family: str, copy_path: Path) -> None:
    """Content as the README of the data says, every row there, and the same again after writing."""
    capture = read_capture(path)
    channels, axis, period_s = KNOWN[family]
    assert (capture.channels, capture.axis) == (channels, axis)
    assert capture.sample_period_s == pytest.approx(period_s, rel=0.06)
    with gzip.open(path, "rt") as lines:
        rows = sum(1 for line in lines if line[0] not in "#t")
    assert len(capture) == rows
    assert capture.notes == (("unknown column ignored: supply_V",) if family == "xl330" else ())
    # GAP_FACTOR's source: late polls of the host-side time stamps, at most two of them in one capture.
    assert np.count_nonzero(capture.quality()) <= (2 if family.startswith("odrive") else 0)
    write_capture(copy_path, capture.block(), metadata=capture.metadata, axis=capture.axis)
    copy = read_capture(copy_path)
    assert copy.metadata == capture.metadata
    for name in ("time_s", *capture.channels):
        np.testing.assert_array_equal(getattr(copy, name), getattr(capture, name))


def test_known_loads(servo_data: Path) -> None:
    pendulum = read_capture(servo_data / "xl330_sin_sin_kp100.csv.gz")
    assert (pendulum.mass_kg, pendulum.arm_length_m, pendulum.counts_per_rev) == (0.49, 0.1, None)
    assert read_capture(servo_data / "odrive_slow_comp.csv.gz").counts_per_rev == 8192
