"""Our own CAN frames: what goes wrong on a line, and that every good sample still arrives as it was taken."""

from __future__ import annotations

import re
from pathlib import Path

import cantools
import numpy as np
import pytest

from drivers.base import DriveInfo
from drivers.can.bus import CanDriver
from drivers.can.ours.own import MAX_HELD
from servo_daemon.errors import BadInputError
from servo_daemon.samples import Quality, make_block
from servo_daemon.sim_drive.can_frames import CanFrame, FrameEncoder
from tests.can_tools import COUNTS_PER_REV, LSB, Line, RampSource, batch, frames_of

SYNC, SAMPLE, DESCRIPTION = 0x101, 0x121, 0x681
DEPLOYED = Path(__file__).parents[2] / "deploy" / "servo.dbc"
DOCUMENT = Path(__file__).parents[2] / "docs" / "protocol-can.md"

PERIOD_S = 1e-3


def expected(source: RampSource, n: int):  # type: ignore[no-untyped-def]
    fresh = RampSource.__new__(RampSource)
    fresh.__dict__.update(source.__dict__, index=0)
    return fresh.next_block(n)


def assert_all_arrived(line: Line, source: RampSource, keep: np.ndarray) -> None:
    """The samples with these indexes, and only they, each with its own values."""
    truth = expected(source, int(keep[-1]) + 1)
    assert np.array_equal(line.joined("sequence") % 65_536, keep % 65_536)
    for name in ("time_s", "voltage_V", "current_A", "position_rad"):
        assert np.allclose(line.joined(name), getattr(truth, name)[keep], rtol=0, atol=1e-9), name


def test_frames_are_what_the_dbc_says() -> None:
    """The encoder against cantools and the DBC that users get, byte for byte."""
    database = cantools.database.load_file(DEPLOYED)
    info = DriveInfo("x", 1e-3, 4096.0, 0.002, 0.005)
    block = make_block(
        np.array([66.0]),
        voltage_V=np.array([12.34]),
        current_A=np.array([-1.5]),
        position_rad=np.array([70_000 * 2 * np.pi / 4096]),
    )
    frames = {
        f.data[0] if f.frame_id == DESCRIPTION else f.frame_id: f.data for f in FrameEncoder(info, 1).encode(block)
    }
    low, high = 70_000 & 0xFFFF, 70_000 - (70_000 & 0xFFFF)
    assert frames[SYNC] == database.encode_message("Sync", {"Time": 66_000_000, "SampleCount": 0, "PositionHigh": high})
    assert frames[SAMPLE] == database.encode_message(
        "Sample", {"Voltage": 2468, "Current": -750, "Position": low, "Time": 66_000_000 & 0xFFFF}
    )
    for page, values in enumerate(
        [{"WireVersion": 1, "SamplePeriod": 1e-3}, {"VoltageLsb": 0.005}, {"CurrentLsb": 0.002}, {"CountsPerRev": 4096}]
    ):
        assert frames[page] == database.encode_message("Description", {"Page": page, **values})


def test_the_example_of_the_document() -> None:
    """Written by hand in docs/protocol-can.md, with what it means."""
    block_of_frames = re.search(r"```candump\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), re.DOTALL)
    assert block_of_frames is not None
    frames = [(int(i, 16), d) for i, d in (line.split("#") for line in block_of_frames[1].split())]
    assert [i for i, _ in frames] == [DESCRIPTION] * 4 + [SYNC, SAMPLE, SAMPLE]
    line = Line()
    (block,) = line.decoder.feed(batch([(i, bytes.fromhex(d)) for i, d in frames], 100.0))
    assert block.time_s == pytest.approx([0.123456, 0.124456], abs=1e-12)
    assert block.sequence.tolist() == [5, 6]
    assert block.voltage_V == pytest.approx([12.0, 12.0])
    assert block.current_A == pytest.approx([-1.0, -0.999])
    assert block.position_rad == pytest.approx([-2 * 2 * np.pi / 4096, 0.0], abs=1e-12)
    assert block.quality.tolist() == [0, 0]


def test_every_sample_arrives_in_any_portions() -> None:
    source = RampSource()
    frames = frames_of(source, 3000)
    line = Line()
    line.hear_in_time(frames, PERIOD_S)
    assert_all_arrived(line, source, np.arange(3000))
    assert not line.joined("quality").any()
    assert line.counters.frames == len(frames)
    assert line.counters.samples_lost == 0
    assert line.decoder.info.sample_period_s == pytest.approx(PERIOD_S)
    assert line.decoder.info.counts_per_rev == COUNTS_PER_REV


def test_a_reader_attaches_at_any_time_and_loses_nothing_it_heard() -> None:
    source = RampSource(start_us=3_000_000, start_counts=-200_000)
    frames = [f for f in frames_of(source, 2500) if f.sample >= 317]
    line = Line()
    line.hear_in_time(frames, PERIOD_S)
    assert_all_arrived(line, source, np.arange(317, 2500))


@pytest.mark.parametrize("speed", [7, -3001, 32_767, -32_768])
def test_time_count_and_position_wrap(speed: int) -> None:
    """All 16-bit fields wrap many times, the 32-bit time and position once, forwards and in reverse."""
    start_us = 2**32 - 1_000_000
    source = RampSource(counts_per_sample=speed, start_us=start_us, start_counts=2**31 - 2_500 * abs(speed))
    line = Line()
    encoder = FrameEncoder(source.info, 1)
    frames = encoder.encode(source.next_block(6_000))
    line.hear_in_time(frames, PERIOD_S, together=20)
    time_s, position = line.joined("time_s"), line.joined("position_rad")
    assert np.allclose(np.diff(time_s), PERIOD_S, rtol=0, atol=1e-9)
    assert np.allclose(np.diff(position), speed * 2 * np.pi / COUNTS_PER_REV, rtol=0, atol=1e-6)
    assert len(time_s) == 6_000
    assert not line.joined("quality").any()
    assert line.counters.device_restarts == 0


def test_the_running_number_wraps() -> None:
    source = RampSource(period_s=1e-4)
    line = Line()
    line.hear_in_time(frames_of(source, 70_000), 1e-4, together=100)
    assert np.array_equal(line.joined("sequence"), np.arange(70_000))


@pytest.mark.parametrize("lost", [range(700, 701), range(700, 745), range(100, 101)])
def test_lost_frames_are_counted_and_marked(lost: range) -> None:
    source = RampSource()
    frames = [f for f in frames_of(source, 2000) if f.sample not in lost]
    line = Line()
    line.hear_in_time(frames, PERIOD_S)
    keep = np.array([k for k in range(2000) if k not in lost])
    assert_all_arrived(line, source, keep)
    marked = np.flatnonzero(line.joined("quality"))
    assert marked.tolist() == [lost.start]
    assert line.joined("quality")[lost.start] == Quality.GAP_BEFORE
    assert line.counters.samples_lost == len(lost)


@pytest.mark.parametrize("silent_s", [0.2, 3.0, 90.0])
def test_a_long_silence_is_a_gap_of_the_right_length(silent_s: float) -> None:
    """Longer than the 16-bit time, the 16-bit count (from 65 s on) and the 16-bit position can tell."""
    n = round(silent_s / PERIOD_S)
    source = RampSource(counts_per_sample=900)
    encoder = FrameEncoder(source.info, 1)
    line = Line()
    line.hear_in_time(encoder.encode(source.next_block(1500)), PERIOD_S)
    encoder.encode(source.next_block(n))
    line.host_s += silent_s
    line.hear_in_time(encoder.encode(source.next_block(500)), PERIOD_S)
    keep = np.concatenate([np.arange(1500), 1500 + n + np.arange(500)])
    assert_all_arrived(line, source, keep)
    assert line.counters.samples_lost == n
    assert np.flatnonzero(line.joined("quality")).tolist() == [1500]
    assert line.counters.device_restarts == 0


@pytest.mark.parametrize("stall_s", [0.06, 0.5, 5.0])
def test_a_stalled_host_loses_and_distorts_nothing(stall_s: float) -> None:
    """All frames wait in the adapter and come at once: no gap, whatever the host's clock says."""
    n = round(stall_s / PERIOD_S)
    source = RampSource()
    frames = frames_of(source, 2000 + n)
    line = Line()
    line.hear_in_time([f for f in frames if f.sample < 1500], PERIOD_S)
    line.hear([f for f in frames if 1500 <= f.sample < 1500 + n], stall_s)
    line.hear_in_time([f for f in frames if f.sample >= 1500 + n], PERIOD_S)
    assert_all_arrived(line, source, np.arange(2000 + n))
    assert not line.joined("quality").any()


def test_a_backlog_that_hides_a_gap_is_dated_right() -> None:
    """The queue of a stalled host overflowed: old frames come, then, at once, much newer ones."""
    source = RampSource()
    frames = frames_of(source, 4000)
    line = Line()
    line.hear_in_time([f for f in frames if f.sample < 1500], PERIOD_S)
    line.hear([f for f in frames if 1500 <= f.sample < 1770], 2.0)
    line.hear_in_time([f for f in frames if f.sample >= 3500], PERIOD_S)
    assert_all_arrived(line, source, np.concatenate([np.arange(1770), np.arange(3500, 4000)]))
    assert line.counters.samples_lost == 3500 - 1770
    assert line.counters.device_restarts == 0


def test_repeated_frames_are_delivered_once() -> None:
    source = RampSource()
    frames = frames_of(source, 2000)
    repeated = [g for f in frames for g in ([f, f] if f.sample % 100 in (0, 45, 50) else [f])]
    line = Line()
    line.hear_in_time(repeated, PERIOD_S)
    assert_all_arrived(line, source, np.arange(2000))
    assert line.counters.samples_repeated == 60
    assert not line.joined("quality").any()


def test_a_lost_sync_only_waits_for_the_next() -> None:
    source = RampSource()
    frames = [f for f in frames_of(source, 2000) if f.frame_id != SYNC or f.sample % 135 == 0]
    line = Line()
    line.hear_in_time(frames, PERIOD_S)
    assert_all_arrived(line, source, np.arange(2000))


@pytest.mark.parametrize("off_s", [0.0, 0.3, 8.0])
def test_a_restarted_device_is_told_and_its_time_starts_anew(off_s: float) -> None:
    source = RampSource()
    encoder = FrameEncoder(source.info, 1)
    line = Line()
    line.hear_in_time(encoder.encode(source.next_block(3000)), PERIOD_S)
    before = len(line.blocks)
    encoder.restart()
    line.host_s += off_s
    line.hear_in_time(encoder.encode(source.next_block(1200)), PERIOD_S)
    restarted = line.blocks[before]
    assert restarted.quality[0] == Quality.TIME_RESTART
    assert restarted.time_s[0] == pytest.approx(0.0, abs=1e-9)
    assert restarted.position_rad[0] == pytest.approx(0.0, abs=1e-9)
    assert line.counters.device_restarts == 1
    assert line.counters.samples_lost == 0
    assert np.array_equal(line.joined("sequence"), np.arange(4200))
    assert all((np.diff(b.time_s) > 0).all() for b in line.blocks)


def test_two_restarts_in_one_batch() -> None:
    source = RampSource()
    encoder = FrameEncoder(source.info, 1)
    frames: list[CanFrame] = []
    for n in (1500, 20, 400):
        frames += encoder.encode(source.next_block(n))
        encoder.restart()
    line = Line()
    blocks = line.hear(frames)
    assert [len(b) for b in blocks] == [1500, 20, 400]
    assert [int(b.quality[0]) for b in blocks] == [0, Quality.TIME_RESTART, Quality.TIME_RESTART]
    assert line.counters.device_restarts == 2


def test_what_is_not_measured_and_what_is_at_its_limit() -> None:
    info = DriveInfo("x", 1e-3, COUNTS_PER_REV, LSB, LSB)
    voltage = np.array([1.0, np.nan, 40.0, 1.0])
    current = np.array([1.0, 1.0, 1.0, -40.0])
    block = make_block(np.arange(4) * 1e-3, voltage_V=voltage, current_A=current, position_rad=np.zeros(4))
    line = Line()
    (out,) = line.hear(FrameEncoder(info, 1).encode(block))
    assert out.quality.tolist() == [0, Quality.VOLTAGE_INVALID, Quality.SATURATED, Quality.SATURATED]
    assert np.isnan(out.voltage_V[1])
    assert out.voltage_V[2] == pytest.approx(32.767)
    assert out.current_A[3] == pytest.approx(-32.767)


def test_counts_per_rev_can_be_said_otherwise() -> None:
    driver = CanDriver("axis1", {"interface": "virtual", "counts_per_rev": -100})
    source = RampSource()
    (block,) = driver._decoder.feed(batch([(f.frame_id, f.data) for f in frames_of(source, 10)], 1.0))
    assert block.position_rad == pytest.approx(-2 * np.pi / 100 * 7 * np.arange(10))
    assert driver.info.counts_per_rev == 100


def test_new_scales_hold_from_where_they_are_told() -> None:
    line = Line()
    first, second = (DriveInfo("x", 1e-3, COUNTS_PER_REV, lsb, lsb) for lsb in (1e-3, 4e-3))
    block = make_block(
        np.arange(100) * 1e-3, voltage_V=np.ones(100), current_A=np.ones(100), position_rad=np.zeros(100)
    )
    frames = FrameEncoder(first, 1).encode(block) + FrameEncoder(second, 1).encode(block)
    line.hear(frames)
    assert np.allclose(line.joined("voltage_V"), 1.0)
    assert line.decoder.info.voltage_lsb_V == pytest.approx(4e-3)


def test_a_short_frame_is_no_frame() -> None:
    source = RampSource()
    line = Line()
    frames = frames_of(source, 1200)
    frames.insert(500, CanFrame(SAMPLE, frames[500].data[:5], frames[500].sample))
    frames.insert(700, CanFrame(DESCRIPTION, b"\x00\x01", frames[700].sample))
    line.hear_in_time(frames, PERIOD_S)
    assert_all_arrived(line, source, np.arange(1200))
    assert line.counters.framing_errors == 2


def test_another_version_of_the_frames_is_refused_once_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
    line = Line()
    page = CanFrame(DESCRIPTION, bytes.fromhex("00 02 00 00 40 42 0F 00"), 0)
    for _ in range(3):
        line.hear([page])
    assert line.decoder.info.sample_period_s is None
    assert len(caplog.records) == 1
    assert "version 2" in caplog.text


def test_without_a_description_memory_stays_bounded() -> None:
    source = RampSource(period_s=1e-4)
    frames = [f for f in frames_of(source, MAX_HELD + 5000) if f.frame_id != DESCRIPTION]
    line = Line()
    line.hear_in_time(frames, 1e-4, together=100)
    assert not line.blocks
    assert line.counters.extra["samples_undated"] == 5000
    line.hear(frames_of(RampSource(period_s=1e-4), 1)[:4])
    assert len(line.joined("time_s")) == MAX_HELD


def test_drives_on_one_bus_do_not_mix() -> None:
    mine, other = RampSource(), RampSource(counts_per_sample=-1)
    line = Line(drive_id=31)
    frames = frames_of(mine, 1200, drive_id=31) + frames_of(other, 1200, drive_id=2)
    line.hear_in_time(sorted(frames, key=lambda f: f.sample), PERIOD_S)
    assert_all_arrived(line, mine, np.arange(1200))
    assert line.decoder.info.identity != Line(drive_id=2).decoder.info.identity


@pytest.mark.parametrize(("period_s", "drive_id"), [(0.1, 1), (None, 1), (0.0, 1), (1e-3, 0), (1e-3, 32)])
def test_a_drive_that_does_not_fit_is_refused(period_s: float | None, drive_id: int) -> None:
    with pytest.raises(BadInputError):
        FrameEncoder(DriveInfo("x", period_s), drive_id)
