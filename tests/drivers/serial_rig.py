"""A synthetic drive on a pseudo-terminal in a thread, for the tests of the serial driver."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from drivers.base import DriveInfo
from servo_daemon.errors import EndOfStreamError
from servo_daemon.samples import SampleBlock, make_block
from servo_daemon.sim_drive.counters import DeviceCounters
from servo_daemon.sim_drive.line_faults import LineFaults
from servo_daemon.sim_drive.serial_device import Wire, run_serial_device
from servo_daemon.sim_drive.source import CommandedSource

PATIENCE_S = 30.0
RATE_HZ = 1000.0


def wait_for(condition: Callable[[], bool], what: str) -> None:
    """Wait until it is so, and fail if it does not become so."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain: {what}"
        time.sleep(0.002)


RAMP_INFO = DriveInfo(
    identity="RAMP-1",
    sample_period_s=1 / RATE_HZ,
    counts_per_rev=4096.0,
    current_lsb_A=1e-4,
    voltage_lsb_V=1e-3,
    channels=("voltage_V", "current_A", "position_rad"),
)


@dataclass
class Ramp:
    """A source whose samples tell their own number: sample k has k mV (mod 10000), -k/10 mA, k counts.

    Attributes:
        limit: after so many samples the source ends.
    """

    limit: int = 10**9
    info: DriveInfo = RAMP_INFO
    taken: int = field(default=0, init=False)

    def next_block(self, n: int) -> SampleBlock:
        n = min(n, self.limit - self.taken)
        if n <= 0:
            raise EndOfStreamError("the ramp is at its end")
        k = self.taken + np.arange(n)
        self.taken += n
        return ramp_block(k)


def ramp_block(k: np.ndarray) -> SampleBlock:
    """Samples number k of the ramp."""
    return make_block(
        k / RATE_HZ,
        sequence=k.astype(np.int64),
        voltage_V=(k % 10_000) * 1e-3,
        current_A=-(k % 10_000) * 1e-4,
        position_rad=k * (2 * np.pi / 4096),
    )


def assert_is_ramp(block: SampleBlock) -> None:
    """Every sample has the values of its number."""
    expected = ramp_block(block.sequence)
    for name in ("time_s", "voltage_V", "current_A", "position_rad"):
        np.testing.assert_allclose(getattr(block, name), getattr(expected, name), rtol=0, atol=1e-9)


@dataclass
class Rig:
    """A running device."""

    link: Path
    counters: DeviceCounters
    stop: threading.Event
    thread: threading.Thread

    def halt(self) -> None:
        """Take the device away, as pulling the plug does."""
        self.stop.set()
        self.thread.join(PATIENCE_S)
        assert not self.thread.is_alive()


@contextlib.contextmanager
def serial_rig(
    link: Path,
    source: Ramp | None = None,
    *,
    wire: Wire = "binary",
    realtime: bool = True,
    faults: LineFaults | None = None,
    samples_per_frame: int = 10,
    drive_id: int = 1,
    commanded: CommandedSource | None = None,
) -> Iterator[Rig]:
    """A device that sends while the context lasts; whatever goes wrong in it fails the test."""
    counters, stop = DeviceCounters(), threading.Event()
    errors: list[BaseException] = []

    def run() -> None:
        try:
            run_serial_device(
                link,
                commanded or source or Ramp(),
                wire=wire,
                drive_id=drive_id,
                samples_per_frame=samples_per_frame,
                stop=stop,
                realtime=realtime,
                commanded=commanded,
                faults=faults,
                counters=counters,
            )
        except BaseException as error:
            errors.append(error)

    rig = Rig(link, counters, stop, threading.Thread(target=run, daemon=True))
    rig.thread.start()
    try:
        wait_for(lambda: link.exists() or bool(errors), f"{link} appears")
        yield rig
    finally:
        rig.halt()
    assert not errors, errors
