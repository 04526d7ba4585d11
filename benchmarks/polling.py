"""What asking drives costs: CPU of the process that reads them, as a share of a core.

    python -m benchmarks.polling

The real drivers over a pseudo-terminal; the device is a process of its own that answers at once with answers recorded
beforehand, so that it does not compete for the core. A loop that does nothing but write, wait and read as often is the
floor: what the system asks for it. Budgets: one VESC at 500 Hz 4 %, 16 Dynamixels on one line at 100 Hz 15 %.
"""

from __future__ import annotations

import contextlib
import itertools
import multiprocessing
import os
import select
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from drivers.base import Driver
from drivers.registry import make_driver
from drivers.serial.port import open_port
from drivers.servo_bus.families import DynamixelX
from drivers.vesc.requests import GET_VALUES_SELECTIVE, POLL_MASKS, request
from servo_daemon.sim_drive.makes.foc import FocDrive, RunningFoc
from servo_daemon.sim_drive.makes.moving import MovingMotor
from servo_daemon.sim_drive.makes.serve import Device, serve
from servo_daemon.sim_drive.makes.servos import DynamixelChain
from servo_daemon.sim_drive.makes.vesc import VescDevice
from servo_daemon.simulate import SimulatedDrive, make_settings

SECONDS, SETTLE_S = 10.0, 2.0
VESC_HZ, SERVO_HZ, SERVOS = 500.0, 100.0, tuple(range(1, 17))
#: Recorded answers, which are gone through again and again: two seconds.
RECORDED = 1000


class Recorded:
    """Recorded answers in turn, by request; to any other the device's own."""

    period_s: float | None = None

    def __init__(self, device: Device, answers: dict[bytes, list[bytes]]) -> None:
        self._length = len(next(iter(answers)))  # of every request
        self._device, self._answers = device, {r: itertools.cycle(a) for r, a in answers.items()}

    def receive(self, data: bytes) -> bytes:
        answered = b""
        while recorded := next((a for request, a in self._answers.items() if data.startswith(request)), None):
            data, answered = data[self._length :], answered + next(recorded)
        return answered + (self._device.receive(data) if data else b"")

    def due(self) -> bytes:
        return b""


def vesc() -> Recorded:
    """Of a motor that is looked at 500 times a second."""
    now = itertools.count()
    device = VescDevice(RunningFoc(FocDrive(), lambda: next(now) / VESC_HZ))
    polls = [request(bytes([GET_VALUES_SELECTIVE]) + mask.to_bytes(4, "big")) for mask in POLL_MASKS]
    answers: dict[bytes, list[bytes]] = {p: [] for p in polls}
    for k in range(1, RECORDED + 1):  # in the order in which the driver asks
        poll = polls[k % len(polls)]
        answers[poll].append(device.receive(poll))
    return Recorded(device, answers)


def servos() -> Recorded:
    """Of sixteen servos that are asked together."""
    family, now = DynamixelX(fast=True), itertools.count()
    motors = {s: MovingMotor(SimulatedDrive(make_settings(supply_V=12.0)), lambda: next(now) * 1e-3) for s in SERVOS}
    chain = DynamixelChain(motors)
    together = family.sync_read(SERVOS)
    return Recorded(chain, {together: [chain.receive(together) for _ in range(RECORDED // 5)]})


def _serve(link: Path, make: Callable[[], Recorded]) -> None:
    serve(link, make(), stop=threading.Event())


@contextlib.contextmanager
def running(make: Callable[[], Recorded]) -> Iterator[str]:
    """A device with these answers in a process of its own; where it is."""
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / "port"
        process = multiprocessing.get_context("spawn").Process(target=_serve, args=(link, make), daemon=True)
        process.start()
        try:
            while not link.exists():
                time.sleep(0.02)
            yield str(link)
        finally:
            process.terminate()
            process.join()


def cost(drivers: list[Driver]) -> tuple[float, float]:
    """% of a core, and samples a second of each drive, while all of them are read, each by a thread of its own."""
    stop = threading.Event()

    def read(driver: Driver) -> None:
        with driver:
            while not stop.is_set():
                driver.read(0.1)

    threads = [threading.Thread(target=read, args=(d,)) for d in drivers]
    for thread in threads:
        thread.start()
    time.sleep(SETTLE_S)
    cpu_s, began_s, samples = time.process_time(), time.monotonic(), sum(d.counters.samples for d in drivers)
    time.sleep(SECONDS)
    cpu_s, took_s = time.process_time() - cpu_s, time.monotonic() - began_s
    rate = (sum(d.counters.samples for d in drivers) - samples) / took_s / len(drivers)
    stop.set()
    for thread in threads:
        thread.join()
    return 100.0 * cpu_s / took_s, rate


def floor(port: str, question: bytes, rate_hz: float) -> tuple[float, float]:
    """The same of a loop that asks, waits and reads, and does nothing with what it gets."""
    line = open_port("floor", port, 115_200)
    fd, answered = line.fileno(), 0
    began_s, cpu_s = time.monotonic(), time.process_time()
    due_s = began_s
    while (now := time.monotonic()) < began_s + SECONDS:
        select.select((fd,), (), (), max(0.0, due_s - now))
        due_s = max(due_s + 1.0 / rate_hz, now - 1.0 / rate_hz)
        os.write(fd, question)
        if select.select((fd,), (), (), 0.1)[0]:
            os.read(fd, 65_536)
            answered += 1
    cpu_s, took_s = time.process_time() - cpu_s, time.monotonic() - began_s
    line.close()
    return 100.0 * cpu_s / took_s, answered / took_s


def row(what: str, found: tuple[float, float], budget: str) -> None:
    share, rate = found
    print(f"| {what} | {rate:.0f} | {share:.1f} | {budget} |", flush=True)


def main() -> None:
    print("| read | samples a second, each | % of a core | budget |\n|---|---|---|---|")
    with running(vesc) as port:
        poll = request(bytes([GET_VALUES_SELECTIVE]) + POLL_MASKS[0].to_bytes(4, "big"))
        row(f"nothing but write and read, {VESC_HZ:g} Hz", floor(port, poll, VESC_HZ), "")
        options: dict[str, Any] = {"port": port, "rate_hz": VESC_HZ, "position": "encoder"}
        row(f"a VESC at {VESC_HZ:g} Hz", cost([make_driver("vesc", "axis", options)]), "4")
    with running(servos) as port:
        options = {"port": port, "rate_hz": SERVO_HZ}
        chain = [make_driver("dynamixel", f"axis{s}", options | {"drive_id": s}) for s in SERVOS]
        row(f"{len(SERVOS)} Dynamixels on one line at {SERVO_HZ:g} Hz", cost(chain), "15")


if __name__ == "__main__":
    main()
