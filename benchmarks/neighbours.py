"""Eight drives on pseudo-terminals at 1 kHz, two of them trouble: what do the other six lose, and how late are they?

`axis6` has `engine = "filterpy"`, which a small machine cannot keep up with. `axis7` is a wire gone mad: spikes,
numbers that are none, jumps of time, restarts, noise between frames. Each device is a process of its own that plays
samples made beforehand, so that the simulation's cost is not the daemon's. Latency is from a frame's last byte written
to the first REST answer that contains it; the six are asked one after another, nearly 200 times a second. It is
measured from when all six have worked off their starts and what came meanwhile, which is told as well.

    .venv/bin/python -m benchmarks.neighbours                one minute
    .venv/bin/python -m benchmarks.neighbours --seconds 20
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.daemon import RATE_HZ, REQUESTS_PER_S, STARTED_S, Api, cpu_s, daemon, table
from drivers.base import DriveInfo
from servo_daemon.errors import EndOfStreamError
from servo_daemon.samples import SampleBlock
from servo_daemon.sim_drive.line_faults import Fault, LineFaults
from servo_daemon.sim_drive.serial_device import run_serial_device
from servo_daemon.simulate import DEFAULT_NOMINAL, SimulatedDrive, make_settings

ORDINARY, FILTERPY, GARBAGE = 6, 6, 7
LIMIT_MS = 100.0
#: Room for a slow start, s.
SPARE_S = 80.0
#: A drive has worked off its start once what is published is younger, s.
LIVE_S = 0.5
_NOMINAL = "[drive.nominal]\n" + "".join(f"{k} = {v}\n" for k, v in DEFAULT_NOMINAL.items())
_PLAIN = "[drive.estimation]\nrefresh = false\n" + _NOMINAL
_SLOW = '[drive.estimation]\nrefresh = false\nengine = "filterpy"\n' + _NOMINAL


class Recording:
    """A source that plays samples and notes when each block has left: when the device comes for the next one."""

    def __init__(self, seed: int, seconds: float, *, wrecked: bool) -> None:
        drive = SimulatedDrive(make_settings(seed=seed))
        self.info: DriveInfo = drive.info
        self.left: list[tuple[int, float]] = []
        block = drive.next_block(round(seconds * RATE_HZ))
        self._block, self._next = spoilt(block, seed) if wrecked else block, 0

    def next_block(self, n: int) -> SampleBlock:
        if self._next:
            self.left.append((self._next, time.monotonic()))
        if self._next + n > len(self._block):
            raise EndOfStreamError("played to the end")
        self._next += n
        return self._block.slice(self._next - n, self._next)


def spoilt(block: SampleBlock, seed: int) -> SampleBlock:
    """Spikes, numbers that are none and steps of time, a few of each every second."""
    rng, n = np.random.default_rng(seed), len(block)
    time_s, channels = block.time_s.copy(), {}
    for name in ("voltage_V", "current_A", "position_rad"):
        values = np.array(getattr(block, name))
        spikes, none = rng.random(n) < 0.005, rng.random(n) < 0.005
        values[spikes] += rng.normal(0.0, 100.0, np.count_nonzero(spikes))
        values[none] = rng.choice([np.nan, np.inf, -np.inf], np.count_nonzero(none))
        channels[name] = values
    steps = np.where(rng.random(n) < 0.003, rng.exponential(0.02, n), 0.0)
    return replace(block, time_s=time_s + np.cumsum(steps), **channels)


def device(number: int, link: Path, seconds: float, left: Path, stop: Any) -> None:
    """In a process of its own."""
    source, done = Recording(100 + number, seconds, wrecked=number == GARBAGE), threading.Event()
    threading.Thread(target=lambda: (stop.wait(), done.set()), daemon=True).start()
    faults = LineFaults()
    if number == GARBAGE:
        rng = np.random.default_rng(number)
        kinds = [k for k in Fault if k is not Fault.RESTART] * 3 + [Fault.RESTART]
        at = np.flatnonzero(rng.random(round(seconds * RATE_HZ / 10)) < 0.05)
        faults = LineFaults({int(k): kinds[rng.integers(len(kinds))] for k in at})
    run_serial_device(link, source, stop=done, faults=faults)
    np.save(left, np.array(source.left))


@contextmanager
def devices(seconds: float, folder: Path) -> Iterator[list[Path]]:
    """Eight links; when it is left the devices have noted what they sent."""
    context = multiprocessing.get_context("spawn")
    stop, links = context.Event(), [folder / f"drive{k}" for k in range(ORDINARY + 2)]
    processes = [
        context.Process(target=device, args=(k, link, seconds, folder / f"left{k}.npy", stop))
        for k, link in enumerate(links)
    ]
    for process in processes:
        process.start()
    try:
        while not all(link.is_symlink() for link in links):
            time.sleep(0.05)
        yield links
    finally:
        stop.set()
        for process in processes:
            process.join(10)


def started(api: Api) -> float:
    """Wait until the start of each of the six is over and none is behind from it. Returns how long that took, s.

    Raises:
        SystemExit: within `SPARE_S` they are not.
    """
    began = time.monotonic()
    while time.monotonic() < began + SPARE_S:
        drives = [api.get(f"/drives/axis{k}/estimates") for k in range(ORDINARY)]
        over = all((d["samples"] or 0) > STARTED_S * RATE_HZ for d in drives)
        if over and all(age(d["time"]) < timedelta(seconds=LIVE_S) for d in drives):
            return time.monotonic() - began
        time.sleep(0.2)
    raise SystemExit(f"an ordinary drive is behind still after {SPARE_S:.0f} s")


def age(time: str) -> timedelta:
    """Of a sample with this time by the host's clock, ISO 8601."""
    return datetime.now(UTC) - datetime.fromisoformat(time)


def watch(api: Api, seconds: float) -> list[list[tuple[int, float]]]:
    """How many samples each of the six had, and when that was answered."""
    answers: list[list[tuple[int, float]]] = [[] for _ in range(ORDINARY)]
    for k in range(ORDINARY):
        end = time.monotonic() + seconds / ORDINARY
        while time.monotonic() < end:
            answers[k].append((api.get(f"/drives/axis{k}/estimates")["samples"], time.monotonic()))
            time.sleep(1 / REQUESTS_PER_S)
    return answers


def delays_ms(sent: np.ndarray, got: np.ndarray) -> np.ndarray:
    """From each frame's end to the first answer that contains it. Samples from before the daemon listened are not in
    its count: aligned by the offset that stays constant."""
    behind = np.interp(got[:, 1], sent[:, 1], sent[:, 0]) - got[:, 0]
    step = sent[0, 0]
    offset = step * np.floor(behind.min() / step)
    at = np.searchsorted(got[:, 0] + offset, sent[:, 0])
    seen = (sent[:, 1] > got[0, 1]) & (at < len(got))
    return np.asarray(1e3 * (got[at[seen], 1] - sent[seen, 1]))


def said(before: dict[str, Any], now: dict[str, Any], events: list[dict[str, Any]]) -> str:
    """Of a drive that is trouble."""
    used, lost = now["samples"] - before["samples"], now["health"]["samples_lost"] - before["health"]["samples_lost"]
    kinds = [e["kind"] for e in events]
    told = ", ".join(f"{kinds.count(k)} {k}" for k in ("overloaded", "overload_over", "device_restarted"))
    failed = now["health"]["pipeline_failures"]
    return f"used {used:,}, lost {lost:,}, overloaded {now['health']['overloaded']}; events: {told}; failures {failed}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0)
    seconds: float = parser.parse_args().seconds
    with tempfile.TemporaryDirectory() as name:
        folder, numbers = Path(name), range(ORDINARY + 2)
        with devices(seconds + SPARE_S, folder) as links:
            tables = [table(k, link, _SLOW if k == FILTERPY else _PLAIN) for k, link in enumerate(links)]
            with daemon(tables, folder) as (pid, port):
                api = Api(port)
                took_s = started(api)
                paths = [f"/drives/axis{k}/estimates" for k in numbers]
                first, cpu, load = [api.get(p) for p in paths], cpu_s(pid), os.getloadavg()[0]
                answers = watch(api, seconds)
                used_percent = 100 * (cpu_s(pid) - cpu) / seconds
                last = [api.get(p) for p in paths]
                events = [api.get(f"/drives/axis{k}/events")["events"] for k in numbers]
        sent = [np.load(folder / f"left{k}.npy") for k in range(ORDINARY)]
    late = np.concatenate([delays_ms(s, np.array(a)) for s, a in zip(sent, answers, strict=True)])
    lost = sum(d["health"]["samples_lost"] for d in last[:ORDINARY])
    samples = sum(
        b["samples"] - a["samples"] for a, b in zip(first, last, strict=True) if b["drive"] < f"axis{ORDINARY}"
    )
    p50, p99, longest = np.percentile(late, [50, 99, 100]) if len(late) else [np.inf] * 3
    print(f"six ordinary drives beside filterpy and garbage, {seconds:.0f} s; load of the machine {load:.1f}")
    print(f"  all six live {took_s:.0f} s after the daemon answered")
    print(f"  samples {samples:,}, lost since the start {lost} (limit 0)")
    print(
        f"  sample to REST over {len(late):,} frames: median {p50:.0f} ms, p99 {p99:.0f} ms (limit {LIMIT_MS:.0f} ms)"
    )
    print(f"  longest {longest:.0f} ms; CPU {used_percent:.0f} % of a core")
    print(f"filterpy at 1 kHz: {said(first[FILTERPY], last[FILTERPY], events[FILTERPY])}")
    print(f"garbage: {said(first[GARBAGE], last[GARBAGE], events[GARBAGE])}")


if __name__ == "__main__":
    main()
