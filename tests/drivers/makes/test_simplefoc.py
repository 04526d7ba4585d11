"""Driver "simplefoc" against a simulated sketch on a pseudo-terminal; the decoder against bytes of a real monitor."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.registry import make_driver
from drivers.simplefoc import MAY_SEND, MonitorDecoder, SimpleFocDriver, SimpleFocOptions
from servo_daemon.errors import DriverConfigError
from servo_daemon.samples import concatenate
from servo_daemon.sim_drive.makes.simplefoc import SimpleFocMonitor
from tests.drivers.conformance import read_until
from tests.drivers.makes.conformance import OnAPort
from tests.drivers.makes.rig import assert_follows_the_sine, line, sine_motor, voltage_of

#: The first lines of a monitor with target, Uq, Iq, velocity and angle.
GOLDEN = b"0.0000\t0.2746\t3617.8605\t7.7842\t0.0475\r\n0.0000\t0.3266\t-3431.8803\t9.1540\t0.1318\r\n"


class TestSimpleFocConformance(OnAPort):
    kind = "simplefoc"
    wrong_types = {"port": 5, "baudrate": "fast", "monitor": 1101011, "period_s": 0, "pole_pairs": 0}  # noqa: RUF012

    @pytest.fixture
    def options(self, tmp_path: Path) -> Iterator[dict[str, Any]]:
        with line(tmp_path / "foc", SimpleFocMonitor(sine_motor(5e-3))) as rig:
            yield {"port": str(rig.link)}
        assert bytes(rig.heard) == b"", MAY_SEND


def _decoder(**options: Any) -> MonitorDecoder:
    driver = make_driver("simplefoc", "axis1", {"port": "nowhere", **options})
    assert isinstance(driver, SimpleFocDriver)
    return driver._decoder


def test_a_line_of_the_monitor_is_read_as_it_is_documented() -> None:
    decoder = _decoder(period_s=0.01)
    block = decoder.feed(b"cut\t1.0\r\n" + GOLDEN, 5.0)
    assert block is not None
    assert block.voltage_V is not None and block.current_A is not None
    np.testing.assert_array_equal(block.voltage_V, [0.2746, 0.3266])
    np.testing.assert_allclose(block.current_A, [3.6178605, -3.4318803], rtol=1e-12)
    np.testing.assert_array_equal(block.velocity_rad_s, [7.7842, 9.1540])
    np.testing.assert_array_equal(block.position_rad, [0.0475, 0.1318])
    np.testing.assert_allclose(block.time_s, [0.0, 0.01], atol=1e-9)


@pytest.mark.parametrize(
    ("monitor", "text", "channels"),
    [
        ("1100011", b"1.5\t2\t3\t4\n", ("voltage_V", "position_rad", "velocity_rad_s")),
        ("0101111", b"2\t500\t-7\t3\t4\n", ("voltage_V", "current_A", "position_rad", "velocity_rad_s")),
        ("0001001", b"500\t4\n", ("current_A", "position_rad")),
    ],
)
def test_the_mask_says_what_the_columns_are(monitor: str, text: bytes, channels: tuple[str, ...]) -> None:
    block = _decoder(monitor=monitor, period_s=0.01).feed(b"\n" + text, 1.0)
    assert block is not None and block.channels == channels
    if "current_A" in channels:
        assert block.current_A is not None and block.current_A[0] == 0.5
    assert block.position_rad is not None and block.position_rad[0] == 4.0


@pytest.mark.parametrize("monitor", ["1000000", "1111100", "0000010", "110", "11a0011"])
def test_a_mask_without_a_motion_is_refused(monitor: str) -> None:
    with pytest.raises(DriverConfigError, match="monitor"):
        make_driver("simplefoc", "axis1", {"port": "p", "monitor": monitor})


def test_what_the_sketch_says_beside_the_monitor_is_told_and_not_taken(tmp_path: Path) -> None:
    driver = make_driver("simplefoc", "axis1", {"port": "p", "period_s": 0.01})
    assert isinstance(driver, SimpleFocDriver)
    assert driver._decoder.feed(b"\nMOT: Align sensor.\r\n1.0\t2.0\r\n", 1.0) is None
    assert driver.counters.framing_errors == 2
    assert driver.remark is None and "monitor" in str(driver.unread)


def test_values_and_times_of_a_live_monitor(tmp_path: Path) -> None:
    with line(tmp_path / "foc", SimpleFocMonitor(sine_motor(5e-3), period_s=5e-3)) as rig:
        with make_driver("simplefoc", "axis1", {"port": str(rig.link)}) as driver:
            block = concatenate(read_until(driver, 400))
            assert driver.info.sample_period_s is not None
        assert not rig.heard
    assert_follows_the_sine(block, 5e-3, voltage=lambda speed: voltage_of(speed) / 1.5)


@pytest.mark.parametrize("seed", range(20))
def test_any_bytes_come_to_nothing_worse_than_a_counter(seed: int) -> None:
    random = np.random.default_rng(seed)
    decoder = _decoder(period_s=0.01)
    for k in range(100):
        noise = random.integers(0, 256, random.integers(0, 60), dtype=np.uint8).tobytes()
        spoilt = bytearray(GOLDEN)
        spoilt[random.integers(0, len(spoilt))] = random.integers(0, 256)
        block = decoder.feed(bytes(spoilt) if k % 2 else noise, 0.01 * k)
        assert block is None or np.isfinite(block.time_s).all()


def test_options_know_the_order_of_the_columns() -> None:
    assert SimpleFocOptions(port="p", monitor="1111111").format.names == (
        "target", "Uq_V", "Ud_V", "Iq_mA", "Id_mA", "vel_rad/s", "angle_rad",
    )  # fmt: skip


def _printed(k: int) -> bytes:
    return b"0.0\t%.4f\t500.0\t3.0\t%.4f\r\n" % (0.1 * k, 0.03 * k)


@pytest.mark.parametrize(
    ("beside", "samples"),
    [
        (b"23.5\r\n", 0),  # another variable
        (b"MOT: zero elec. angle: 3.14\r\n", 0),
        (b"0.0\t1.5\t50x.0\t3.0\t0.2\r\n", 1),
        (b"0.0\t1.5\t5T=23\r\n00.0\t3.0\t0.2\r\n", 1),  # a message in the middle of a sample
        (b"0.0\t1.5\t500.0\t3.0\t0.20.0\t1.6\t500.0\t3.0\t0.23\r\n", 2),  # a line's end is lost
    ],
)
def test_only_what_was_a_sample_passes_time(beside: bytes, samples: int) -> None:
    """A sample is dated by its number: a message that counted as one would make every speed too small."""
    decoder = _decoder(period_s=0.01)
    decoder.feed(b"\n" + b"".join(map(_printed, range(10))), 0.1)
    after = decoder.feed(beside + _printed(10), 0.1 + 0.01 * (1 + samples))
    assert after is not None and after.sequence[-1] == 10 + samples
    assert after.time_s[-1] == pytest.approx(0.01 * (10 + samples), abs=1e-3)
    assert decoder.lines.counters.samples_lost == samples and decoder.lines.counters.framing_errors > 0
