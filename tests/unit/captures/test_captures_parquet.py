"""Captures in Parquet, with and without pyarrow."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from servo_daemon.captures import CaptureWriter, read_capture, write_capture
from servo_daemon.errors import BadInputError, CaptureError
from servo_daemon.samples import make_block

K = np.arange(1000.0)
BLOCK = make_block(K / 997, voltage_V=np.sin(K), position_rad=np.cos(K))


@pytest.fixture
def arrow() -> ModuleType:
    return pytest.importorskip("pyarrow", reason="pyarrow (extra 'parquet') is not installed")


def test_without_pyarrow_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = importlib.import_module

    def without(name: str, package: str | None = None) -> ModuleType:
        if name.startswith("pyarrow"):
            raise ModuleNotFoundError(f"No module named {name!r}")
        return real(name, package)

    monkeypatch.setattr(importlib, "import_module", without)
    path = tmp_path / "a.parquet"
    with pytest.raises(
        BadInputError, match=r"a\.parquet: Parquet needs pyarrow: pip install 'servo-daemon\[parquet\]'"
    ):
        CaptureWriter(path)
    assert list(tmp_path.iterdir()) == []
    path.write_bytes(b"PAR1 and so on")
    with pytest.raises(BadInputError, match=r"servo-daemon\[parquet\]") as caught:
        read_capture(path)
    assert caught.value.exit_code == 2


def test_round_trip_and_reproducible_bytes(tmp_path: Path, arrow: ModuleType) -> None:
    for name in ("a.parquet", "b.parquet"):
        with CaptureWriter(tmp_path / name, metadata={"note": "x\ny"}, axis="linear") as writer:
            for start in range(0, 1000, 7):
                writer.write(BLOCK.slice(start, start + 7))
    capture = read_capture(tmp_path / "a.parquet")
    assert (capture.axis, dict(capture.metadata)) == ("linear", {"axis": "linear", "note": "x\ny"})
    np.testing.assert_array_equal(capture.time_s, BLOCK.time_s)
    assert capture.voltage_V is not None and BLOCK.voltage_V is not None
    np.testing.assert_array_equal(capture.voltage_V, BLOCK.voltage_V)
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.parquet", "b.parquet"]


def test_refused_and_discarded_leave_nothing(tmp_path: Path, arrow: ModuleType) -> None:
    writer = CaptureWriter(tmp_path / "a.parquet")
    writer.write(BLOCK)
    writer.discard()
    bad = np.where(K == 5, np.nan, K)
    with pytest.raises(CaptureError, match="1 samples are no measurements"):
        write_capture(tmp_path / "a.parquet", make_block(K, voltage_V=bad, position_rad=K))
    assert list(tmp_path.iterdir()) == []


def test_columns_of_other_numeric_types(tmp_path: Path, arrow: ModuleType) -> None:
    parquet = importlib.import_module("pyarrow.parquet")
    table = arrow.table(
        {
            "time_s": arrow.array([0.0, 0.5, 1.0]),
            "voltage_V": arrow.array([1, 2, 3], arrow.int16()),
            "position_rad": arrow.array([0.5, 1.0, 1.5], arrow.float32()),
            "mode": arrow.array(["a", "b", None]),
        }
    )
    parquet.write_table(table, tmp_path / "a.parquet")
    capture = read_capture(tmp_path / "a.parquet")
    assert capture.notes == ("unknown column ignored: mode",)
    assert capture.voltage_V is not None and capture.voltage_V.tolist() == [1.0, 2.0, 3.0]
    assert capture.position_rad is not None and capture.position_rad.tolist() == [0.5, 1.0, 1.5]


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"time_s": [0.0, 1.0], "voltage_V": [1.0, 2.0]}, "no usable set of columns"),
        ({"time_s": [], "voltage_V": [], "position_rad": []}, "holds null, not numbers"),
        ({"time_s": [0.0], "voltage_V": [1.0], "position_rad": [1.0]}, "1 samples: at least 2"),
        ({"time_s": [0.0, 1.0], "voltage_V": ["1", "2"], "position_rad": [1.0, 2.0]}, "column voltage_V: holds string"),
        ({"time_s": [0.0, 1.0], "voltage_V": [1.0, None], "position_rad": [1.0, 2.0]}, "column voltage_V: row 2: the"),
        ({"time_s": [0.0, 0.0], "voltage_V": [1.0, 2.0], "position_rad": [1.0, 2.0]}, "column time_s: row 2: time is"),
    ],
)
def test_bad_parquet(tmp_path: Path, arrow: ModuleType, columns: dict[str, list[object]], message: str) -> None:
    parquet = importlib.import_module("pyarrow.parquet")
    parquet.write_table(arrow.table(columns), tmp_path / "a.parquet")
    with pytest.raises(CaptureError) as caught:
        read_capture(tmp_path / "a.parquet")
    assert message in str(caught.value)


def test_damaged_parquet(tmp_path: Path, arrow: ModuleType) -> None:
    path = tmp_path / "a.parquet"
    write_capture(path, BLOCK)
    path.write_bytes(path.read_bytes()[:-50])
    with pytest.raises(CaptureError, match=r"a\.parquet: not a usable Parquet file") as caught:
        read_capture(path)
    assert "\n" not in str(caught.value)
