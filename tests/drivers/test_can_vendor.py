"""Another maker's drive: messages at rates of their own, combined into samples."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.base import DriverCounters
from drivers.can.decode import EXTENDED, load_dbc
from drivers.can.map import parse_signal_map
from drivers.can.vendor import VendorDecoder
from servo_daemon.samples import Quality, SampleBlock
from tests.can_tools import batch

DBC = """
VERSION ""
NS_ :
BS_:
BU_: X
BO_ 256 Current: 2 X
 SG_ Motor : 7|16@0- (0.01,0) [0|0] "A" X
BO_ 257 Bridge: 2 X
 SG_ Duty : 0|16@1- (0.0001,0) [0|0] "" X
BO_ 258 Supply: 2 X
 SG_ Voltage : 0|16@1+ (0.1,0) [0|0] "V" X
BO_ 259 Feedback: 8 X
 SG_ Counts : 0|16@1+ (1,0) [0|0] "" X
 SG_ Tick : 16|32@1+ (1e-06,0) [0|0] "s" X
 SG_ Counter : 48|8@1+ (1,0) [0|0] "" X
BO_ 2147483908 Pose: 8 X
 SG_ Kind M : 0|8@1+ (1,0) [0|0] "" X
 SG_ Angle m1 : 32|32@1- (1,0) [0|0] "deg" X
 SG_ Speed m2 : 32|32@1- (1,0) [0|0] "rad/s" X
SIG_VALTYPE_ 2147483908 Angle : 1;
SIG_VALTYPE_ 2147483908 Speed : 1;
"""

CURRENT, BRIDGE, SUPPLY, FEEDBACK, POSE = 0x100, 0x101, 0x102, 0x103, 0x104 | EXTENDED
Frame = tuple[int, bytes, float]  # identifier, data, receive time


def current(value_A: float, at_s: float) -> Frame:
    return CURRENT, struct.pack(">h", round(value_A * 100)), at_s


def bridge(duty: float, at_s: float) -> Frame:
    return BRIDGE, struct.pack("<h", round(duty * 10_000)), at_s


def supply(volts: float, at_s: float) -> Frame:
    return SUPPLY, struct.pack("<H", round(volts * 10)), at_s


def feedback(counts: int, tick_us: int, at_s: float, counter: int = 0) -> Frame:
    return FEEDBACK, struct.pack("<HIBx", counts & 0xFFFF, tick_us & 0xFFFF_FFFF, counter & 0xFF), at_s


def pose(kind: int, value: float, at_s: float) -> Frame:
    return POSE, struct.pack("<Bxxxf", kind, value), at_s


class Drive:
    """A decoder with a map, fed with frames that arrive when their time stamps say."""

    def __init__(self, tmp_path: Path, signals: dict[str, Any], **options: Any) -> None:
        path = tmp_path / "vendor.dbc"
        path.write_text(DBC)
        trigger = options.pop("trigger", None)
        self.counters = DriverCounters()
        mapped = parse_signal_map(signals, load_dbc(path), "test", trigger)
        self.decoder = VendorDecoder(mapped, self.counters, **options)

    def hear(self, frames: list[Frame], wall_minus_host_s: float = 0.0) -> list[SampleBlock]:
        stamps = [at for _, _, at in frames]
        host_s = stamps[-1] - wall_minus_host_s
        return self.decoder.feed(batch([(i, d) for i, d, _ in frames], host_s, stamps, host_s + wall_minus_host_s))


FULL: dict[str, Any] = {
    "position_counts": "Feedback.Counts",
    "time_s": "Feedback.Tick",
    "current_A": "Current.Motor",
    "voltage_V": {"formula": "Duty * Supply", "Duty": "Bridge.Duty", "Supply": "Supply.Voltage"},
}


def test_the_position_makes_the_sample_and_the_rest_is_held(tmp_path: Path) -> None:
    drive = Drive(tmp_path, FULL, counts_per_rev=4096)
    frames = [supply(24, 0.0), bridge(0.5, 0.0), current(1.5, 0.001)]
    frames += [feedback(10, 1000, 0.002), feedback(11, 2000, 0.003), current(-2, 0.0035)]
    (block,) = drive.hear([*frames, feedback(12, 3000, 0.004), bridge(-1, 0.0045)])
    (after,) = drive.hear([feedback(13, 4000, 0.005)])
    assert block.time_s == pytest.approx([0.001, 0.002, 0.003])
    assert block.current_A == pytest.approx([1.5, 1.5, -2.0])
    assert block.voltage_V == pytest.approx([12.0, 12.0, 12.0])
    assert block.position_rad == pytest.approx(np.array([10, 11, 12]) * 2 * np.pi / 4096)
    assert block.quality.tolist() == [0, 0, 0]
    assert after.voltage_V == pytest.approx([-24.0])
    assert after.sequence.tolist() == [3]
    assert drive.counters.frames == 9


def test_what_was_never_heard_or_too_long_ago_is_invalid(tmp_path: Path) -> None:
    signals = FULL | {"temperature_C": "Supply.Voltage", "velocity_rad_s": {"signal": "Bridge.Duty", "stale_s": 0.02}}
    drive = Drive(tmp_path, signals, counts_per_rev=4096, stale_s=0.05)
    frames = [feedback(0, 0, 0.0), current(1, 0.001), bridge(1, 0.001), feedback(1, 10_000, 0.01)]
    frames += [supply(10, 0.011), feedback(2, 20_000, 0.02), feedback(3, 30_000, 0.03), feedback(4, 60_000, 0.06)]
    (block,) = drive.hear(frames)
    voltage, both = int(Quality.VOLTAGE_INVALID), int(Quality.VOLTAGE_INVALID | Quality.CURRENT_INVALID)
    assert block.quality.tolist() == [both, voltage, 0, 0, both]
    assert np.isnan(block.voltage_V).tolist() == [True, True, False, False, True]
    assert np.isnan(block.current_A).tolist() == [True, False, False, False, True]
    assert np.isnan(block.velocity_rad_s).tolist() == [True, False, False, True, True]
    assert np.isnan(block.temperature_C).tolist() == [True, True, False, False, False]


def test_device_time_counter_and_position_wrap(tmp_path: Path) -> None:
    drive = Drive(tmp_path, {**FULL, "sequence": "Feedback.Counter"}, counts_per_rev=1000)
    start = 2**32 - 2_000_000
    k = np.arange(4000)
    frames = [feedback(-300 * i, start + 1000 * i, 0.001 * i, i) for i in k.tolist()]
    blocks = [b for a in range(0, 4000, 13) for b in drive.hear(frames[a : a + 13])]
    time_s = np.concatenate([b.time_s for b in blocks])
    position = np.concatenate([b.position_rad for b in blocks])
    assert np.allclose(time_s - time_s[0], 0.001 * k, rtol=0, atol=1e-9)
    assert np.allclose(position - position[0], -300 * k * 2 * np.pi / 1000)
    assert np.array_equal(np.concatenate([b.sequence for b in blocks]), k)
    assert drive.counters.samples_lost == drive.counters.device_restarts == 0


def test_an_angle_that_wraps_by_its_map(tmp_path: Path) -> None:
    turn = {"signal": "Pose.Angle", "scale": np.pi / 180, "wrap": 2 * np.pi}
    drive = Drive(tmp_path, {"position_rad": turn, "velocity_rad_s": "Pose.Speed"})
    degrees = np.arange(0, -2000, -35)
    frames = [f for i, d in enumerate(degrees) for f in (pose(2, 0.5, i * 0.01), pose(1, d % 360, i * 0.01 + 0.001))]
    frames.insert(9, pose(1, float("nan"), 0.0405))
    (block,) = drive.hear(frames)
    valid = np.isfinite(block.position_rad)
    assert np.count_nonzero(~valid) == 1
    assert block.quality[~valid] == Quality.POSITION_INVALID
    assert block.position_rad[valid] == pytest.approx(np.radians(degrees), abs=1e-4)
    assert block.velocity_rad_s == pytest.approx(np.full(len(block), 0.5))


def test_losses_by_the_drives_own_counter(tmp_path: Path) -> None:
    drive = Drive(tmp_path, {**FULL, "sequence": "Feedback.Counter"}, counts_per_rev=1000)
    kept = [i for i in range(600) if i not in (100, 101, 102, 300)]
    repeated = sorted([*kept, 50, 51])
    blocks = drive.hear([feedback(i, 1000 * i, 0.001 * i, i) for i in repeated])
    (block,) = blocks
    assert block.sequence.tolist() == kept
    assert np.flatnonzero(block.quality & int(Quality.GAP_BEFORE)).tolist() == [100, 297]
    assert (drive.counters.samples_lost, drive.counters.samples_repeated) == (4, 2)


def test_losses_by_the_sample_period(tmp_path: Path) -> None:
    drive = Drive(tmp_path, FULL, counts_per_rev=1000, period_s=0.001)
    kept = [i for i in range(300) if i not in (100, 101, 102)]
    (block,) = drive.hear([feedback(i, 1000 * i, 0.001 * i) for i in kept])
    assert block.sequence.tolist() == kept
    assert drive.counters.samples_lost == 3


def test_a_restart_starts_a_new_block(tmp_path: Path) -> None:
    drive = Drive(tmp_path, {**FULL, "sequence": "Feedback.Counter"}, counts_per_rev=1000)
    drive.hear([feedback(60_000 + i, 5_000_000 + 1000 * i, 0.001 * i, i) for i in range(50)])
    frames = [feedback(60_050, 5_050_000, 0.05, 50)]
    frames += [feedback(5 + i, 1000 * i, 0.3 + 0.001 * i, i) for i in range(10)]
    before, after = drive.hear(frames)
    assert len(before) == 1
    assert after.quality[0] & Quality.TIME_RESTART
    assert after.time_s[0] == 0.0
    assert after.position_rad[0] == pytest.approx(5 * 2 * np.pi / 1000)
    assert after.sequence[0] == before.sequence[-1] + 1
    assert drive.counters.device_restarts == 1


def test_without_device_time_the_receive_stamps_count(tmp_path: Path) -> None:
    signals = {"position_counts": "Feedback.Counts", "current_A": "Current.Motor"}
    drive = Drive(tmp_path, signals, counts_per_rev=1000)
    stamps = [7.0, 7.001, 7.001, 7.0005, 7.004, 7.3]
    (block,) = drive.hear([feedback(i, 0, at) for i, at in enumerate(stamps)])
    assert block.time_s == pytest.approx([0, 0.001, 0.001, 0.001, 0.004, 0.3], abs=1e-5)
    assert (np.diff(block.time_s) > 0).all()
    assert np.flatnonzero(block.quality & int(Quality.GAP_BEFORE)).tolist() == [5]


@pytest.mark.parametrize("step_s", [-3600.0, -0.2, 0.2, 3600.0])
def test_a_step_of_the_hosts_clock_does_not_reach_the_samples(tmp_path: Path, step_s: float) -> None:
    """NTP sets the clock that stamps the frames, in the middle of a batch."""
    signals = {"position_counts": "Feedback.Counts", "current_A": "Current.Motor"}
    drive = Drive(tmp_path, signals, counts_per_rev=1000)

    def frames(first: int, last: int, shift_s: float) -> list[Frame]:
        made = []
        for i in range(first, last):
            at = 1e9 + 0.001 * i + shift_s
            made += [current(1, at), feedback(i, 0, at)]
        return made

    blocks = drive.hear(frames(0, 100, 0.0))
    blocks += drive.hear(frames(100, 150, 0.0) + frames(150, 200, step_s), wall_minus_host_s=step_s)
    blocks += drive.hear(frames(200, 300, step_s), wall_minus_host_s=step_s)
    time_s = np.concatenate([b.time_s for b in blocks])
    assert np.allclose(time_s, 0.001 * np.arange(300), rtol=0, atol=2e-3)
    assert (np.diff(time_s) > 0).all()
    quality = np.concatenate([b.quality for b in blocks])
    assert np.flatnonzero(quality).tolist() == [150]
    assert quality[150] == Quality.GAP_BEFORE


def test_a_host_that_stalls_is_no_clock_step(tmp_path: Path) -> None:
    drive = Drive(tmp_path, {"position_counts": "Feedback.Counts"}, counts_per_rev=1000)
    drive.hear([feedback(i, 0, 0.001 * i) for i in range(100)])
    late = [(FEEDBACK, feedback(i, 0, 0)[1]) for i in range(100, 200)]
    (block,) = drive.decoder.feed(batch(late, 5.0, [0.001 * i for i in range(100, 200)], 5.0))
    assert block.time_s == pytest.approx(0.001 * np.arange(100, 200))
    assert not block.quality.any()


def test_with_a_known_period_bunched_stamps_become_a_steady_cadence(tmp_path: Path) -> None:
    """As a USB adapter delivers: eight frames at once, every 8 ms, and a gap of half a second."""
    signals = {"position_counts": "Feedback.Counts"}
    drive = Drive(tmp_path, signals, counts_per_rev=1000, period_s=0.001)
    kept = [i for i in range(20_000) if not 10_000 <= i < 10_500]
    frames = [feedback(i, 0, 0.0010001 * 8 * (i // 8 + 1) + 3e-5 * (i % 8)) for i in kept]
    blocks = [b for a in range(0, len(frames), 40) for b in drive.hear(frames[a : a + 40])]
    time_s = np.concatenate([b.time_s for b in blocks])
    error_s = time_s - 0.0010001 * np.array(kept)
    for first, end in ((3000, 10_000), (13_500, 19_500)):
        settled = slice(first, end)
        assert np.ptp(error_s[settled]) < 1e-4
        assert np.ptp(np.diff(time_s[settled])) < 2e-5
    assert np.ptp(error_s) < 0.016  # a gap is only as long as the bunches at its ends tell
    assert drive.counters.samples_lost == pytest.approx(500, abs=8)
    quality = np.concatenate([b.quality for b in blocks])
    assert np.flatnonzero(quality).tolist() == [kept.index(10_500)]


def test_the_trigger_can_be_chosen(tmp_path: Path) -> None:
    drive = Drive(tmp_path, {"position_counts": "Feedback.Counts", "current_A": "Current.Motor"}, counts_per_rev=10,
                  trigger="Current")  # fmt: skip
    (block,) = drive.hear([feedback(5, 0, 0.0), current(1, 0.01), current(2, 0.02), feedback(6, 0, 0.021)])
    assert block.current_A == pytest.approx([1, 2])
    assert len(block) == 2


def test_short_frames_are_counted_and_passed_over(tmp_path: Path) -> None:
    drive = Drive(tmp_path, FULL, counts_per_rev=1000)
    cut = (FEEDBACK, b"\x01\x02\x03", 0.001)
    (block,) = drive.hear([feedback(0, 0, 0.0), cut, (CURRENT, b"\x00", 0.001), feedback(1, 1000, 0.002)])
    assert len(block) == 2
    assert drive.counters.framing_errors == 2
    assert drive.hear([cut]) == []
