"""The binary decoder: scales, attaching late, losses, repetitions, wraps, restarts, garbage."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivers.base import DriverCounters
from drivers.serial.decoder import BinaryDecoder
from drivers.serial.frame import MAX_ENCODED, encode_frame
from drivers.serial.wire import Channel, Description, Quantity, encode_samples
from servo_daemon.samples import Quality, SampleBlock, concatenate
from tests.wire_tools import PERIOD_US, SERVO, describe, frame, frames, with_position


def started(description: Description = SERVO) -> BinaryDecoder:
    decoder = BinaryDecoder()
    assert decoder.feed(describe(description)) is None
    return decoder


def fed(decoder: BinaryDecoder, *parts: bytes) -> SampleBlock:
    block = decoder.feed(b"".join(parts))
    assert block is not None
    return block


def assert_time_and_sequence_increase(block: SampleBlock) -> None:
    assert (np.diff(block.time_s) > 0).all()
    assert (np.diff(block.sequence) > 0).all()


def test_values_come_in_their_units() -> None:
    block = started().feed(frame(100, n=3), host_time_s=12.5)
    assert block is not None
    assert block.time_s.tolist() == [0.1, 0.101, 0.102]
    assert block.sequence.tolist() == [100, 101, 102]
    assert block.host_time_s == 12.5
    assert block.quality.tolist() == [0, 0, 0]
    assert block.voltage_V is not None and block.current_A is not None and block.position_rad is not None
    np.testing.assert_allclose(block.voltage_V, [0.1, 0.101, 0.102], rtol=1e-14)
    np.testing.assert_allclose(block.current_A, [-0.05, -0.0505, -0.051], rtol=1e-14)
    np.testing.assert_allclose(block.position_rad, np.array([300, 303, 306]) * 2 * np.pi / 4096, rtol=1e-14)


def test_every_quantity_has_its_channel_and_unknown_ones_are_skipped() -> None:
    quantities = (1, 2, 3, 4, 5, 6, 9, 200)
    described = replace(SERVO, channels=tuple(Channel(q, 2, 2.0, 0.5) for q in quantities))
    decoder = started(described)
    columns = [np.array([10 * q]) for q in (1, 2, 3, 4, 5, 6, 9, 20)]
    block = fed(decoder, encode_frame(encode_samples(described, 0, np.array([0]), columns)))
    assert block.channels == (
        "voltage_V", "current_A", "position_rad", "velocity_rad_s", "temperature_C", "torque_Nm",
    )  # fmt: skip
    assert [float(getattr(block, c)[0]) for c in block.channels] == [
        20.5, 40.5, pytest.approx(0.5 + np.pi * 30), 80.5, 100.5, 120.5,
    ]  # fmt: skip


def test_only_the_quality_bits_of_a_status_byte_pass() -> None:
    block = fed(started(), frame(0, n=1, status=0xFF))
    assert block.quality[0] == (
        Quality.VOLTAGE_INVALID | Quality.CURRENT_INVALID | Quality.POSITION_INVALID | Quality.SATURATED
    )


def test_frames_before_the_description_are_decoded_when_it_comes() -> None:
    decoder = BinaryDecoder()
    assert decoder.feed(b"".join(frames(0, 1000))) is None
    block = fed(decoder, describe(), frame(1000))
    assert block.sequence.tolist() == list(range(1010))
    assert decoder.counters.samples_lost == 0
    assert decoder.counters.extra["frames_undescribed"] == 0


def test_frames_that_never_get_a_description_do_not_pile_up() -> None:
    decoder = BinaryDecoder()
    one = frame(0, n=60)
    count = 3 * 256 * 1024 // len(one)
    for _ in range(count):
        assert decoder.feed(one) is None
    given_up = decoder.counters.extra["frames_undescribed"]
    assert count // 2 < given_up < count
    block = fed(decoder, describe())
    assert len(block) == 60  # all of them repeat the first
    assert decoder.counters.samples_repeated == count - given_up - 1


def test_attaching_within_a_frame_is_no_error() -> None:
    decoder = BinaryDecoder()
    assert fed(decoder, describe()[20:], describe(), frame(0)).sequence[0] == 0
    assert (decoder.counters.crc_errors, decoder.counters.framing_errors) == (0, 0)


def test_a_lost_frame_is_a_gap() -> None:
    decoder = started()
    block = fed(decoder, frame(0), frame(30), frame(40))
    assert block.sequence.tolist() == [*range(10), *range(30, 50)]
    assert np.flatnonzero(block.quality).tolist() == [10]
    assert block.quality[10] == Quality.GAP_BEFORE
    assert block.time_s[10] == 0.03
    assert decoder.counters.samples_lost == 20
    assert decoder.counters.device_restarts == 0


@pytest.mark.parametrize("in_one_read", [True, False])
def test_a_repeated_frame_is_delivered_once(in_one_read: bool) -> None:
    decoder = started()
    wire = [frame(0), frame(0), frame(10), frame(20), frame(10), frame(20), frame(30)]
    parts = [decoder.feed(b"".join(wire))] if in_one_read else [decoder.feed(w) for w in wire]
    block = concatenate([b for b in parts if b is not None])
    assert block.sequence.tolist() == list(range(40))
    assert not block.quality.any()
    assert decoder.counters.samples_repeated == 3
    assert decoder.counters.samples_lost == 0


@pytest.mark.parametrize("in_one_read", [True, False])
@pytest.mark.parametrize("burst", [1, 5])
def test_old_frames_that_come_once_more_are_no_losses(burst: int, in_one_read: bool) -> None:
    """Long after the last 32, alone or several in a row (which begins as a restart would)."""
    decoder = started()
    wire = [frame(10 * k) for k in range(400)]
    replayed = []
    for k, live in enumerate(wire):
        replayed.append(live)
        if k in (100, 200, 300):
            replayed += wire[k - 60 : k - 60 + burst]
    parts = [decoder.feed(b"".join(replayed))] if in_one_read else [decoder.feed(w) for w in replayed]
    block = concatenate([b for b in parts if b is not None])
    assert_time_and_sequence_increase(block)
    assert decoder.counters.samples_lost == 0
    assert decoder.counters.device_restarts == (0 if burst == 1 else 3)
    assert len(block) + 10 * decoder.counters.samples_repeated == 10 * len(replayed)
    if burst == 1:
        assert block.sequence.tolist() == list(range(4000)) and not block.quality.any()


def test_a_damaged_frame_is_counted_and_the_next_is_read() -> None:
    decoder = started()
    damaged = bytearray(frame(10))
    damaged[30] ^= 0x40
    block = fed(decoder, frame(0), bytes(damaged), frame(20))
    assert block.sequence.tolist() == [*range(10), *range(20, 30)]
    assert decoder.counters.crc_errors == 1
    assert decoder.counters.samples_lost == 10


def test_half_a_frame_takes_the_next_with_it_and_no_more() -> None:
    decoder = started()
    block = fed(decoder, frame(0), frame(10)[:40], frame(20), frame(30))
    assert block.sequence.tolist() == [*range(10), *range(30, 40)]
    assert decoder.counters.crc_errors + decoder.counters.framing_errors == 1


@pytest.mark.parametrize("piece", [1, 7, 1000, 100_000])
def test_an_endless_run_without_delimiter_is_counted_once(piece: int) -> None:
    decoder = started()
    noise = b"\x55" * (20 * MAX_ENCODED)
    for at in range(0, len(noise), piece):
        assert decoder.feed(noise[at : at + piece]) is None
    assert fed(decoder, b"\0", frame(0)).sequence[0] == 0
    assert decoder.counters.framing_errors == 1
    assert decoder.counters.crc_errors == 0


def test_sequence_and_time_wrap() -> None:
    decoder = started()
    first = 2**32 - 15
    wire = [frame(first + k, start_us=2**32 - 5_000 + PERIOD_US * k, counts=[k] * 10) for k in range(0, 100, 10)]
    block = fed(decoder, *wire)
    assert block.sequence.tolist() == list(range(first, first + 100))
    np.testing.assert_allclose(np.diff(block.time_s), 1e-3, rtol=1e-9)
    assert not block.quality.any()


@pytest.mark.parametrize("gap_s", [1, 60, 2000, 2200, 4294, 4296, 3 * 3600, 23 * 3600])
def test_time_is_right_after_a_gap_of_any_number_of_turns(gap_s: int) -> None:
    decoder = started()
    after = 10 + gap_s * 1000
    block = fed(decoder, frame(0), frame(after))
    assert block.time_s[10] == pytest.approx(after * 1e-3, abs=1e-9)
    assert block.sequence[10] == after
    assert block.quality[10] == Quality.GAP_BEFORE
    assert decoder.counters.samples_lost == gap_s * 1000


def test_sequence_wraps_within_a_gap() -> None:
    block = fed(started(), frame(2**32 - 10, start_us=0), frame(20, start_us=40_000))
    assert block.sequence[10] == 2**32 + 20
    assert block.time_s[10] == 0.04


def test_a_pause_of_the_device_is_not_a_loss() -> None:
    decoder = started()
    block = fed(decoder, frame(0), frame(10, start_us=1_800_000_000))
    assert block.time_s[10] == 1800.0
    assert not block.quality.any()


@pytest.mark.parametrize(
    ("second_first", "second_us"),
    [(0, 0), (0, 5_000_000), (3_000_000_000, 0), (500_000_000, 1_100_000)],
    ids=["both back", "sequence back", "sequence anywhere, time back", "sequence ahead of what time allows"],
)
def test_a_restart_is_flagged_and_time_goes_on(second_first: int, second_us: int) -> None:
    decoder = started()
    before = frame(1000, counts=list(range(5000, 5010)))
    after = [frame(second_first + k, start_us=second_us + 1000 * k, counts=list(range(k, k + 10))) for k in (0, 10)]
    block = fed(decoder, before, *after)
    assert_time_and_sequence_increase(block)
    assert np.flatnonzero(block.quality).tolist() == [10]
    assert block.quality[10] == Quality.TIME_RESTART
    assert block.time_s[10] == pytest.approx(1.010)
    assert block.sequence[10] == 1010
    assert block.position_rad is not None
    counts = np.rint(block.position_rad * 4096 / (2 * np.pi))
    assert counts.tolist() == [*range(5000, 5010), *range(20)]
    assert decoder.counters.device_restarts == 1
    assert decoder.counters.samples_lost == 0


def test_a_new_session_is_a_restart_even_if_the_numbers_could_be_a_gap() -> None:
    decoder = started()
    again = replace(SERVO, session=2)
    block = fed(decoder, frame(0), frame(20, description=again), describe(again), frame(30, description=again))
    assert block.quality.tolist() == [*[0] * 10, Quality.TIME_RESTART, *[0] * 19]
    assert block.sequence.tolist() == list(range(30))
    assert decoder.counters.device_restarts == 1


def test_a_new_description_while_running_is_no_restart() -> None:
    decoder = started()
    finer = replace(SERVO, session=2, channels=(Channel(1, 2, 0.001), Channel(2, 2, 0.0001), *SERVO.channels[2:]))
    block = fed(decoder, frame(0), describe(finer), frame(10, description=finer))
    assert block.sequence.tolist() == list(range(20))
    assert not block.quality.any()
    assert block.current_A is not None
    assert block.current_A[[9, 10]].tolist() == [pytest.approx(-0.0045), pytest.approx(-0.0010)]


def test_other_channels_come_as_a_block_of_their_own() -> None:
    decoder = started()
    fewer = replace(SERVO, session=2, channels=SERVO.channels[:2])
    wire = encode_frame(encode_samples(fewer, 10, np.array([10_000]), [np.array([1]), np.array([2])]))
    first = fed(decoder, frame(0), describe(fewer), wire)
    assert first.channels == ("voltage_V", "current_A", "position_rad") and len(first) == 10
    assert decoder.has_ready
    second = fed(decoder, b"")
    assert second.channels == ("voltage_V", "current_A") and second.sequence.tolist() == [10]
    assert not decoder.has_ready


@pytest.mark.parametrize(
    ("position", "modulus", "shown"),
    [
        (Channel(Quantity.POSITION, 4, 4096.0), 0, 2**32),
        (Channel(Quantity.POSITION, 2, 4096.0), 0, 2**16),
        (Channel(Quantity.POSITION, 3, 4096.0), 0, 2**16),
        (Channel(Quantity.POSITION, 3, 4096.0), 4096, 4096),
        (Channel(Quantity.POSITION, 1, 4096.0), 0, 2**8),
        (Channel(Quantity.POSITION, 4, -3600.0), 3600, 3600),
    ],
)
def test_position_is_continuous_over_wraps_and_reversals(position: Channel, modulus: int, shown: int) -> None:
    described = with_position(SERVO, position, position_modulus=modulus)
    k = np.arange(400)
    largest_step = shown // 2 - 1
    true = np.cumsum(np.rint(0.999 * largest_step * np.sin(2 * np.pi * k / 130)).astype(np.int64)) + shown // 3
    raw = true % shown
    parts = [frame(int(j), description=described, counts=raw[j : j + 10].tolist()) for j in range(0, 400, 10)]
    blocks = [fed(decoder, part) for decoder in [started(described)] for part in parts]
    result = concatenate(blocks).position_rad
    assert result is not None
    counts = np.rint(result * position.scale / (2 * np.pi)).astype(np.int64)
    assert counts[0] % shown == raw[0]
    assert np.array_equal(counts - counts[0], true - true[0])


def test_only_the_wanted_drive_is_read() -> None:
    other = replace(SERVO, drive_id=8)
    decoder = BinaryDecoder(drive_id=8)
    block = fed(decoder, describe(), frame(0), describe(other), frame(40, description=other), frame(10))
    assert block.sequence.tolist() == list(range(40, 50))
    assert decoder.counters.unknown_frames == 3


def test_without_a_wanted_drive_it_is_the_first_that_describes_itself() -> None:
    other = replace(SERVO, drive_id=8)
    decoder = BinaryDecoder()
    block = fed(
        decoder, frame(90, description=other), describe(), describe(other), frame(0), frame(100, description=other)
    )
    assert block.sequence.tolist() == list(range(10))
    assert decoder.counters.unknown_frames == 3


def test_well_formed_frames_that_are_not_ours_are_counted() -> None:
    decoder = started()
    long = bytearray(encode_samples(SERVO, 0, np.array([0]), [np.array([0])] * 4)) + b"\1"
    block = fed(
        decoder,
        encode_frame(b"\x63hello"),  # unknown type
        encode_frame(b"\x01\x07"),  # a sample frame without its header
        encode_frame(bytes(long)),  # a byte too many
        encode_frame(bytes([1, 7, 1, 0]) + bytes(8)),  # no samples
        frame(0),
    )
    assert len(block) == 10
    assert decoder.counters.unknown_frames == 1
    assert decoder.counters.framing_errors == 3


def test_a_frame_in_which_time_stands_still_is_dropped() -> None:
    payload = bytearray(encode_samples(SERVO, 10, np.array([10_000, 11_000]), [np.array([1, 2])] * 4))
    record = SERVO.record.itemsize
    payload[12 + record : 14 + record] = b"\0\0"
    decoder = started()
    block = fed(decoder, frame(0, n=2), encode_frame(bytes(payload)), frame(20, n=2))
    assert block.sequence.tolist() == [0, 1, 20, 21]
    assert decoder.counters.framing_errors == 1


def test_first_record_may_carry_a_step() -> None:
    payload = bytearray(encode_samples(SERVO, 0, np.array([10_000, 11_000]), [np.array([1, 2])] * 4))
    payload[12:14] = b"\x05\x00"
    block = fed(started(), encode_frame(bytes(payload)))
    assert block.time_s.tolist() == [0.010005, 0.011005]


def test_jittered_sampling_keeps_its_times() -> None:
    t_us = np.array([0, 900, 2_100, 2_101, 67_636])
    columns = [np.zeros(5, dtype=np.int64)] * 4
    block = fed(started(), encode_frame(encode_samples(SERVO, 0, t_us, columns)))
    assert block.time_s.tolist() == [0.0, 0.0009, 0.0021, 0.002101, 0.067636]


class TestReattach:
    """The line was closed and opened again."""

    def test_the_same_device_continues(self) -> None:
        decoder = started()
        fed(decoder, frame(0), frame(10)[:20])
        decoder.reattach()
        assert decoder.description is None
        assert decoder.feed(frame(50)[7:] + frame(60)) is None
        block = fed(decoder, describe())
        assert block.sequence.tolist() == list(range(60, 70))
        assert block.quality[0] == Quality.GAP_BEFORE
        assert block.time_s[0] == 0.06
        assert decoder.counters.samples_lost == 50
        assert (decoder.counters.crc_errors, decoder.counters.framing_errors) == (0, 0)

    @pytest.mark.parametrize("change", [{"session": 9}, {"identity": "OTHER"}, {"drive_id": 8}])
    def test_another_device_is_a_restart(self, change: dict[str, object]) -> None:
        other = replace(SERVO, **change)  # type: ignore[arg-type]
        decoder = started()
        before = fed(decoder, frame(0))
        decoder.reattach()
        block = fed(decoder, describe(other), frame(500, description=other))
        assert block.quality[0] == Quality.TIME_RESTART
        assert block.time_s[0] > before.time_s[-1]
        assert block.sequence[0] == 10


def test_the_given_counters_are_used() -> None:
    counters = DriverCounters()
    decoder = BinaryDecoder(counters=counters)
    decoder.feed(describe() + frame(0) + frame(20))
    assert counters.frames == 3 and counters.samples_lost == 10
