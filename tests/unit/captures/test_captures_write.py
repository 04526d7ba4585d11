"""Writing captures: exact, reproducible, and never half a file under the final name."""

from __future__ import annotations

import gzip
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from servo_daemon.captures import CaptureWriter, read_capture, write_capture
from servo_daemon.errors import BadInputError, CaptureError, ServoDaemonError
from servo_daemon.samples import Quality, SampleBlock, make_block

TEXT_NAMES = ("a.csv", "a.csv.gz")


def block(n: int = 1000, start: int = 0) -> SampleBlock:
    k = np.arange(start, start + n, dtype=np.float64)
    return make_block(k / 997, voltage_V=np.sin(k), current_A=k / 7, position_rad=1e-9 * np.cos(k))


def assert_same(read: SampleBlock, meant: SampleBlock) -> None:
    assert read.channels == meant.channels
    for name in ("time_s", *meant.channels):
        np.testing.assert_array_equal(getattr(read, name), getattr(meant, name))


@pytest.mark.parametrize("name", TEXT_NAMES)
def test_what_is_written_is_read_bit_for_bit(tmp_path: Path, name: str) -> None:
    metadata = {"mass_kg": "0.49", "note": "first\nsecond: with colon\r\nthird, # and \tmore", "motor.type-2": "Ω"}
    write_capture(tmp_path / name, block(), metadata=metadata)
    capture = read_capture(tmp_path / name)
    assert_same(capture.block(), block())
    assert dict(capture.metadata) == {**metadata, "note": "first\nsecond: with colon\nthird, # and  more"}
    assert list(tmp_path.iterdir()) == [tmp_path / name]


def test_the_text_is_plain_csv(tmp_path: Path) -> None:
    k = np.array([0.0, 0.5])
    write_capture(tmp_path / "a.csv", make_block(k, current_A=k / 5, position_rad=-k), metadata={"source": "test"})
    assert (tmp_path / "a.csv").read_text() == (
        "# source: test\ntime_s,current_A,position_rad\n0.0,0.0,-0.0\n0.5,0.1,-0.5\n"
    )


def test_linear_axis_keeps_its_column_names(tmp_path: Path) -> None:
    k = np.arange(3.0)
    meant = make_block(k, position_rad=k, velocity_rad_s=k, torque_Nm=k)
    write_capture(tmp_path / "a.csv", meant, axis="linear")
    lines = (tmp_path / "a.csv").read_text().splitlines()
    assert lines[:2] == ["# axis: linear", "time_s,position_m,velocity_m_s,force_N"]
    capture = read_capture(tmp_path / "a.csv")
    assert capture.axis == "linear"
    assert_same(capture.block(), meant)


@pytest.mark.parametrize("name", TEXT_NAMES)
@pytest.mark.parametrize("sizes", [(1,) * 500, (7,) * 71 + (3,), (500,)], ids=["1", "7", "all"])
def test_blocks_of_any_size_give_the_same_rows(tmp_path: Path, name: str, sizes: tuple[int, ...]) -> None:
    whole, start = block(500), 0
    with CaptureWriter(tmp_path / name) as writer:
        for size in sizes:
            writer.write(whole.slice(start, start + size))
            start += size
    assert writer.samples == 500
    assert_same(read_capture(tmp_path / name).block(), whole)


def test_bytes_are_reproducible_whatever_the_name_and_the_hour(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_capture(tmp_path / "a.csv.gz", block(), metadata={"seed": "1"})
    monkeypatch.setattr("time.time", lambda: 4e9)
    write_capture(tmp_path / "b.csv.gz", block(), metadata={"seed": "1"})
    assert (tmp_path / "a.csv.gz").read_bytes() == (tmp_path / "b.csv.gz").read_bytes()


@pytest.mark.parametrize("name", TEXT_NAMES)
def test_an_exception_keeps_what_was_recorded(tmp_path: Path, name: str) -> None:
    def record() -> None:
        with CaptureWriter(tmp_path / name) as writer:
            writer.write(block(10))
            assert not (tmp_path / name).exists()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record()
    assert_same(read_capture(tmp_path / name).block(), block(10))
    assert list(tmp_path.iterdir()) == [tmp_path / name]


class _Signalled(BaseException):
    """What a handler of SIGTERM raises."""


@pytest.mark.parametrize("name", TEXT_NAMES)
def test_a_signal_in_the_middle_of_writing_tears_nothing(tmp_path: Path, name: str) -> None:
    """The handler raises at an arbitrary step of the main thread, which does nothing but write."""

    def handler(number: int, frame: object) -> None:
        raise _Signalled

    previous = signal.signal(signal.SIGUSR1, handler)
    main = threading.main_thread().ident
    assert main is not None
    writer = CaptureWriter(tmp_path / name)
    timer = threading.Timer(0.05, signal.pthread_kill, (main, signal.SIGUSR1))
    try:
        with pytest.raises(_Signalled), writer:
            timer.start()
            start = 0
            while True:
                writer.write(block(20, start))
                start += 20
    finally:
        timer.join()
        signal.signal(signal.SIGUSR1, previous)
    assert writer.samples >= 20
    assert_same(read_capture(tmp_path / name).block(), block(writer.samples))


def test_no_samples_no_file(tmp_path: Path) -> None:
    with CaptureWriter(tmp_path / "a.csv.gz") as writer:
        pass
    writer.close()
    assert writer.samples == 0
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ValueError, match="write after close"):
        writer.write(block())


def test_an_older_capture_stays_until_the_new_one_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    write_capture(path, block(10))
    with CaptureWriter(path) as writer:
        writer.write(block(20))
        assert len(read_capture(path)) == 10
    assert len(read_capture(path)) == 20
    with CaptureWriter(path) as writer:
        writer.write(block(30))
        writer.discard()
    assert len(read_capture(path)) == 20
    assert list(tmp_path.iterdir()) == [path]


def test_samples_that_are_no_measurements_are_left_out_and_counted(tmp_path: Path) -> None:
    k = np.arange(6.0)
    current = k.copy()
    current[1] = np.nan
    quality = np.zeros(6, dtype=np.uint8)
    quality[3], quality[4] = Quality.POSITION_INVALID, Quality.SATURATED
    recorded = make_block(k, quality=quality, current_A=current, position_rad=k)
    with CaptureWriter(tmp_path / "a.csv") as writer:
        writer.write(recorded)
    assert (writer.samples, writer.samples_dropped) == (4, 2)
    assert read_capture(tmp_path / "a.csv").time_s.tolist() == [0.0, 2.0, 4.0, 5.0]
    with pytest.raises(CaptureError, match="2 samples are no measurements"):
        write_capture(tmp_path / "b.csv", recorded)
    assert not (tmp_path / "b.csv").exists()


def test_a_device_restart_ends_the_capture_and_keeps_it(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"

    def record() -> None:
        with CaptureWriter(path) as writer:
            writer.write(block(10, 100))
            writer.write(block(10, 110))
            writer.write(block(10, 5))

    with pytest.raises(CaptureError, match=r"after 20 samples: the device restarted"):
        record()
    assert_same(read_capture(path).block(), block(20, 100))


def test_wrong_use_is_refused_before_a_file_appears(tmp_path: Path) -> None:
    for name, message in (("a.txt", "ends in .csv"), ("none/a.csv", "cannot be written: No such file")):
        with pytest.raises(BadInputError, match=message):
            CaptureWriter(tmp_path / name)
    with pytest.raises(CaptureError, match="metadata key 'a b'"):
        CaptureWriter(tmp_path / "a.csv", metadata={"a b": "1"})
    with pytest.raises(CaptureError, match="no usable set of columns"):
        write_capture(tmp_path / "a.csv", make_block(np.arange(3.0), voltage_V=np.arange(3.0)))
    with pytest.raises(CaptureError, match="mass_kg: 'heavy'"):
        write_capture(tmp_path / "a.csv", block(), metadata={"mass_kg": "heavy"})
    with CaptureWriter(tmp_path / "b.csv") as writer:
        writer.write(block(10))
        with pytest.raises(CaptureError, match="channels changed"):
            writer.write(make_block(np.array([9e9]), voltage_V=np.zeros(1), position_rad=np.zeros(1)))
    assert [p.name for p in tmp_path.iterdir()] == ["b.csv"]


def test_a_folder_that_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: Path, *args: object, **kwargs: object) -> None:
        raise OSError(30, os.strerror(30))

    monkeypatch.setattr(Path, "open", refuse)  # tests may run as root, whom no mode bits stop
    with pytest.raises(BadInputError, match=r"a\.csv: cannot be written: Read-only file system"):
        CaptureWriter(tmp_path / "a.csv")


_FULL_DISK = """
import resource, sys
from pathlib import Path
import numpy as np
from servo_daemon.captures import CaptureWriter, write_capture
from servo_daemon.errors import ServoDaemonError
from servo_daemon.samples import make_block

resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))
path, streaming = Path(sys.argv[1]), sys.argv[2] == "stream"
rng = np.random.default_rng(0)

def block(start):
    k = np.arange(start, start + 1000) / 1000
    return make_block(k, current_A=rng.normal(size=1000), position_rad=rng.normal(size=1000))

try:
    if streaming:
        with CaptureWriter(path) as writer:
            for start in range(0, 100_000, 1000):
                writer.write(block(start))
    else:
        k = np.arange(float(sys.argv[3]))
        write_capture(path, make_block(k, current_A=np.sin(k), position_rad=np.cos(k)))
except ServoDaemonError as error:
    print(type(error).__name__, error)
"""


@pytest.mark.parametrize("name", TEXT_NAMES)
@pytest.mark.parametrize(("way", "rows"), [("stream", "0"), ("once", "3000"), ("once", "80000")])
def test_a_full_disk_is_one_clear_line_and_no_half_file(tmp_path: Path, name: str, way: str, rows: str) -> None:
    """A real refusal of the kernel: files of this process may not grow past 50 kB."""
    path = tmp_path / name
    done = subprocess.run(
        [sys.executable, "-c", _FULL_DISK, str(path), way, rows],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert done.stdout.startswith(f"ServoDaemonError {path}: writing failed: File too large")
    assert done.stdout.count("\n") == 1
    assert done.stderr == ""
    assert not path.exists()
    left = list(tmp_path.iterdir())
    if way == "once":
        assert left == []
    else:
        assert len(left) == 1
        assert done.stdout.endswith(f"; what was written until then is in {left[0]}\n")


def test_devices_are_written_directly() -> None:
    write_capture("/dev/null", block())
    assert Path("/dev/null").is_char_device()
    with pytest.raises(ServoDaemonError, match="/dev/full: writing failed: No space left"):
        write_capture("/dev/full", block())
    assert Path("/dev/full").is_char_device()


def test_gzip_has_neither_name_nor_time(tmp_path: Path) -> None:
    write_capture(tmp_path / "secret name.csv.gz", block(10))
    data = (tmp_path / "secret name.csv.gz").read_bytes()
    assert data[3] == 0  # FLG: no file name
    assert data[4:8] == bytes(4)  # MTIME
    assert gzip.decompress(data).startswith(b"time_s,")
