"""Decoding the binary serial wire: ours against the obvious decoder, same bytes; and what reading a live drive costs.

    python benchmarks/wire_serial.py

The rival is what one writes first: the `cobs` package, the CRC, then `struct` for every sample, values appended to
lists that become arrays. It gets whole frames, knows the layout beforehand and handles neither wraps nor losses, so it
wins where a read holds a handful of samples, and there the cost does not matter: a drive at 1 kHz is read 50 times a
second. Budget: 1 µs a sample for ours in bulk.

The live part runs the real driver over a pseudo-terminal at 1 kHz with 10 samples a frame, the device in a process of
its own, and reports the reading thread's CPU time as a share of a core.
"""

from __future__ import annotations

import math
import multiprocessing
import struct
import tempfile
import threading
import time
from binascii import crc_hqx
from collections.abc import Callable
from pathlib import Path

import numpy as np
from cobs import cobs

from drivers.base import DriveInfo
from drivers.serial.decoder import BinaryDecoder
from drivers.serial.frame import encode_frame
from drivers.serial.line import SerialDriver
from drivers.serial.wire import Channel, Description, Quantity, encode_description, encode_samples
from servo_daemon.samples import SampleBlock, make_block
from servo_daemon.sim_drive.serial_device import run_serial_device

BUDGET_US = 1.0
SAMPLES = 100_000
PERIOD_US = 100
ROUNDS = 5
LIVE_S = 10.0

#: What a read holds: the driver reads every 20 ms.
READS = (("one read", SAMPLES), ("as read at 10 kHz", 200), ("as read at 1 kHz", 20))

DESCRIPTION = Description(
    drive_id=1,
    session=0,
    channels=(
        Channel(Quantity.VOLTAGE, 2, 1e-3),
        Channel(Quantity.CURRENT, 2, 1e-3),
        Channel(Quantity.POSITION, 4, 4096.0),
    ),
    identity="BENCH",
    sample_period_ns=PERIOD_US * 1000,
)
FIRST = encode_frame(encode_description(DESCRIPTION))


def stream(samples_per_frame: int) -> list[bytes]:
    """Frames of a motor that swings, at 10 kHz."""
    rng = np.random.default_rng(1)
    frames = []
    for first in range(0, SAMPLES, samples_per_frame):
        k = first + np.arange(samples_per_frame)
        volts = np.rint(12_000 * np.sin(k / 700)).astype(np.int64)
        amps = rng.integers(-3000, 3000, size=samples_per_frame)
        counts = np.rint(9000 * np.sin(k / 900)).astype(np.int64)
        frames.append(encode_frame(encode_samples(DESCRIPTION, first, PERIOD_US * k, [volts, amps, counts])))
    return frames


def rival(data: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Frame by frame, sample by sample."""
    header, record = struct.Struct("<BBBBII"), struct.Struct("<Hhhi")
    times, volts, amps, positions = [], [], [], []
    for encoded in data.split(b"\0"):
        if not encoded:
            continue
        payload = cobs.decode(encoded)
        if crc_hqx(payload, 0xFFFF) or payload[0] != 1:
            continue
        _, _, _, n, _, t_us = header.unpack_from(payload)
        for k in range(n):
            dt_us, v, i, counts = record.unpack_from(payload, header.size + k * record.size)
            t_us += dt_us
            times.append(t_us * 1e-6)
            volts.append(v * 1e-3)
            amps.append(i * 1e-3)
            positions.append(counts * (2 * math.pi / 4096))
    return np.array(times), np.array(volts), np.array(amps), np.array(positions)


def ours(parts: list[bytes]) -> list[SampleBlock]:
    """Reads of this size, as they come from a port."""
    decoder = BinaryDecoder()
    decoder.feed(FIRST)
    return [block for part in parts if (block := decoder.feed(part)) is not None]


def best_us(work: Callable[[], object]) -> float:
    """Time of the best of some rounds, µs a sample."""
    times = []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times) / SAMPLES * 1e6


def check_same(data: bytes) -> None:
    """Both decoders give the same numbers."""
    (block,) = ours([data])
    for got, expected in zip(
        (block.time_s, block.voltage_V, block.current_A, block.position_rad), rival(data), strict=True
    ):
        assert got is not None
        np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-12)


class Swing:
    """A drive for the live part."""

    info = DriveInfo("BENCH", 1e-3, 4096.0, 1e-3, 1e-3, ("voltage_V", "current_A", "position_rad"))

    def __init__(self) -> None:
        self._taken = 0

    def next_block(self, n: int) -> SampleBlock:
        """The next n samples at 1 kHz."""
        k = self._taken + np.arange(n)
        self._taken += n
        return make_block(
            k * 1e-3, sequence=k, voltage_V=np.sin(k / 70), current_A=np.cos(k / 70), position_rad=np.sin(k / 90)
        )


def serve(link: str) -> None:
    """The device, in a process of its own."""
    run_serial_device(Path(link), Swing(), stop=threading.Event())


def live_share(seconds: float) -> tuple[float, float, int]:
    """CPU share of a thread that reads a live drive, samples a second, samples lost."""
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / "drive"
        device = multiprocessing.get_context("spawn").Process(target=serve, args=(str(link),), daemon=True)
        device.start()
        try:
            while not link.exists():
                time.sleep(0.01)
            with SerialDriver("bench", {"port": str(link)}) as driver:
                while driver.read(0.5) is None:
                    pass
                samples, cpu, start = driver.counters.samples, time.thread_time(), time.monotonic()
                while time.monotonic() - start < seconds:
                    driver.read(0.5)
                took = time.monotonic() - start
                share = (time.thread_time() - cpu) / took
                return share, (driver.counters.samples - samples) / took, driver.counters.samples_lost
        finally:
            device.terminate()
            device.join()


def main() -> None:
    """Print the table."""
    print("| decoding | ours, µs a sample | rival, µs a sample | ratio |")
    print("|---|---|---|---|")
    bulk = math.inf
    for n in (10, 50, 1):
        frames = stream(n)
        data = b"".join(frames)
        check_same(data)
        for label, samples in READS:
            group = min(len(frames), max(1, samples // n))
            parts = [b"".join(frames[at : at + group]) for at in range(0, len(frames), group)]
            theirs = best_us(lambda parts=parts: [rival(part) for part in parts])  # type: ignore[misc]
            mine = best_us(lambda parts=parts: ours(parts))  # type: ignore[misc]
            if n == 10 and samples == SAMPLES:
                bulk = mine
            print(f"| {n} samples a frame, {label} | {mine:.2f} | {theirs:.2f} | {theirs / mine:.1f} |")
    print(f"\nbudget {BUDGET_US:g} µs a sample (10 a frame, one read): {'met' if bulk <= BUDGET_US else 'MISSED'}")
    share, rate, lost = live_share(LIVE_S)
    print(f"live, 1 kHz, 10 samples a frame: {100 * share:.2f} % of a core at {rate:.0f} samples/s, {lost} lost")


if __name__ == "__main__":
    main()
