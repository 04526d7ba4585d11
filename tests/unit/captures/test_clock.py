"""Device time against the clock: `check` compares the two, `record` ends by either."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.base import DriveInfo, Driver
from servo_daemon.captures import read_capture
from servo_daemon.samples import SampleBlock, make_block
from tests.command_line import run_command

CONFIG = '[[drive]]\nname = "a"\ndriver = "serial"\n[drive.options]\nport = "/dev/none"\n'


class Clock:
    """The host's monotonic clock, which goes on only as samples arrive."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def monotonic(self) -> float:
        return self.now_s


class Ticking(Driver):
    """50 samples every 100 ms of the clock; the device's time passes `rate` times as fast. Four fifths as many lines
    cannot be read."""

    kind = "serial"

    def __init__(self, clock: Clock, rate: float, remark: str | None, unread: str | None) -> None:
        super().__init__("a", {})
        self._clock, self._rate, self._remark, self._unread, self._k = clock, rate, remark, unread, 0

    @property
    def info(self) -> DriveInfo:
        return DriveInfo("x", counts_per_rev=2400, channels=("voltage_V", "current_A", "position_rad"))

    @property
    def remark(self) -> str | None:
        return self._remark

    @property
    def unread(self) -> str | None:
        return self._unread

    def _open(self) -> None: ...
    def _close(self) -> None: ...
    def _read(self, timeout_s: float) -> SampleBlock:
        self._clock.now_s += 0.1
        k = np.arange(self._k, self._k + 50)
        self._k += 50
        self.counters.framing_errors += 40
        channels: dict[str, Any] = dict.fromkeys(("voltage_V", "current_A", "position_rad"), 0.1 * k)
        return make_block(2e-3 * k * self._rate, host_time_s=self._clock.now_s, **channels)


@pytest.fixture
def ticking(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Path]:
    """The config of a drive whose time passes at a given rate, on a clock of its own."""

    def made(rate: float, remark: str | None = None, unread: str | None = None) -> Path:
        clock = Clock()
        monkeypatch.setattr("drivers.registry.make_driver", lambda *_: Ticking(clock, rate, remark, unread))
        fake = type("time", (), {"monotonic": staticmethod(clock.monotonic), "sleep": staticmethod(time.sleep)})
        for module in ("shared.listening", "record"):
            monkeypatch.setattr(f"servo_daemon.commands.{module}.time", fake)
        path = tmp_path / "c.toml"
        path.write_text(CONFIG)
        return path

    return made


@pytest.mark.parametrize(
    ("rate", "warning"),
    [
        (1.0, None),
        (1.2, None),
        (1e-3, "device time runs 1,000 times too slowly against the clock (are its milliseconds called microseconds?"),
        (1e3, "device time runs 1,000 times too fast against the clock"),
        (2.0, "device time runs 2 times too fast against the clock: every estimate would be wrong"),
    ],
)
def test_check_compares_device_time_with_the_clock(
    ticking: Callable[..., Path], rate: float, warning: str | None
) -> None:
    said = run_command("check", "--config", ticking(rate))
    assert said.code == 0
    if warning is None:
        assert "WARNING" not in said.out
    else:
        assert f"WARNING: {warning}" in said.out


def test_check_shows_what_it_assumes_and_what_it_cannot_read(ticking: Callable[..., Path]) -> None:
    config = ticking(1.0, unread="a line that is not t_us,mV: 'hello'")
    text = run_command("check", "--config", config).out
    assert "assumes 2,400 counts a turn: turn the shaft once by hand and expect 6.28 rad" in text
    assert "lines could not be read: a line that is not t_us,mV: 'hello'" in text
    (drive,) = run_command("check", "--config", config, "--json").document["drives"]
    assert drive["assumes"] and drive["remarks"]


def test_check_says_what_is_wrong_of_a_drive_and_blames_no_line_for_it(ticking: Callable[..., Path]) -> None:
    (drive,) = run_command("check", "--config", ticking(1.0, "set its rates"), "--json").document["drives"]
    assert drive["remarks"] == ["set its rates"]


@pytest.mark.parametrize(("rate", "samples"), [(1.0, 1000), (1e-3, 1700)])
def test_record_ends_by_the_clock_too(ticking: Callable[..., Path], rate: float, samples: int, tmp_path: Path) -> None:
    out = tmp_path / "r.csv"
    said = run_command("record", "--config", ticking(rate), "--seconds", "2", "--out", out)
    assert said.code == 0
    assert ("ended by the clock: device time went on by" in said.err) == (rate < 1.0)
    assert len(read_capture(out)) == pytest.approx(samples, abs=60)
