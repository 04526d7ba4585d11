"""The drives: simulated devices on pseudo-terminals in a process of their own, which does what it is told.

A line of stdin each, answered by a line of JSON: `pause`, `go`, `count`, `unplug J`, `plug J`, `garbage J`,
`restart J`. While they pause no device takes or sends a sample: then what was sent and what the daemon has can be
compared to the last one.

    python -m benchmarks.soak.drives FOLDER SERIAL SLCAN
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from servo_daemon.errors import EndOfStreamError
from servo_daemon.samples import SampleBlock
from servo_daemon.sim_drive.counters import DeviceCounters
from servo_daemon.sim_drive.line_faults import Fault, LineFaults
from servo_daemon.sim_drive.serial_device import run_serial_device
from servo_daemon.sim_drive.slcan_device import SlcanFaults, run_slcan_device
from servo_daemon.simulate import SimulatedDrive, make_settings

RATE_HZ, PER_FRAME = 1000, 10
#: Bytes of a wrong baud rate, and lines that are no frames; with the end mark of its wire behind, so that the frame
#: that follows is good.
_SLCAN_NOISE = b"\xff\x00\x91garbage\rt12\rT1F\r"


class Source:
    """A motor whose samples can be held back.

    Attributes:
        longest_s: between two calls of the device, pauses left out, since it was last set to 0: how long the machine
            kept the device from running.
    """

    def __init__(self, seed: int, running: threading.Event) -> None:
        self._drive = SimulatedDrive(make_settings(seed=seed, rate_hz=float(RATE_HZ)))
        self.info = self._drive.info
        self._running, self.stop = running, threading.Event()
        self._called_s: float | None = None
        self.longest_s, self.waits = 0.0, False

    def go_on(self) -> None:
        """A pause ends: it was no delay."""
        self._called_s = None

    def next_block(self, n: int) -> SampleBlock:
        now = time.monotonic()
        if self._called_s is not None:
            self.longest_s = max(self.longest_s, now - self._called_s)
        while not self._running.wait(0.0):
            self.waits = True
            if self.stop.is_set():
                raise EndOfStreamError("told to stop")
            self._running.wait(0.05)
        self.waits = False
        self._called_s = time.monotonic()
        return self._drive.next_block(n)


class Once:
    """True for one sample after it has been asked for: `SlcanFaults` looks its faults up by sample."""

    def __init__(self, value: bytes = b"") -> None:
        self.wanted, self._value = 0, value

    def __contains__(self, _: object) -> bool:
        if self.wanted:
            self.wanted -= 1
            return True
        return False

    def __getitem__(self, _: object) -> bytes:
        return self._value


class Device:
    """One drive on one wire. `plug` makes its terminal (anew), `unplug` takes it away; the motor stays."""

    def __init__(self, number: int, link: Path, slcan: bool, running: threading.Event) -> None:
        self.counters = DeviceCounters()
        self.source = Source(100 + number, running)
        self._line, self._restart, self._noise = LineFaults(), Once(), Once(_SLCAN_NOISE)
        self._link, self._slcan = link, slcan
        self._thread: threading.Thread | None = None

    def plug(self) -> None:
        self.source.stop.clear()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        self.source.stop.set()
        if self._thread is not None:
            self._thread.join(10)
            self._thread = None

    def _run(self) -> None:
        stop, counters = self.source.stop, self.counters
        if self._slcan:
            faults: Any = SlcanFaults(garbage=self._noise, restart=self._restart)  # type: ignore[arg-type]
            run_slcan_device(self._link, self.source, stop=stop, faults=faults, counters=counters)
        else:
            run_serial_device(self._link, self.source, stop=stop, faults=self._line, counters=counters)

    def garbage(self) -> None:
        self._noise.wanted = 1
        if not self._slcan:
            self._line.inject(Fault.GARBAGE)

    def restart(self) -> None:
        self._restart.wanted = 1
        if not self._slcan:
            self._line.inject(Fault.RESTART)

    def count(self) -> dict[str, float]:
        """Samples sent whole to whoever had the port open, frames or lines there was no room for, s that the device
        was kept from running."""
        c, late_s = self.counters, self.source.longest_s
        self.source.longest_s = 0.0
        unsent = 0 if self._slcan else PER_FRAME * (c.unheard + c.overruns)
        return {"sent": c.samples - unsent, "no_room": c.overruns, "late_s": late_s}


def serve(folder: Path, serial: int, slcan: int) -> None:
    """Until stdin ends."""
    running = threading.Event()
    devices = [Device(k, folder / f"drive{k}", k >= serial, running) for k in range(serial + slcan)]
    for device in devices:
        device.plug()
    for line in sys.stdin:
        what, *which = line.split()
        answer: object = None
        if what == "pause":
            running.clear()
            while not all(d.source.waits or d.source.stop.is_set() for d in devices):
                time.sleep(0.005)
        elif what == "go":
            for device in devices:
                device.source.go_on()
            running.set()
        elif what == "count":
            answer = [d.count() for d in devices]
        else:
            getattr(devices[int(which[0])], what)()
        print(json.dumps(answer), flush=True)
    running.set()
    for device in devices:
        device.unplug()


class Drives:
    """The other end of that process' stdin.

    Attributes:
        links: the terminals; the first `serial` speak the serial wire, the others slcan.
    """

    def __init__(self, folder: Path, serial: int, slcan: int) -> None:
        self.links, self.serial = [folder / f"drive{k}" for k in range(serial + slcan)], serial
        command = [sys.executable, "-m", "benchmarks.soak.drives", str(folder), str(serial), str(slcan)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def tell(self, words: str) -> Any:
        """A command; its answer. It has been done when this returns."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(words + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())

    def close(self) -> None:
        with self._process:  # closes the pipes
            self._process.terminate()


@contextmanager
def drives(folder: Path, serial: int, slcan: int, wait_for: Callable[..., object]) -> Iterator[Drives]:
    """Paused at first."""
    these = Drives(folder, serial, slcan)
    try:
        wait_for(lambda: all(link.is_symlink() for link in these.links), "the drives' ports")
        yield these
    finally:
        these.close()


if __name__ == "__main__":
    serve(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
