"""Excel workbooks, written by openpyxl."""

from __future__ import annotations

import datetime
import importlib
import io
import math
import zipfile
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from servo_daemon.captures import read_capture, write_capture
from servo_daemon.errors import BadInputError, CaptureError
from servo_daemon.samples import make_block

HEADER = ["time_s", "voltage_V", "current_A", "position_rad"]
T = np.arange(40) / 997
COLUMNS = [T, np.sin(T * 90), np.cos(T * 70), T * 3.0]
ROWS = np.column_stack(COLUMNS).tolist()


@pytest.fixture(autouse=True)
def openpyxl() -> Any:
    return pytest.importorskip("openpyxl", reason="openpyxl (extra 'excel') is not installed")


def workbook(path: Path, sheets: dict[str, Sequence[Sequence[Any]]]) -> Path:
    book = importlib.import_module("openpyxl").Workbook()
    book.remove(book.active)
    for name, rows in sheets.items():
        sheet = book.create_sheet(name)
        for row in rows:
            sheet.append(row)
    book.save(path)
    return path


def test_round_trip_with_metadata_units_and_empty_rows(tmp_path: Path) -> None:
    block = make_block(T, voltage_V=COLUMNS[1], current_A=COLUMNS[2], position_rad=COLUMNS[3])
    metadata = {"mass_kg": "0.49", "note": "x\ny"}
    write_capture(tmp_path / "a.csv", block, metadata=metadata)
    meant = read_capture(tmp_path / "a.csv")
    above = [["# mass_kg: 0.49"], ["# note: x"], ["# note: y"], [], ["# free words"]]
    rows = [*above, [*HEADER, "remark"], ["s", "V", "A", "rad", ""], *ROWS[:7], [], *ROWS[7:], []]
    capture = read_capture(workbook(tmp_path / "a.xlsx", {"empty": [], "Run 1": rows}))
    assert dict(capture.metadata) == metadata
    assert (capture.channels, capture.notes) == (meant.channels, ("signal not used: remark",))
    for name in ("time_s", *meant.channels):
        # openpyxl writes 16 digits, one less than a double needs.
        np.testing.assert_allclose(getattr(capture, name), getattr(meant, name), rtol=1e-15)


def test_a_map_chooses_sheet_and_columns(tmp_path: Path) -> None:
    table = [["t", "U", "I"], *([1000 * row[0], *row[1:3]] for row in ROWS)]
    path = workbook(tmp_path / "a.xlsx", {"Run 1": table, "Run 2": [table[0], *table[2:]]})
    signals = 'signals = { time_s = { signal = "t", scale = 0.001 }, voltage_V = "U", current_A = "I" }'
    (tmp_path / "map.toml").write_text(signals)
    with pytest.raises(CaptureError, match=r'more than one sheet fits: Run 1, Run 2; name one in a map: sheet = "…"'):
        read_capture(path, tmp_path / "map.toml")
    (tmp_path / "map.toml").write_text('sheet = "Run 2"\n' + signals)
    capture = read_capture(path, tmp_path / "map.toml")
    assert len(capture) == len(T) - 1
    assert capture.time_s == pytest.approx(T[1:])
    (tmp_path / "map.toml").write_text('sheet = "Run 3"\n' + signals)
    with pytest.raises(CaptureError, match=r"a\.xlsx: no sheet 'Run 3': there are Run 1, Run 2"):
        read_capture(path, tmp_path / "map.toml")


def with_cell(value: Any) -> list[list[Any]]:
    return [HEADER, *ROWS[:5], [ROWS[5][0], value, 0.0, 0.0], *ROWS[6:]]


BAD: dict[str, tuple[dict[str, Sequence[Sequence[Any]]], str]] = {
    "empty": ({"A": [], "B": []}, "no sheet has the columns needed: all are empty"),
    "only one, empty": ({"A": []}, "no column time_s; the file holds no numeric signal"),
    "names": (
        {"A": [["t / ms", "Spannung"], [0, 1], [1, 2]]},
        "no usable set of columns; the file holds t / ms (2), Spannung (2); say which signal is which: ",
    ),
    "proposal": (
        {"A": [["t / ms", "Spannung"], [0, 1], [1, 2]]},
        'signals = { time_s = { signal = "t / ms", scale = 0.001 }, voltage_V = "Spannung", ',
    ),
    "several": (
        {"A": [["t", "a"], [0, 1]], "B": [["x", "y"], ["s", "V"], [1, 2]]},
        "no sheet has the columns needed: sheet A: t (1), a (1); sheet B: x (1, s), y (1, V); say which",
    ),
    "twice": ({"A": [[*HEADER, "time_s"], *ROWS]}, "column time_s: there are 2 of this name"),
    "header only": ({"A": [HEADER]}, "sheet A: a header but no rows: at least 2 samples are needed"),
    "one row": ({"A": [HEADER, ROWS[0]]}, "sheet A: only one sample: at least 2 samples are needed"),
    "empty cell": ({"A": with_cell(None)}, "sheet A, row 7, column voltage_V: the cell is empty (or a formula whose"),
    "formula": ({"A": with_cell("=A2*2")}, "sheet A, row 7, column voltage_V: the cell is empty (or a formula whose"),
    "text": ({"A": with_cell("1,5")}, "sheet A, row 7, column voltage_V: '1,5' is text, not a number"),
    "date": ({"A": with_cell(datetime.datetime(2026, 1, 2))}, "row 7, column voltage_V: '2026-01-02 00:00:00' is a da"),
    "bool": ({"A": with_cell(True)}, "row 7, column voltage_V: 'True' is a bool, not a number"),
    "time": ({"A": [HEADER, *ROWS, [], ROWS[3]]}, "sheet A, row 43, column time_s: time jumps back: 0.003009027081"),
    "short row": ({"A": [HEADER, *ROWS, [1.0, 2.0]]}, "sheet A, row 42, column current_A: the cell is empty"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_workbook_is_one_line_naming_the_place(tmp_path: Path, name: str) -> None:
    sheets, message = BAD[name]
    with pytest.raises(CaptureError) as caught:
        read_capture(workbook(tmp_path / "a.xlsx", sheets))
    text = str(caught.value)
    assert text.startswith(str(tmp_path / "a.xlsx"))
    assert message in text
    assert "\n" not in text


def test_what_a_map_cannot_say_of_a_sheet(tmp_path: Path) -> None:
    path = workbook(tmp_path / "a.xlsx", {"A": [HEADER, *ROWS]})
    for entry, message in (
        ('{ signal = "voltage_V", column = 2 }', "sheet's columns have no 'column', 'row' or 'group'"),
        ('"Uarm"', r"sheet A, column Uarm: no such column; there are time_s \(40\), volt"),
    ):
        (tmp_path / "map.toml").write_text(f'signals = {{ voltage_V = {entry}, current_A = "current_A" }}')
        with pytest.raises(CaptureError, match=message):
            read_capture(path, tmp_path / "map.toml")


def test_damaged_foreign_and_old_files(tmp_path: Path) -> None:
    path = workbook(tmp_path / "a.xlsx", {"A": [HEADER, *ROWS]})
    whole = path.read_bytes()
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as zipped:
        zipped.writestr("readme.txt", "no workbook")
    for content, message in (
        (whole[:-50], "not a usable Excel workbook (.xlsx), or cut off: "),
        (archive.getvalue(), "not a usable Excel workbook (.xlsx), or cut off: "),
        (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(500), "an Excel file of the old kind (.xls): save it as .xlsx"),
    ):
        path.write_bytes(content)
        with pytest.raises(CaptureError) as caught:
            read_capture(path)
        assert message in str(caught.value)
        assert "\n" not in str(caught.value)


def test_without_openpyxl_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = workbook(tmp_path / "a.xlsx", {"A": [HEADER, *ROWS]})
    real = importlib.import_module

    def without(name: str, package: str | None = None) -> ModuleType:
        if name.startswith("openpyxl"):
            raise ModuleNotFoundError(f"No module named {name!r}")
        return real(name, package)

    monkeypatch.setattr(importlib, "import_module", without)
    with pytest.raises(BadInputError, match=r"a\.xlsx: Excel needs openpyxl: pip install 'servo-daemon\[exc") as caught:
        read_capture(path)
    assert caught.value.exit_code == 2


def test_columns_are_understood_by_name_and_unit(tmp_path: Path) -> None:
    table = [["Zeit", "Spannung", "Strom", "Winkel"], ["ms", "V", "mA", "°"]]
    table += [[1e3 * t, u, 1e3 * i, math.degrees(q)] for t, u, i, q in ROWS]
    capture = read_capture(workbook(tmp_path / "a.xlsx", {"A": table, "notes": [["who", "what"], ["x", "y"]]}))
    assert capture.position_rad is not None and capture.current_A is not None
    np.testing.assert_allclose(capture.time_s, T, rtol=1e-12)
    np.testing.assert_allclose(capture.current_A, COLUMNS[2], rtol=1e-12)
    np.testing.assert_allclose(capture.position_rad, COLUMNS[3], rtol=1e-12)
    assert "Winkel → position_rad" in capture.notes[0]


def test_a_workbook_that_unpacks_to_more_than_is_read_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = workbook(tmp_path / "a.xlsx", {"A": [HEADER, *ROWS]})
    monkeypatch.setattr("servo_daemon.captures.formats.excel.MAX_OBJECTS", 100)
    with pytest.raises(CaptureError, match="at most 100 numbers are read"):
        read_capture(path)
    monkeypatch.setattr("servo_daemon.captures.formats.excel.MAX_BYTES", 1000)
    with pytest.raises(CaptureError, match="MB unpacked: at most"):
        read_capture(path)
