"""Another day's capture, shown across the halves of one: a model of the first predicts the second, and the reverse."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from servo_daemon.captures import read_capture
from tests.unit.commands import run_command

_EFFECTS = ("--effect", "asymmetric_friction", "--effect", "position_dependent_friction")


@pytest.fixture(scope="module")
def halves(servo_data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("halves")
    source = read_capture(servo_data / "emps_train.csv.gz").block()
    assert source.torque_Nm is not None
    assert source.position_rad is not None
    table = np.column_stack([source.time_s, source.torque_Nm, source.position_rad])
    paths = folder / "first.csv", folder / "second.csv"
    for path, half in zip(paths, np.array_split(table, 2), strict=True):
        np.savetxt(path, half, delimiter=",", header="time_s,force_N,position_m", comments="", fmt="%.9g")
    return paths


@pytest.mark.parametrize("way", [1, -1], ids=["second from first", "first from second"])
def test_friction_settles_without_harm(halves: tuple[Path, Path], way: int) -> None:
    """3.7 s, a motion or two, do not tell four frictions: each may look known to a few percent and be wrong with
    the others: believed, they make it 4.0 and 3.7 mm/s (a fit to other runs, 28)."""
    fitted, other = halves[::way]
    words = ("fit", fitted, *_EFFECTS, "--segment", "0.5", "--validate", other, "--adapt", "0.3", "--json")
    (scores,) = run_command(*words).document["validation"]
    velocity, position = (
        {kind: 1e3 * scores[kind][by][channel] for kind in ("baseline", "extended", "adapted")}
        for by, channel in (("rmse", "velocity_m_s"), ("rmse_1s", "position_m"))
    )
    assert 10.0 < velocity["baseline"] < 30.0
    assert 0.8 < velocity["extended"] < 2.0
    assert 0.2 < position["extended"] < 0.7
    assert 0.8 < velocity["adapted"] < 1.2 * velocity["extended"]
    assert 0.2 < position["adapted"] < 1.2 * position["extended"]
