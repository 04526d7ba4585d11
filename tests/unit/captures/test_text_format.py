"""The text wire beyond its default: named columns, floats, separators, pairs, lines that cannot be read."""

from __future__ import annotations

import math

import numpy as np
import pytest

from drivers.serial.line import SerialDriver
from drivers.serial.text import TextDecoder
from drivers.serial.text_format import DEFAULT, named_format, pair_format
from servo_daemon.errors import DriverConfigError
from servo_daemon.samples import Quality, SampleBlock


def decoded(*lines: str, counts_per_rev: float | None = 2400.0, **options: object) -> SampleBlock:
    decoder = TextDecoder(counts_per_rev, **options)  # type: ignore[arg-type]
    block = decoder.feed("".join(f"{line}\r\n" for line in ("half a li", *lines)).encode())
    assert block is not None, decoder.unread
    return block


@pytest.mark.parametrize(
    "lines",
    [
        ("t_us,mV,mA,counts", "1000,12000,250,0", "3000,12000,-13,-27"),
        ("t_us;V;A;counts", "1000;12.00;0.250;0", "3000;12.0;-.013;-27"),
        ("t_ms\tV\tmA\tenc", "1\t12\t250.0\t0", "3\t12\t-13.0\t-27"),
        ("time_s, V, A, counts", "0.001, 12.0, 0.25, 0", "3e-3, 12.0, -0.013, -27"),
        ("# t_us V A counts", "1000 12 0.25 0", "3000 12 -0.013 -27"),
        ("state,t_us,V,A,counts,loop_us", "1,1000,12.0,0.25,0,80", "1,3000,12.0,-0.013,-27,81"),
        ("t_us:1000,V:12.0,A:0.25,counts:0", "t_us:3000,V:12,A:-0.013,counts:-27"),
        ("t_us=1000 V=12.0 A=0.25 enc=0", "t_us=3000 V=12 A=-0.013 enc=-27"),
        ("1000;12000;250;0", "3000;12000;-13;-27"),
    ],
)
def test_the_same_samples_however_they_are_printed(lines: tuple[str, ...]) -> None:
    block = decoded(*lines)
    assert block.voltage_V is not None and block.current_A is not None and block.position_rad is not None
    np.testing.assert_allclose(block.time_s, [0.001, 0.003], atol=1e-9)
    np.testing.assert_allclose(block.voltage_V, [12.0, 12.0])
    np.testing.assert_allclose(block.current_A, [0.25, -0.013])
    np.testing.assert_allclose(block.position_rad, [0.0, -27 * 2 * math.pi / 2400], atol=1e-12)
    assert not block.quality.any()


def test_other_quantities_and_no_counts() -> None:
    block = decoded("millis,V,rpm,angle_deg", "1,12,60,90", "2,12,30,91", counts_per_rev=None)
    assert block.channels == ("voltage_V", "position_rad", "velocity_rad_s")
    assert block.velocity_rad_s is not None and block.position_rad is not None
    np.testing.assert_allclose(block.velocity_rad_s, [2 * math.pi, math.pi])
    np.testing.assert_allclose(block.position_rad, np.radians([90, 91]))


def test_millis_wrap_at_32_bits_of_their_own() -> None:
    block = decoded("t_ms,V,A,counts", f"{2**32 - 1},1,1,0", "1,1,1,1", "3,1,1,2")
    np.testing.assert_allclose(np.diff(block.time_s), 2e-3, rtol=1e-6)
    assert not block.quality.any()


def test_lines_without_a_time_need_a_period() -> None:
    lines = ("V:12.0,A:0.25,enc:0", "V:12.0,A:0.2#,enc:0", "motor ready", "V:12.0,A:0.25,enc:0")
    block = decoded(*lines, sample_period_s=0.002)
    assert block.time_s.tolist() == [0.0, 0.004]  # equal lines are two samples, the spoilt one a third, a message none
    assert block.quality.tolist() == [0, Quality.GAP_BEFORE]
    decoder = TextDecoder(2400.0)
    assert decoder.feed("\n".join(["", *lines, ""]).encode()) is None
    assert not decoder.usable and decoder.unread == b"V:12.0,A:0.25,enc:0"


def test_a_header_from_before_the_line_was_opened_holds_and_its_samples_do_not() -> None:
    decoder = TextDecoder(2400.0)
    decoder.hear(b"boot\r\nt_ms;V;A;counts\r\n1;2.5;0.5;7\r\n2;2.5")
    block = decoder.feed(b";0.5;8\r\n900;2.5;0.5;9\r\n")
    assert block is not None and block.time_s.tolist() == [0.9]
    assert block.voltage_V is not None and block.voltage_V.tolist() == [2.5]


def test_a_header_after_the_first_sample_changes_nothing() -> None:
    block = decoded("1000,12000,250,0", "t_us,V,A,counts", "3000,12000,250,1")
    assert block.voltage_V is not None and block.voltage_V.tolist() == [12.0, 12.0]
    assert not block.quality.any()


def test_told_columns_are_not_changed_by_a_header() -> None:
    block = decoded("t_us,mV,mA,counts", "1000,12.0,0.25,0", columns=named_format("t_us,V,A,counts"))
    assert block.voltage_V is not None and block.voltage_V.tolist() == [12.0]


def test_decimals_of_thousandths_are_no_default() -> None:
    """12.00 may be volts: the line is quoted, not read as 12 mV."""
    decoder = TextDecoder(2400.0)
    assert decoder.feed(b"\nt_us,mV,mA,counts\n1000,12.00,1.234,57\n") is None
    assert decoder.unread == b"1000,12.00,1.234,57"
    assert decoder.counters.framing_errors == 1


@pytest.mark.parametrize("text", ["", "12,13", "hello world", "t_us,foo", "a:b", "rst:0x1 (POWERON_RESET),boot:0x13"])
def test_what_is_no_header(text: str) -> None:
    assert named_format(text) is None and pair_format(text.encode()) is None


def test_the_default_is_what_its_header_says() -> None:
    assert named_format("t_us,mV,mA,counts") == DEFAULT


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"columns": "foo,bar", "counts_per_rev": 1.0}, "'columns': 'foo,bar' names no sample"),
        ({"columns": "t_us,V,A,counts"}, "'counts_per_rev' is needed"),
        ({"columns": "V,A,rpm"}, "'columns' names no time: 'sample_period_s' is needed"),
    ],
)
def test_columns_that_do_not_fit(options: dict[str, object], message: str) -> None:
    with pytest.raises(DriverConfigError, match=message):
        SerialDriver("a", {"port": "x", "wire": "text", **options})


def test_columns_without_counts_need_no_counts_per_rev() -> None:
    driver = SerialDriver("a", {"port": "x", "wire": "text", "columns": "t_us,V,A,rpm"})
    assert driver.info.channels == ("voltage_V", "current_A", "velocity_rad_s")
    assert driver.info.counts_per_rev is None
