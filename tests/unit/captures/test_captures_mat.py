"""MAT files, written by scipy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from servo_daemon.captures import Capture, read_capture, write_capture
from servo_daemon.errors import CaptureError, ConfigError
from servo_daemon.samples import make_block

N = 50
T = np.arange(N) * 1e-3
U, A, Q = np.sin(T * 90), np.cos(T * 70), T * 3.0
BLOCK = make_block(T, voltage_V=U, current_A=A, position_rad=Q)
PLAIN = {"time_s": T, "voltage_V": U, "current_A": A, "position_rad": Q}


def saved(folder: Path, content: dict[str, Any], **options: Any) -> Path:
    path = folder / "a.mat"
    savemat(path, content, **options)
    return path


def read(folder: Path, content: dict[str, Any], signals: str | None = None) -> Capture:
    path = saved(folder, content)
    if signals is None:
        return read_capture(path)
    (folder / "map.toml").write_text(signals)
    return read_capture(path, folder / "map.toml")


def assert_same(capture: Capture, folder: Path) -> None:
    """As good as the same samples in CSV."""
    write_capture(folder / "same.csv", BLOCK)
    meant = read_capture(folder / "same.csv")
    assert capture.channels == meant.channels
    for name in ("time_s", *meant.channels):
        np.testing.assert_array_equal(getattr(capture, name), getattr(meant, name))


@pytest.mark.parametrize("options", [{}, {"do_compression": True}, {"format": "4"}, {"oned_as": "column"}])
def test_variables_named_as_the_contract_has_them(tmp_path: Path, options: dict[str, Any]) -> None:
    capture = read_capture(saved(tmp_path, {**PLAIN, "extra": T}, **options))
    assert capture.notes == ("signal not used: extra",)
    assert_same(capture, tmp_path)


def test_the_content_decides_not_the_name(tmp_path: Path) -> None:
    path = saved(tmp_path, PLAIN).rename(tmp_path / "a.csv")
    assert_same(read_capture(path), tmp_path)


def test_fields_of_the_only_struct(tmp_path: Path) -> None:
    capture = read(tmp_path, {"log": PLAIN, "comment": "bench 3", "gain": 2.0})
    assert capture.notes == ()
    assert_same(capture, tmp_path)


MATRIX = "".join(
    f'{name} = {{ signal = "data", column = {k} }}\n'
    for k, name in enumerate(("time_s", "voltage_V", "current_A", "position_rad"), 1)
)


def test_columns_and_rows_of_a_matrix(tmp_path: Path) -> None:
    data = np.column_stack([T, U, A, Q])
    assert_same(read(tmp_path, {"data": data}, f"[signals]\n{MATRIX}"), tmp_path)
    assert_same(read(tmp_path, {"data": data.T}, f"[signals]\n{MATRIX.replace('column', 'row')}"), tmp_path)


def test_structure_with_time_as_simulink_leaves_it(tmp_path: Path) -> None:
    out = {"time": T, "signals": [{"values": U, "label": "u"}, {"values": np.column_stack([A, Q]), "label": "iq"}]}
    capture = read(
        tmp_path,
        {"out": out},
        """
        [signals]
        voltage_V = "out.signals(1).values"
        current_A = { signal = "out.signals(2).values", column = 1 }
        position_rad = { signal = "out.signals(2).values", column = 2 }
        """,
    )
    assert_same(capture, tmp_path)


def test_timeseries_as_structs_have_their_own_times(tmp_path: Path) -> None:
    series = {"u": {"Time": T, "Data": U}, "i": {"Time": T, "Data": A}, "q": {"Time": T[::2], "Data": Q[::2]}}
    capture = read(tmp_path, series, 'signals = { voltage_V = "u", current_A = "i", position_rad = "q" }')
    np.testing.assert_array_equal(capture.time_s, T[::2])
    np.testing.assert_allclose(capture.current_A, A[::2])
    assert capture.notes[-1].startswith("3 signals with different sampling, brought to the times of position_rad: volt")
    capture = read(
        tmp_path,
        series,
        'time_base = "current_A"\nsignals = { voltage_V = "u", current_A = "i", position_rad = "q" }',
    )
    np.testing.assert_array_equal(capture.time_s, T[: N - 1])  # the position has ended before the last current
    np.testing.assert_allclose(capture.position_rad, Q[: N - 1], atol=1e-15)
    assert "current_A" not in capture.notes[-2] or "times of current_A" in capture.notes[-2]
    assert capture.notes[-1].startswith(f"1 of {N} samples left out")


def test_integers_and_booleans_are_numbers(tmp_path: Path) -> None:
    k = np.arange(5)
    plain = {"time_s": k.astype(np.uint16), "voltage_V": k > 2, "position_rad": k.astype(np.int8)}
    capture = read(tmp_path, plain)
    assert capture.voltage_V is not None and capture.voltage_V.tolist() == [0.0, 0.0, 0.0, 1.0, 1.0]
    assert capture.time_s.dtype == np.float64


def mapping(voltage: str) -> str:
    """A map that names one signal in question."""
    return f'signals = {{ voltage_V = {voltage}, current_A = "current_A" }}'


def nan_at(values: np.ndarray, index: int) -> np.ndarray:
    return np.where(np.arange(len(values)) == index, np.nan, values)


BAD: dict[str, tuple[dict[str, Any], str | None, str]] = {
    "names": (
        {"t": T, "Uarm": U, "s": "x"},
        None,
        f"no usable set of columns; the file holds t ({N}), Uarm ({N}); say which signal is which: --signals MAP.toml",
    ),
    "matrix": ({"data": np.ones((N, 4))}, None, 'time_s = { signal = "data", column = 1 }, voltage_V = { signal = '),
    "nothing": ({"s": "x", "k": 1.0}, None, "no column time_s; the file holds no numeric signal"),
    "nan": ({**PLAIN, "voltage_V": nan_at(U, 7)}, None, "sample 8, column voltage_V: the value is missing (NaN)"),
    "inf": (
        {**PLAIN, "current_A": np.where(T[3] == T, np.inf, A)},
        None,
        "sample 4, column current_A: inf is not a finite number",
    ),
    "time": ({**PLAIN, "time_s": T[::-1]}, None, "sample 2, column time_s: time jumps back: 0.048 after 0.049"),
    "length": ({**PLAIN, "voltage_V": U[1:]}, None, f"column voltage_V: {N - 1} samples, but time_s (time_s) has {N}"),
    "one": ({"time_s": T[:1], "voltage_V": U[:1], "current_A": A[:1]}, None, "the file holds no numeric signal"),
    "complex": (
        {**PLAIN, "voltage_V": U + 1j},
        mapping('"voltage_V"'),
        "holds c",
    ),
    "text": (
        {**PLAIN, "s": "x"},
        mapping('"s"'),
        "column s: holds text, not numb",
    ),
    "struct": (
        {**PLAIN, "s": {"a": T}},
        mapping('"s"'),
        "holds a struct without",
    ),
    "structs": (
        {**PLAIN, "s": [{"a": T}, {"a": T}]},
        mapping('"s"'),
        "column s: holds 2 structs or cells: write it as name(1), not numbers",
    ),
    "path": (
        {"log": PLAIN},
        'signals = { voltage_V = "log.u", current_A = "log.current_A" }',
        "column log.u: no such signal",
    ),
    "index": (
        {"a": [PLAIN]},
        mapping('"a(2).voltage_V"'),
        "a(2).voltage_V: no such signal; there are a",
    ),
    "syntax": ({"a": [PLAIN]}, mapping('"a{1}"'), "column a{1}: no such signal"),
    "whole matrix": (
        {"d": np.ones((N, 4))},
        mapping('"d"'),
        "d: a matrix of 50 × 4: say which column",
    ),
    "no such column": (
        {"d": np.ones((N, 4))},
        mapping('{ signal = "d", column = 5 }'),
        "column d column 5: a matrix of 50 × 4 has no such part",
    ),
    "3-D": (
        {"d": np.ones((5, 4, 3))},
        mapping('{ signal = "d", row = 1 }'),
        "has 3 dimensions, 5 × 4 × 3",
    ),
    "group": (PLAIN, mapping('{ signal = "voltage_V", group = 1 }'), "'group' is for MDF files"),
    "not enough": (
        PLAIN,
        'signals = { voltage_V = "voltage_V" }',
        "no usable set of columns among: time_s, voltage_V",
    ),
    "two structs": ({"a": PLAIN, "b": PLAIN}, None, "no column time_s; the file holds a.time_s (50), a.voltage_V (50)"),
    "time base": (
        {"u": {"time": T, "data": U}, "i": {"time": T + 9, "data": A}},
        'signals = { voltage_V = "u", current_A = "i" }',
        "the signals have no time in common: voltage_V 0 … 0.049 s, current_A 9 … 9.049 s",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_mat_is_one_line_naming_the_place(tmp_path: Path, name: str) -> None:
    content, signals, message = BAD[name]
    with pytest.raises(CaptureError) as caught:
        read(tmp_path, content, signals)
    text = str(caught.value)
    assert text.startswith(str(tmp_path / "a.mat"))
    assert message in text
    assert "\n" not in text


def test_time_base_of_the_map_must_be_mapped(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"time_base: 'torque_Nm' is none of the columns voltage_V, current_A"):
        read(tmp_path, PLAIN, 'time_base = "torque_Nm"\nsignals = { voltage_V = "voltage_V", current_A = "current_A" }')


def test_version_7_3_and_damage(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
    for content in (head + bytes(384) + b"\x89HDF\r\n\x1a\n", b"\x89HDF\r\n\x1a\n" + bytes(900)):
        path.write_bytes(content)
        with pytest.raises(CaptureError, match=r"a MAT file of version 7\.3 \(HDF5\): save it with .*'-v7'"):
            read_capture(path)
    whole = saved(tmp_path, PLAIN).read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(CaptureError, match="not a usable MAT file, or cut off: ") as caught:
        read_capture(path)
    assert "\n" not in str(caught.value)


def test_objects_of_matlab_classes_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """scipy cannot write them: what it makes of them is put in the place of a file's content."""
    from scipy.io.matlab import MatlabFunction, MatlabOpaque

    kind = [("s0", "O"), ("s1", "O"), ("s2", "O"), ("arr", "O")]
    series = MatlabOpaque(np.array([(b"speed", b"MCOS", b"timeseries", np.zeros((6, 1)))], dtype=kind))
    handle = MatlabFunction(np.array([(1,)], dtype=[("a", "O")]))
    path = saved(tmp_path, PLAIN)
    monkeypatch.setattr("scipy.io.loadmat", lambda *_, **__: {"speed": series})
    with pytest.raises(
        CaptureError, match=r"speed is a MATLAB object \(class timeseries\).*'data', speed\.Data\); save"
    ):
        read_capture(path)
    monkeypatch.setattr("scipy.io.loadmat", lambda *_, **__: {"f": handle})
    with pytest.raises(CaptureError, match=r"f is a MATLAB object \(class function handle\), which only MATLAB can re"):
        read_capture(path)
    (tmp_path / "map.toml").write_text(mapping('"speed.Data"'))
    monkeypatch.setattr("scipy.io.loadmat", lambda *_, **__: {"speed": series, **PLAIN})
    with pytest.raises(CaptureError, match=r"column speed\.Data: speed is a MATLAB object"):
        read_capture(path, tmp_path / "map.toml")
