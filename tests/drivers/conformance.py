"""What every driver keeps, whatever is behind it: one suite, passed by subclassing (as python-can tests its buses).

    class TestSerialBinary(DriverConformance):
        kind = "serial"
        wrong_types = {"port": 5, "baudrate": "fast"}

        @pytest.fixture
        def options(self, tmp_path): ...   # yields options of a drive that is there and sends

A source that is finite must hold at least 200 samples.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np
import pytest

from drivers.base import Driver
from drivers.registry import make_driver
from servo_daemon.errors import (
    DriverConfigError,
    DriverDisconnectedError,
    DriverError,
    DriverUnavailableError,
    EndOfStreamError,
)
from servo_daemon.samples import CHANNELS, SampleBlock

#: Longest a test waits for something that must happen; a machine under load is no failure.
PATIENCE_S = 30.0


def read_until(driver: Driver, samples: int) -> list[SampleBlock]:
    """Blocks of an open driver with at least that many samples in all (fewer if the source ends)."""
    blocks: list[SampleBlock] = []
    deadline = time.monotonic() + PATIENCE_S
    while sum(map(len, blocks)) < samples:
        assert time.monotonic() < deadline, f"{sum(map(len, blocks))} of {samples} samples came: {driver.counters}"
        try:
            block = driver.read(0.1)
        except EndOfStreamError:
            break
        if block is not None:
            blocks.append(block)
    assert blocks, "the source ended without a sample"
    return blocks


class DriverConformance:
    """Subclass it as `Test...`, set the class variables and override the fixtures."""

    #: The driver's name in the registry.
    kind: ClassVar[str]
    #: Options with a value of a type they cannot have; the complaint must name them.
    wrong_types: ClassVar[dict[str, Any]]

    @pytest.fixture
    def options(self) -> Iterator[dict[str, Any]]:
        """Options of a drive that sends while the test runs."""
        raise NotImplementedError

    @pytest.fixture
    def silent_options(self) -> Iterator[dict[str, Any] | None]:
        """Options of a drive that can be opened and sends nothing; None where there is no such thing."""
        yield None

    @pytest.fixture
    def missing_options(self) -> Iterator[dict[str, Any] | None]:
        """Options of a drive that is not there; None where there is no such thing."""
        yield None

    @pytest.fixture
    def driver(self, options: dict[str, Any]) -> Iterator[Driver]:
        """A closed driver, closed again afterwards."""
        driver = make_driver(self.kind, "axis1", options)
        yield driver
        driver.close()

    def test_kind_is_its_name(self, driver: Driver) -> None:
        assert driver.kind == self.kind
        assert driver.name == "axis1"

    def test_making_one_opens_nothing(self, driver: Driver) -> None:
        assert not driver.is_open
        assert driver.counters.samples == 0

    def test_open_and_close_may_be_repeated(self, driver: Driver) -> None:
        driver.close()
        driver.open()
        driver.open()
        assert driver.is_open
        driver.close()
        driver.close()
        assert not driver.is_open

    def test_context_manager_closes_after_an_error(self, driver: Driver) -> None:
        with pytest.raises(ZeroDivisionError), driver:
            assert driver.is_open
            raise ZeroDivisionError
        assert not driver.is_open

    def test_read_needs_an_open_driver(self, driver: Driver) -> None:
        with pytest.raises(DriverError, match="axis1"):
            driver.read(0.0)
        with driver:
            read_until(driver, 1)
        with pytest.raises(DriverError, match="axis1"):
            driver.read(0.0)

    def test_polling_gives_a_block_or_none(self, driver: Driver) -> None:
        with driver:
            block = driver.read(0.0)
        assert block is None or len(block) >= 1

    def test_samples_are_in_order_over_all_blocks(self, driver: Driver) -> None:
        with driver:
            blocks = read_until(driver, 100)
        time_s = np.concatenate([b.time_s for b in blocks])
        sequence = np.concatenate([b.sequence for b in blocks])
        assert (np.diff(time_s) > 0).all()
        assert (np.diff(sequence) > 0).all()
        host = [b.host_time_s for b in blocks]
        assert host == sorted(host)

    def test_blocks_keep_their_contract(self, driver: Driver) -> None:
        with driver:
            blocks = read_until(driver, 50)
        for block in blocks:
            assert len(block) >= 1
            assert block.channels == blocks[0].channels
            assert block.sequence.dtype == np.int64 and block.quality.dtype == np.uint8
            assert np.isfinite(block.time_s).all()
            for name in block.channels:
                values = getattr(block, name)
                assert values.dtype == np.float64 and not values.flags.writeable

    def test_info_is_known_with_the_first_block(self, driver: Driver) -> None:
        with driver:
            (block, *_) = read_until(driver, 1)
            info = driver.info
        assert info.identity
        assert set(info.channels) == set(block.channels)
        assert set(info.channels) <= set(CHANNELS)
        assert info.sample_period_s is None or info.sample_period_s > 0

    def test_counters_add_up(self, driver: Driver) -> None:
        with driver:
            blocks = read_until(driver, 50)
            assert driver.counters.samples == sum(map(len, blocks))
        bad = driver.counters
        assert (bad.samples_repeated, bad.crc_errors, bad.framing_errors, bad.device_restarts) == (0, 0, 0, 0)

    def test_reopened_it_reads_on(self, driver: Driver) -> None:
        with driver:
            before = sum(map(len, read_until(driver, 20)))
        with driver:
            after = read_until(driver, 20)
        assert driver.counters.samples == before + sum(map(len, after))
        assert (np.diff(np.concatenate([b.time_s for b in after])) > 0).all()

    def test_silence_times_out(self, silent_options: dict[str, Any] | None) -> None:
        if silent_options is None:
            pytest.skip(f"a {self.kind} source is never silent")
        with make_driver(self.kind, "axis1", silent_options) as driver:
            assert driver.read(0.05) is None
            assert driver.read(0.0) is None
            assert driver.counters.samples == 0

    def test_close_frees_a_waiting_reader(self, options: dict[str, Any], silent_options: dict[str, Any] | None) -> None:
        driver = make_driver(self.kind, "axis1", options if silent_options is None else silent_options)
        driver.open()
        unexpected: list[BaseException] = []
        reading = threading.Event()

        def read() -> None:
            try:
                while driver.is_open:
                    reading.set()
                    driver.read(10 * PATIENCE_S)
            except DriverDisconnectedError:
                pass
            except DriverError:  # closed between the look and the read, or the source ended
                pass
            except BaseException as error:
                unexpected.append(error)

        thread = threading.Thread(target=read, daemon=True)
        thread.start()
        assert reading.wait(PATIENCE_S)
        driver.close()
        thread.join(PATIENCE_S)
        assert not thread.is_alive(), "read did not return after close"
        assert not unexpected

    def test_two_drivers_do_not_share_anything(self, options: dict[str, Any]) -> None:
        one, two = (make_driver(self.kind, name, options) for name in ("one", "two"))
        with one:
            read_until(one, 10)
        assert two.counters.samples == 0 and not two.is_open
        assert one.counters is not two.counters and one.counters.extra is not two.counters.extra

    def test_unknown_option_is_refused_by_name(self, options: dict[str, Any]) -> None:
        with pytest.raises(DriverConfigError, match=r"axis1.*prot_of_call"):
            make_driver(self.kind, "axis1", {**options, "prot_of_call": 1})

    def test_wrong_types_are_refused_by_name(self, options: dict[str, Any]) -> None:
        assert self.wrong_types
        for name, value in self.wrong_types.items():
            with pytest.raises(DriverConfigError, match=name):
                make_driver(self.kind, "axis1", {**options, name: value})

    def test_a_missing_device_is_told_and_may_come_later(self, missing_options: dict[str, Any] | None) -> None:
        if missing_options is None:
            pytest.skip(f"a {self.kind} source is never missing")
        driver = make_driver(self.kind, "axis1", missing_options)
        for _ in range(2):
            with pytest.raises(DriverUnavailableError, match="axis1"):
                driver.open()
            assert not driver.is_open
        driver.close()

    def test_truth_is_numbers_or_nothing(self, driver: Driver) -> None:
        with driver:
            read_until(driver, 1)
            truth = driver.truth()
        assert truth is None or all(isinstance(v, float) for v in truth.values())
