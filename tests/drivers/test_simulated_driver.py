"""The simulated driver: the suite of all drivers, and its own pace, options and endings."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from drivers.registry import make_driver
from servo_daemon.errors import DriverConfigError, DriverDisconnectedError, EndOfStreamError
from servo_daemon.samples import SampleBlock, concatenate
from servo_daemon.simulate import DEFAULT_AGEING, DEFAULT_J_M, PAPER_MOTOR, SimulatedDrive, make_settings
from servo_daemon.simulate import driver as simulated
from servo_daemon.simulate.driver import SimulatedDriver
from tests.drivers.conformance import DriverConformance, read_until

_WRONG_TYPES = {
    "seed": 1.5,
    "rate_hz": "fast",
    "supply_V": True,
    "motor": 3,
    "J_m": "heavy",
    "effects": 5,
    "ageing": 7,
    "motion": "dance",
    "sensors": [1],
    "realtime": "yes",
    "speed": 0,
    "block_s": -1.0,
    "duration_s": "long",
    "fail_after_s": float("nan"),
}


class TestRealTime(DriverConformance):
    kind = "simulated"
    wrong_types = _WRONG_TYPES

    @pytest.fixture
    def options(self) -> Iterator[dict[str, Any]]:
        yield {}

    @pytest.fixture
    def silent_options(self) -> Iterator[dict[str, Any] | None]:
        yield {"block_s": 1000.0}


class TestAsFastAsItIsRead(DriverConformance):
    kind = "simulated"
    wrong_types = _WRONG_TYPES

    @pytest.fixture
    def options(self) -> Iterator[dict[str, Any]]:
        yield {"realtime": False, "effects": ["coulomb_friction"], "ageing": dict(DEFAULT_AGEING), "J_m": DEFAULT_J_M}


class Clock:
    """Stands in for the clock and for waiting: time passes only when someone waits, or is told to."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.closed = False

    def monotonic(self) -> float:
        return self.now

    def wait(self, timeout: float) -> bool:
        self.now += timeout
        return self.closed

    def is_set(self) -> bool:
        return self.closed

    def set(self) -> None:
        self.closed = True

    def clear(self) -> None:
        self.closed = False


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(simulated, "time", clock)
    return clock


def paced(clock: Clock, **options: Any) -> SimulatedDriver:
    driver = SimulatedDriver("axis1", options)
    driver._closing = clock  # type: ignore[assignment]
    driver.open()
    return driver


def read(driver: SimulatedDriver, timeout_s: float = 1.0) -> SampleBlock:
    block = driver.read(timeout_s)
    assert block is not None
    return block


def test_paced_by_deadlines_that_do_not_drift(clock: Clock) -> None:
    driver = paced(clock)
    for k in range(1, 500):
        assert len(read(driver)) == 10
        assert clock.now == pytest.approx(1000.0 + k * 0.01, abs=1e-9)
        clock.now += 0.004  # the reader works for a while: the next deadline stays where it was
    assert driver.counters.samples == 4990


def test_a_late_reader_gets_what_has_come_in_the_meantime(clock: Clock) -> None:
    driver = paced(clock)
    read(driver)
    clock.now += 0.1
    assert len(read(driver)) == 100
    assert clock.now == pytest.approx(1000.11)


def test_a_backlog_comes_in_bounded_blocks(clock: Clock) -> None:
    driver = paced(clock)
    clock.now += 0.9
    assert [len(read(driver)) for _ in range(4)] == [250, 250, 250, 150]
    assert clock.now == pytest.approx(1000.9)


def test_a_stopped_process_has_nothing_to_catch_up(clock: Clock, caplog: pytest.LogCaptureFixture) -> None:
    driver = paced(clock)
    first = read(driver)
    clock.now += 3600.0
    with caplog.at_level(logging.INFO):
        after = read(driver)
    assert "stood still for 3600.0 s" in caplog.text
    assert len(after) == 10
    assert after.sequence[0] == first.sequence[-1] + 1
    assert len(read(driver)) == 10
    assert clock.now == pytest.approx(1000.01 + 3600.0 + 0.01, abs=1e-6)


def test_a_short_timeout_is_kept(clock: Clock) -> None:
    driver = paced(clock, block_s=0.5)
    assert driver.read(0.2) is None
    assert clock.now == pytest.approx(1000.2)
    assert driver.read(0.0) is None
    assert len(read(driver)) == 500
    assert clock.now == pytest.approx(1000.5)


def test_speed_runs_the_motor_faster(clock: Clock) -> None:
    driver = paced(clock, speed=20.0)
    block = read(driver)
    assert len(block) == 200
    assert clock.now == pytest.approx(1000.01)


def test_a_slow_drive_still_delivers_sample_by_sample(clock: Clock) -> None:
    driver = paced(clock, rate_hz=20.0)
    assert len(read(driver)) == 1
    assert clock.now == pytest.approx(1000.05)


def test_host_time_is_the_moment_of_delivery(clock: Clock) -> None:
    assert read(paced(clock)).host_time_s == pytest.approx(1000.01)


def test_samples_are_those_of_the_simulation_whatever_the_pace(clock: Clock) -> None:
    options: dict[str, Any] = {"seed": 5, "effects": ["gravity_load"], "ageing": {"R": "+10%/10s"}}
    driver = paced(clock, **options)
    parts = []
    for k in range(40):
        parts.append(read(driver))
        clock.now += 0.013 * (k % 3)
    together = concatenate(parts)
    straight = SimulatedDrive(make_settings(**options)).next_block(len(together))
    for name in ("time_s", "sequence", *straight.channels):
        np.testing.assert_array_equal(getattr(together, name), getattr(straight, name))


def test_duration_ends_the_stream() -> None:
    driver = make_driver("simulated", "axis1", {"realtime": False, "duration_s": 2.5, "ageing": ["R=+40%"]})
    assert driver.can_wait and not make_driver("simulated", "axis1", {}).can_wait
    with driver:
        blocks = read_until(driver, 10_000)
        assert sum(map(len, blocks)) == 2500
        assert driver.truth() == pytest.approx({**PAPER_MOTOR, "R": 1.4 * PAPER_MOTOR["R"]}, rel=1e-3)
        with pytest.raises(EndOfStreamError, match="axis1"):
            driver.read(0.0)


def test_a_failing_device_goes_away_once_and_reads_on_when_opened_again() -> None:
    driver = make_driver("simulated", "axis1", {"realtime": False, "fail_after_s": 1.5})
    driver.open()
    blocks = [driver.read(0.0), driver.read(0.0)]
    with pytest.raises(DriverDisconnectedError, match="axis1"):
        driver.read(0.0)
    driver.close()
    with driver:
        blocks += [driver.read(0.0)]
    assert [len(b) for b in blocks if b is not None] == [1000, 500, 1000]
    sequence = np.concatenate([b.sequence for b in blocks if b is not None])
    assert np.array_equal(sequence, np.arange(2500))


def test_truth_is_that_of_the_last_delivered_sample() -> None:
    driver = make_driver("simulated", "axis1", {"realtime": False, "ageing": {"R": "+40%/10s"}, "J_m": 0.009})
    assert driver.truth() is None
    with driver:
        for seconds in range(1, 4):
            driver.read(0.0)
            truth = driver.truth()
            assert truth is not None
            assert truth["R"] == pytest.approx(PAPER_MOTOR["R"] * (1 + 0.04 * seconds), rel=1e-4)
            assert truth["J_d"] == pytest.approx(truth["J"] - 0.009)


@pytest.mark.parametrize(
    "options, why",
    [
        ({"effects": ["colomb"]}, "unknown effect 'colomb'"),
        ({"effects": {"coulomb_friction": {"Tx": 1}}}, "unknown parameter 'Tx'"),
        ({"ageing": {"R": "+40%"}}, "needs a time"),  # this drive has no end
        ({"ageing": {"Q": "+40%/3s"}}, "Q"),
        ({"motor": {"Rr": 1.0}}, "'Rr'"),
        ({"sensors": {"noise": 1.0}}, "'noise'"),
    ],
)
def test_wrong_contents_are_refused_by_name(options: dict[str, Any], why: str) -> None:
    with pytest.raises(DriverConfigError, match=f"axis1.*{why}"):
        make_driver("simulated", "axis1", options)
