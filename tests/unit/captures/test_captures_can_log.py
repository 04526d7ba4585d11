"""CAN logs (BLF, ASC), written by python-can: our own frames, and another maker's by DBC and map."""

from __future__ import annotations

import gzip
from collections.abc import Sequence
from pathlib import Path

import can
import cantools
import numpy as np
import pytest

from servo_daemon.captures import Capture, read_capture, write_capture
from servo_daemon.errors import CaptureError, ConfigError, ServoDaemonError
from servo_daemon.samples import Quality
from servo_daemon.sim_drive.can_frames import CanFrame
from tests.can_tools import COUNTS_PER_REV, RampSource, frames_of, message_of

N = 300
START_S = 1_700_000_000.0

DBC = """VERSION "1"
BO_ 256 Feedback: 8 Drive
 SG_ Angle : 0|32@1- (0.001,0) [0|0] "rad" Host
 SG_ Micros : 32|32@1+ (1,0) [0|0] "us" Host
BO_ 512 Status: 8 Drive
 SG_ Current : 0|16@1- (0.01,0) [0|0] "A" Host
 SG_ Duty : 16|16@1- (0.001,0) [0|0] "" Host
 SG_ Bus : 32|16@1+ (0.01,0) [0|0] "V" Host
"""

MAP = """
dbc = "drive.dbc"
period_s = 0.001
[signals]
position_rad = "Feedback.Angle"
current_A = { signal = "Status.Current", scale = 2.0, offset = 0.5 }
voltage_V = { formula = "Duty * Bus", Duty = "Status.Duty", Bus = "Status.Bus" }
"""


def logged(path: Path, messages: Sequence[can.Message]) -> Path:
    """A log by the name's ending."""
    writer = can.BLFWriter(str(path)) if path.suffix == ".blf" else can.ASCWriter(str(path))
    for message in messages:
        writer.on_message_received(message)
    writer.stop()
    return path


def own(n: int = N, drive_id: int = 1, **source: int) -> list[can.Message]:
    return stamped(frames_of(RampSource(**source), n, drive_id))


def stamped(frames: Sequence[CanFrame]) -> list[can.Message]:
    return [message_of(f.frame_id, f.data, START_S + 1e-3 * f.sample + 2e-4) for f in frames]


def vendor(n: int = N, before: int = 0) -> list[can.Message]:
    """A drive that sends its position every millisecond and, 0.4 ms later, its state; the first `before` without."""
    database = cantools.database.load_string(DBC)
    assert isinstance(database, cantools.database.can.Database)
    messages = []
    for k in range(n):
        angle = database.encode_message("Feedback", {"Angle": 0.002 * k, "Micros": 1000 * k})
        messages.append(message_of(0x100, angle, START_S + 1e-3 * k))
        if k >= before:
            state = database.encode_message("Status", {"Current": 0.01 * k, "Duty": 0.5, "Bus": 24.0})
            messages.append(message_of(0x200, state, START_S + 1e-3 * k + 4e-4))
    return messages


def read(folder: Path, messages: Sequence[can.Message], text: str | None = MAP, suffix: str = ".blf") -> Capture:
    (folder / "drive.dbc").write_text(DBC)
    path = logged(folder / f"log{suffix}", messages)
    if text is None:
        return read_capture(path)
    (folder / "map.toml").write_text(text)
    return read_capture(path, folder / "map.toml")


@pytest.mark.parametrize("suffix", [".blf", ".asc"])
def test_our_own_frames_need_no_map_and_equal_the_csv(tmp_path: Path, suffix: str) -> None:
    source = {"start_us": 2**32 - 100_000, "start_counts": -5}  # device time wraps
    capture = read(tmp_path, own(**source), None, suffix)
    write_capture(tmp_path / "a.csv", RampSource(**source).next_block(N))
    meant = read_capture(tmp_path / "a.csv")
    assert capture.channels == meant.channels
    for name in meant.channels:
        np.testing.assert_array_equal(getattr(capture, name), getattr(meant, name))
    np.testing.assert_allclose(capture.time_s, meant.time_s, rtol=1e-15)
    assert dict(capture.metadata) == {"identity": "servo-can:1", "counts_per_rev": "4096"}
    assert capture.notes[0].startswith(f"{N} samples from ")


def test_asc_may_be_compressed_and_the_content_decides(tmp_path: Path) -> None:
    path = logged(tmp_path / "log.asc", own())
    other = tmp_path / "log.csv"
    other.write_bytes(gzip.compress(path.read_bytes()))
    assert len(read_capture(other)) == N


def test_a_lost_stretch_is_a_gap_and_a_log_may_begin_anywhere(tmp_path: Path) -> None:
    """0.4 s of frames are missing, in which the 16-bit time wraps six times; the Description comes a second late."""
    frames = frames_of(RampSource(), 3000)
    kept = [f for f in frames if (f.sample >= 200 or f.frame_id == 0) and not 1500 <= f.sample < 1900]
    capture = read(tmp_path, stamped(kept), None)
    block = capture.block()
    (gap,) = np.flatnonzero(block.quality & Quality.GAP_BEFORE)
    assert capture.time_s[gap] - capture.time_s[gap - 1] == pytest.approx(0.401)
    truth = RampSource().next_block(3000)
    index = np.rint(capture.time_s * 1e3).astype(int)
    assert index[-1] == 2999 and 200 <= index[0] < 300 and len(index) > 2300
    np.testing.assert_allclose(capture.position_rad, np.asarray(truth.position_rad)[index])
    assert "400 samples are missing in the log" in capture.notes


def test_several_of_our_drives(tmp_path: Path) -> None:
    both = sorted([*own(), *own(drive_id=3, start_counts=99)], key=lambda m: m.timestamp)
    with pytest.raises(CaptureError, match=r"holds the frames of drives 1, 3: say which in a map: drive_id = 1"):
        read(tmp_path, both, None)
    capture = read(tmp_path, both, "drive_id = 3\ncounts_per_rev = -4096")
    assert capture.position_rad is not None
    assert capture.position_rad[0] == pytest.approx(-99 * 2 * np.pi / COUNTS_PER_REV)
    assert capture.metadata["identity"] == "servo-can:3"
    for wanted in ("2", "true", '"x"'):
        with pytest.raises(ConfigError, match=r"map\.toml: drive_id = .*: drives with frames in .*log\.blf: 1, 3"):
            read(tmp_path, both, f"drive_id = {wanted}")


@pytest.mark.parametrize("suffix", [".blf", ".asc"])
def test_another_makers_frames_by_dbc_and_map(tmp_path: Path, suffix: str) -> None:
    capture = read(tmp_path, vendor(before=10), MAP, suffix)
    k = np.arange(11, N)  # the first complete sample is the one after the first Status
    assert capture.channels == ("voltage_V", "current_A", "position_rad")
    assert capture.position_rad == pytest.approx(0.002 * k)
    assert capture.current_A == pytest.approx(0.02 * (k - 1) + 0.5)  # the value it last had
    assert capture.voltage_V == pytest.approx(np.full(len(k), 12.0))
    assert np.diff(capture.time_s) == pytest.approx(1e-3, abs=1e-5)
    assert capture.notes == (
        f"{N} samples from {2 * N - 10} frames; each signal has the value it last had",
        f"11 of {N} samples left out: a signal was not heard yet or too long ago",
    )


def test_device_time_and_linear_axis(tmp_path: Path) -> None:
    text = MAP.replace("position_rad", "position_m") + 'time_s = { signal = "Feedback.Micros", scale = 1e-6 }\n'
    capture = read(tmp_path, vendor(), text + "[metadata]\nmass_kg = 3.0\n")
    assert (capture.axis, capture.mass_kg) == ("linear", 3.0)
    assert capture.time_s == pytest.approx(1e-3 * np.arange(1, N))


def test_channels_of_a_log_are_kept_apart(tmp_path: Path) -> None:
    messages = vendor()
    for message in messages[::2]:
        message.channel = 0
    others = vendor()
    for message in [*messages[1::2], *others]:
        message.channel = 0 if message in messages else 1
    both = sorted([*messages, *others], key=lambda m: m.timestamp)
    with pytest.raises(CaptureError, match=r"the frames are on channels 1, 2: say which in a map: channel = 1"):
        read(tmp_path, both)
    assert len(read(tmp_path, both, "channel = 2\n" + MAP)) == N - 1
    with pytest.raises(ConfigError, match=r"channel = 3: the log has 1, 2"):
        read(tmp_path, both, "channel = 3\n" + MAP)


BAD_MAPS = {
    "sheet": ('sheet = "a"\n' + MAP, "sheet: not an option for CAN logs, which takes dbc, "),
    "no dbc": (MAP.replace('dbc = "drive.dbc"', ""), "[signals] needs dbc as well, for a CAN log"),
    "no signals": ('dbc = "drive.dbc"', "dbc needs [signals] as well, for a CAN log"),
    "trigger alone": ('trigger = "Feedback"', "trigger needs dbc and signals"),
    "drive_id": ("drive_id = 1\n" + MAP, "drive_id is for our own frames, which need no dbc"),
    "missing dbc": (MAP.replace("drive.dbc", "none.dbc"), "none.dbc: cannot be read: No such file or directory"),
    "dbc is no text": (MAP.replace('"drive.dbc"', "3"), "dbc must be a text, not 3"),
    "signal": (
        MAP.replace("Feedback.Angle", "Feedback.Angel"),
        "drive.dbc: position_rad: no signal 'Feedback.Angel': ",
    ),
    "trigger": ('trigger = "X"\n' + MAP, "trigger = 'X' is none of the mapped messages Feedback, Status"),
    "period": (MAP.replace("0.001", "0.0"), "period_s must be positive, not 0.0"),
    "counts": (MAP.replace("position_rad", "position_counts"), "position_counts needs counts_per_rev"),
}


@pytest.mark.parametrize("name", BAD_MAPS)
def test_bad_map_is_one_line_naming_the_place(tmp_path: Path, name: str) -> None:
    text, message = BAD_MAPS[name]
    with pytest.raises(ConfigError) as caught:
        read(tmp_path, vendor(), text)
    assert str(caught.value).startswith(str(tmp_path))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def restarted() -> list[can.Message]:
    again = stamped(frames_of(RampSource(), N))
    for message in again:
        message.timestamp += 2.0
    return [*own(start_us=5_000_000), *again]


BAD_LOGS = {
    "foreign": (
        vendor(3),
        None,
        "no frames of our own among 0x100 (3), 0x200 (3); give a map: --signals MAP.toml",
    ),
    "not the frames": (own(), MAP, "none of the frames needed (0x100, 0x200) among 0x101 ("),
    "never the state": (
        vendor(20, before=20),
        MAP,
        "0 of 20 samples are complete: at least 2 are needed; never heard: ",
    ),
    "never the trigger": (
        vendor(20)[1::2],
        MAP,
        "make no sample (the message that makes one, Feedback.Angle:0x100, ",
    ),
    "no description": (
        own()[4:],
        None,
        "make no sample (no Sync or not all four pages of the Description came; ",
    ),
    "restart": (restarted(), None, f"the drive restarted after {N} samples: a capture cannot go on, cut the log there"),
    "no frames": ([], None, "holds no data frame, or is cut off before the first"),
    "only errors": ([can.Message(is_error_frame=True, timestamp=1.0)], None, "holds no data frame"),
}


@pytest.mark.parametrize("name", BAD_LOGS)
@pytest.mark.parametrize("suffix", [".blf", ".asc"])
def test_bad_log_is_one_line_naming_what_it_holds(tmp_path: Path, name: str, suffix: str) -> None:
    messages, text, message = BAD_LOGS[name]
    with pytest.raises(CaptureError) as caught:
        read(tmp_path, messages, text, suffix)
    assert str(caught.value).startswith(str(tmp_path / f"log{suffix}: "))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_log_of_more_frames_than_memory_holds_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("servo_daemon.captures.formats.can_log.MAX_OBJECTS", 100)
    with pytest.raises(CaptureError, match=r"at most 100 numbers are read; cut it up"):
        read(tmp_path, vendor(60))


def test_damaged_and_cut_off_logs(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    blf, asc = logged(tmp_path / "a.blf", own()).read_bytes(), logged(tmp_path / "a.asc", own()).read_bytes()
    plain = tmp_path / "plain.blf"
    writer = can.BLFWriter(str(plain), compression_level=0)
    for message in own():
        writer.on_message_received(message)
    writer.stop()
    endless = plain.read_bytes()
    at = endless.rindex(b"LOBJ") + 8
    endless = endless[:at] + bytes(4) + endless[at + 4 :]
    version = endless[: at - 2] + b"\x09\x00" + endless[at:]
    path = tmp_path / "log"
    for content, expected in (
        (blf[:-30], "the BLF log is cut off: "),
        (blf[:60], "not a usable BLF log, or cut off: "),
        (blf[:200] + bytes(40) + blf[240:], "not a usable BLF log, or cut off: "),
        (endless, "not a usable BLF log, or cut off: an object of 0 bytes"),
        (version, "not a usable BLF log, or cut off: an object of 0 bytes"),
        (asc[:-30], "the ASC log is cut off: its last line has no end"),
        (
            asc.replace(b"absolute", b"relative"),
            "its time stamps are relative to the line before: save it with abs",
        ),
        (asc.replace(b" d 8 ", b" d x ", 1), "not a usable ASC log, or cut off: "),
    ):
        path.write_bytes(content)
        with pytest.raises(ServoDaemonError) as caught:
            read_capture(path)
        assert expected in str(caught.value)
        assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")
