"""The text wire: lines, wraps, unreadable ones, restarts."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from drivers.serial.text import MAX_LINE, TextDecoder, encode_lines
from servo_daemon.samples import Quality, SampleBlock, concatenate, make_block

PROTOCOL = Path(__file__).parents[3] / "docs" / "protocol.md"


def started(**options: float) -> TextDecoder:
    decoder = TextDecoder(4096.0, **options)  # type: ignore[arg-type]
    assert decoder.feed(b"half a li\n") is None
    return decoder


def fed(decoder: TextDecoder, *lines: str) -> SampleBlock:
    block = decoder.feed("".join(f"{line}\n" for line in lines).encode())
    assert block is not None
    return block


def counts_of(block: SampleBlock) -> list[int]:
    assert block.position_rad is not None
    return [int(c) for c in np.rint(block.position_rad * 4096 / (2 * np.pi))]


def test_the_example_of_the_document() -> None:
    match = re.search(r"```text\n(.*?)```", PROTOCOL.read_text(encoding="utf-8"), re.DOTALL)
    assert match is not None
    block = started().feed(match[1].encode(), host_time_s=3.0)
    assert block is not None
    assert block.time_s.tolist() == [0.001, 0.003]
    assert block.host_time_s == 3.0
    assert block.sequence.tolist() == [0, 1]
    assert block.voltage_V is not None and block.current_A is not None
    assert block.voltage_V.tolist() == [12.0, 12.0]
    assert block.current_A.tolist() == [0.25, -0.013]
    assert counts_of(block) == [0, -27]


def test_first_line_is_dropped_even_if_it_looks_whole() -> None:
    decoder = TextDecoder(4096.0)
    assert decoder.feed(b"9,1,2,3\n") is None
    assert decoder.counters.framing_errors == 0
    assert len(fed(decoder, "1000,1,2,3")) == 1


def test_line_ends_comments_and_empty_lines() -> None:
    decoder = started()
    block = fed(decoder, "1000,1,2,3\r", "# a comment", "", "\r", "2000,1,2,3")
    assert block.time_s.tolist() == [0.001, 0.002]
    assert decoder.counters.framing_errors == 0


def test_lines_may_come_in_pieces() -> None:
    decoder = started()
    assert decoder.feed(b"1000,1") is None
    assert decoder.feed(b"2,-3,") is None
    block = decoder.feed(b"40\n2000,")
    assert block is not None and len(block) == 1 and counts_of(block) == [40]


@pytest.mark.parametrize(
    "bad",
    [
        "x", "1000,1,2", "1000,1,2,3,4", "1 000,1,2,3", "1000,+1,2,3", "1000,1.5,2,3", "-5,1,2,3",
        "4294967296,1,2,3",
        "1500,2147483648,2,3", "1500,1,-2147483649,3", "1500,1,2,9999999999", "1500,,2,3", "nan,1,2,3",
    ],
)  # fmt: skip
def test_an_unreadable_line_is_a_lost_sample(bad: str) -> None:
    decoder = started()
    block = fed(decoder, "1000,1,2,3", bad, "2000,1,2,3")
    assert block.sequence.tolist() == [0, 2]
    assert block.quality.tolist() == [0, Quality.GAP_BEFORE]
    assert decoder.counters.framing_errors == 1
    assert decoder.counters.samples_lost == 1


def test_loss_is_remembered_over_reads() -> None:
    decoder = started()
    fed(decoder, "1000,1,2,3", "1500,1,2,9999999999")
    assert decoder.feed(b"junk\n") is None
    block = fed(decoder, "2500,1,2,3")
    assert block.sequence.tolist() == [3]
    assert block.quality.tolist() == [Quality.GAP_BEFORE]


def test_a_told_period_shows_holes() -> None:
    decoder = started(sample_period_s=1e-3)
    block = fed(decoder, "1000,1,2,3", "2100,1,2,3", "5000,1,2,3", "6000,1,2,3")
    assert block.sequence.tolist() == [0, 1, 4, 5]
    assert block.quality.tolist() == [0, 0, Quality.GAP_BEFORE, 0]
    assert decoder.counters.samples_lost == 2


def test_time_and_counter_wrap() -> None:
    block = fed(
        started(), "4294966796,1,2,2147483647", "500,1,2,-2147483648", "1500,1,2,-2147483640", "2500,1,2,2147483640"
    )
    np.testing.assert_allclose(np.diff(block.time_s), 1e-3, rtol=1e-9)
    assert not block.quality.any()
    assert np.diff(counts_of(block)).tolist() == [1, 8, -16]


def test_counter_of_an_absolute_encoder() -> None:
    block = fed(started(counts_modulus=4096), "1,1,2,4000", "2,1,2,100", "3,1,2,4095")
    assert counts_of(block) == [4000, 4196, 4095]


def test_repeated_lines_are_delivered_once() -> None:
    decoder = started()
    first = fed(decoder, "1000,1,2,3", "1000,1,2,3")
    assert decoder.feed(b"1000,1,2,3\n") is None
    second = fed(decoder, "1000,1,2,3", "2000,1,2,3")
    assert concatenate([first, second]).sequence.tolist() == [0, 1]
    assert decoder.counters.samples_repeated == 3


def test_restart() -> None:
    decoder = started()
    block = fed(decoder, "7000000,1,2,500", "7002000,1,2,510", "100,1,2,0", "2100,1,2,4")
    assert block.time_s.tolist() == [7.0, 7.002, 7.004, 7.006]
    assert block.sequence.tolist() == [0, 1, 2, 3]
    assert block.quality.tolist() == [0, 0, Quality.TIME_RESTART, 0]
    assert counts_of(block) == [500, 510, 0, 4]
    assert decoder.counters.device_restarts == 1


def test_restart_over_reads_and_reattach() -> None:
    decoder = started()
    fed(decoder, "7000000,1,2,500", "7002000,1,2,510")
    decoder.reattach()
    block = fed(decoder, "90,1", "100,1,2,7")
    assert block.time_s.tolist() == [7.004]
    assert block.quality.tolist() == [Quality.TIME_RESTART]
    assert counts_of(block) == [7]


@pytest.mark.parametrize("piece", [1, 13, 10_000])
def test_an_endless_line_is_dropped(piece: int) -> None:
    decoder = started()
    noise = b"7" * (50 * MAX_LINE)
    for at in range(0, len(noise), piece):
        assert decoder.feed(noise[at : at + piece]) is None
    assert decoder.feed(b"\n") is None
    assert len(fed(decoder, "1000,1,2,3")) == 1
    assert decoder.counters.framing_errors == 1


def test_encoder_is_read_back() -> None:
    t = 4294.0 + np.arange(2000) * 1e-3
    source = make_block(
        t, voltage_V=np.sin(t), current_A=-2 * np.cos(t), position_rad=1e6 + 30 * np.sin(t)
    )  # the time wraps, and so does the counter
    decoder = started()
    block = decoder.feed(encode_lines(source, 4096.0))
    assert block is not None and len(block) == 2000
    np.testing.assert_allclose(block.time_s, t, atol=1e-6)
    assert block.voltage_V is not None and block.current_A is not None and block.position_rad is not None
    assert source.voltage_V is not None and source.current_A is not None and source.position_rad is not None
    np.testing.assert_allclose(block.voltage_V, source.voltage_V, atol=0.51e-3)
    np.testing.assert_allclose(block.current_A, source.current_A, atol=0.51e-3)
    moved = block.position_rad - block.position_rad[0]
    np.testing.assert_allclose(moved, source.position_rad - source.position_rad[0], atol=2 * np.pi / 4096)
