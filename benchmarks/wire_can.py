"""The CAN path against cantools' decode of each frame, and what a full bus loses, in one run.

1. Our part: from python-can's messages to samples (sorting by drive, arrays, decoding), in batches as they gather in
   25 ms; the rival decodes each message with cantools, continues time and position in Python and scales, the way
   everybody writes it first (it notices no loss, no repetition and no restart).
2. The whole path on python-can's virtual bus at 8,000 frames/s, as much as 1 Mbit/s carries: what is lost, and what
   python-can's receive and our part cost of a core.
3. What slcan costs: python-can's own reading from a pseudo-terminal, and the same with our read-ahead before it.

    .venv/bin/python benchmarks/wire_can.py [seconds at the full bus]
"""

from __future__ import annotations

import multiprocessing
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import can
import cantools
import numpy as np

from drivers.base import DriveInfo
from drivers.can.bus import CanDriver
from drivers.can.port import CanPort
from drivers.can.receive import GATHER_S, close_bus, open_bus
from servo_daemon.samples import SampleBlock, make_block
from servo_daemon.sim_drive.can_frames import FrameEncoder
from servo_daemon.sim_drive.slcan_device import run_slcan_device

BUS_FRAMES_S = 8_000
REPEATS = 3
DBC = Path(__file__).parents[1] / "deploy" / "servo.dbc"


class Swing:
    """A drive whose signals swing."""

    def __init__(self, rate_hz: float) -> None:
        self.info = DriveInfo("swing", 1 / rate_hz, 4096.0, 1e-3, 1e-3)
        self._taken = 0

    def next_block(self, n: int) -> SampleBlock:
        t = (self._taken + np.arange(n)) * (self.info.sample_period_s or 0.0)
        self._taken += n
        return make_block(t, voltage_V=12 * np.sin(t), current_A=3 * np.cos(t), position_rad=50 * np.sin(2 * t))


def traffic(drives: int, seconds: float) -> list[can.Message]:
    """A full bus: that many drives share it, each message stamped with the time at which the bus carries it."""
    rate_hz = BUS_FRAMES_S / drives / 1.024  # 45 ms between Syncs and four Descriptions a second take 2.4 %
    encoded = [
        FrameEncoder(source.info, n).encode(source.next_block(round(rate_hz * seconds)))
        for n, source in ((n, Swing(rate_hz)) for n in range(1, drives + 1))
    ]
    frames = sorted((f for one in encoded for f in one), key=lambda f: f.sample)
    return [
        can.Message(
            timestamp=k / BUS_FRAMES_S, arbitration_id=f.frame_id, is_extended_id=False, data=f.data, dlc=len(f.data)
        )
        for k, f in enumerate(frames)
    ]


def ours_s(messages: Sequence[can.Message], drives: int) -> float:
    """CPU time of our part. Raises if a sample is missing."""
    channel = f"bench-{drives}"
    axes = [
        CanDriver(f"axis{n}", {"interface": "virtual", "channel": channel, "drive_id": n}) for n in range(1, drives + 1)
    ]
    for axis in axes:
        axis.open()
    port = CanPort._open["virtual", channel]
    together = round(BUS_FRAMES_S * GATHER_S)
    start = time.thread_time()
    for first in range(0, len(messages), together):
        port._dispatch(messages[first : first + together], 0)
        for axis in axes:
            axis.read(0.0)
    spent = time.thread_time() - start
    samples = sum(a.counters.samples for a in axes)
    expected = sum(m.arbitration_id & 0x7E0 == 0x120 for m in messages)
    for axis in axes:
        axis.close()
    if samples != expected:
        raise SystemExit(f"{expected - samples} of {expected} samples are missing")
    return spent


def cantools_s(messages: Sequence[can.Message]) -> float:
    """CPU time of the loop everybody writes, for drive 1: decode, continue time and position, scale, keep."""
    database = cantools.database.load_file(DBC)
    rows: list[tuple[float, float, float, float]] = []
    time_us = position = 0
    start = time.thread_time()
    for message in messages:
        value = database.decode_message(message.arbitration_id, message.data)
        if message.arbitration_id != 0x121:
            continue
        time_us += (value["Time"] - time_us) & 0xFFFF
        position += ((value["Position"] - position + 0x8000) & 0xFFFF) - 0x8000
        rows.append((time_us * 1e-6, value["Voltage"] * 1e-3, value["Current"] * 1e-3, position * 2 * np.pi / 4096))
    np.array(rows)
    return time.thread_time() - start


def full_bus(seconds: float) -> None:
    """Eight drives on a virtual bus in real time."""
    messages = traffic(8, seconds)
    axes = [CanDriver(f"axis{n}", {"interface": "virtual", "channel": "full", "drive_id": n}) for n in range(1, 9)]
    for axis in axes:
        axis.open()
    receiving = time.pthread_getcpuclockid(CanPort._open["virtual", "full"]._thread.ident or 0)
    sender = threading.Thread(target=send_in_time, args=(messages,))
    before, start = time.clock_gettime(receiving), time.thread_time()
    sender.start()
    expected = sum(m.arbitration_id & 0x7E0 == 0x120 for m in messages)
    quiet = 0
    while sum(a.counters.samples for a in axes) < expected and quiet < 20:
        got = [axis.read(0.0) for axis in axes]
        quiet = 0 if sender.is_alive() or any(b is not None for b in got) else quiet + 1
        time.sleep(GATHER_S)
    sender.join()
    received_s, read_s = time.clock_gettime(receiving) - before, time.thread_time() - start
    samples, lost = sum(a.counters.samples for a in axes), sum(a.counters.samples_lost for a in axes)
    print(f"full bus, virtual, 8 drives: {len(messages)} frames in {seconds:g} s,", end=" ")
    print(f"{samples} of {expected} samples, {lost} lost")
    print(f"  receiving (python-can and sorting) {100 * received_s / seconds:5.1f} % of a core, ", end="")
    print(f"{1e6 * received_s / len(messages):.2f} µs a frame")
    print(f"  decoding                           {100 * read_s / seconds:5.1f} % of a core, ", end="")
    print(f"{1e6 * read_s / len(messages):.2f} µs a frame")
    for axis in axes:
        axis.close()


def send_in_time(messages: Sequence[can.Message]) -> None:
    with can.Bus(interface="virtual", channel="full", ignore_config=True) as bus:
        start = time.monotonic()
        for first in range(0, len(messages), 16):
            for message in messages[first : first + 16]:
                bus.send(message)
            time.sleep(max(0.0, start + (first + 16) / BUS_FRAMES_S - time.monotonic()))


def slcan_us(frames: int, read_ahead: bool) -> float:
    """CPU time of python-can's slcan a frame, µs; the adapter is another process and sends as fast as it is read."""
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / "can0"
        device = context.Process(
            target=run_slcan_device, args=(link, Swing(1000.0)), kwargs={"stop": stop, "realtime": False}, daemon=True
        )
        device.start()
        while not link.exists():
            time.sleep(0.01)
        settings = {"interface": "slcan", "channel": str(link), "bitrate": 1_000_000, "sleep_after_open": 0}
        bus = open_bus(settings | ({"timeout": 0} if read_ahead else {}))
        bus.recv(5.0)
        start = time.thread_time()
        for _ in range(frames):
            bus.recv(5.0)
        spent = time.thread_time() - start
        close_bus(bus)
        stop.set()
        device.join(5)
    return 1e6 * spent / frames


def best_us(action: Callable[[], float], frames: int) -> float:
    return 1e6 * min(action() for _ in range(REPEATS)) / frames


def main() -> None:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 10.0
    one, eight = traffic(1, 4.0), traffic(8, 4.0)
    rival = best_us(lambda: cantools_s(one), len(one))
    for name, messages, drives in (("one drive", one, 1), ("eight drives", eight, 8)):
        ours = best_us(lambda m=messages, d=drives: ours_s(m, d), len(messages))  # type: ignore[misc]
        print(
            f"our part, full bus, {name:12}: {ours:6.2f} µs a frame, cantools {rival:6.2f}, ratio {rival / ours:5.1f}"
        )
    full_bus(seconds)
    alone, ahead = slcan_us(5_000, read_ahead=False), slcan_us(20_000, read_ahead=True)
    print(f"slcan, python-can alone {alone:6.1f} µs a frame; with read-ahead {ahead:6.1f}, ratio {alone / ahead:4.1f}")


if __name__ == "__main__":
    main()
