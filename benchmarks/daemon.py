"""The running daemon: CPU, losses, latency, memory and the time to the first estimate; drives on real serial code.

Many drives are fed by one process (`benchmarks/feeder.py`). CPU is the daemon's own, from its first samples on and once
all have settled, without anybody who asks. Latency is from a frame's last byte written to the first REST answer that
contains it, of two drives asked in turn 200 times a second; how late any drive is, from asking each of them in turn.

    .venv/bin/python -m benchmarks.daemon                       1, 8, 32, 64 and 100 drives, 40 s each
    .venv/bin/python -m benchmarks.daemon --drives 8 --seconds 600
"""

from __future__ import annotations

import argparse
import contextlib
import http.client
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from benchmarks.feeder import FRAME, RATE_HZ, fed_drives
from drivers.base import DriveInfo
from servo_daemon.samples import F64, SampleBlock
from servo_daemon.sim_drive.serial_device import run_serial_device
from servo_daemon.simulate import SimulatedDrive, make_settings

REQUESTS_PER_S = 200
#: After the first samples, s: how long the start is measured for, and when it is over at the earliest. (The last
#: restart over the first samples begins after 155 ticks of 0.1 s, and takes over a second of CPU.)
FIRST_S, STARTED_S = 10.0, 20.0
#: The starts are over where so many seconds take no less of the CPU than those before, to this share.
_WINDOW_S, _NO_LESS = 5.0, 0.9


def come_up_s(n: int) -> float:
    """So long n drives may take to come up: start after start, each over a second of CPU."""
    return 30.0 + 2.0 * n


def cpu_s(pid: int) -> float:
    """Time it has run so far, s, threads that have ended included."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def rss_MB(pid: int) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


class Api:
    """One kept-alive connection."""

    def __init__(self, port: int) -> None:
        self._connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)

    def get(self, path: str) -> dict:
        self._connection.request("GET", f"/api/v1{path}")
        return json.loads(self._connection.getresponse().read())


def table(number: int, link: Path, more: str = "") -> str:
    """A drive on a serial link in a configuration."""
    return f'[[drive]]\nname = "axis{number}"\ndriver = "serial"\n{more}[drive.options]\nport = "{link}"\n'


PLAIN = "[drive.estimation]\nrefresh = false\n"


def tables_of(links: list[Path]) -> list[str]:
    return [table(k, link, PLAIN) for k, link in enumerate(links)]


@contextlib.contextmanager
def daemon(tables: list[str], folder: Path) -> Iterator[tuple[int, int]]:
    """The daemon with these drives: (pid, port)."""
    config = folder / "bench.toml"
    config.write_text("\n".join(tables))
    command = [sys.executable, "-m", "servo_daemon", "run", "--config", str(config), "--port", "0", "--state-dir"]
    process = subprocess.Popen([*command, str(folder)], stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    try:
        port = next(int(line.rsplit(":", 1)[1].strip().rstrip("/")) for line in process.stderr if "http://" in line)
        threading.Thread(target=lambda: [None for _ in process.stderr], daemon=True).start()
        yield process.pid, port
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(10)


@contextlib.contextmanager
def simulated_drives(n: int, folder: Path) -> Iterator[list[Path]]:
    links = [folder / f"drive{k}" for k in range(n)]
    base = [sys.executable, "-m", "servo_daemon", "sim-drive", "--rate", str(RATE_HZ)]
    processes = [
        subprocess.Popen([*base, "--serial", str(link), "--seed", str(k)], stderr=subprocess.DEVNULL)
        for k, link in enumerate(links)
    ]
    try:
        deadline = time.monotonic() + 30
        while not all(link.is_symlink() for link in links) and time.monotonic() < deadline:
            time.sleep(0.05)
        yield links
    finally:
        for process in processes:
            process.send_signal(signal.SIGTERM)
        for process in processes:
            process.wait(10)


def wait_for_samples(api: Api, n: int) -> None:
    deadline = time.monotonic() + come_up_s(n)
    while time.monotonic() < deadline:
        if all((api.get(f"/drives/axis{k}/estimates")["samples"] or 0) > RATE_HZ for k in range(n)):
            return
        time.sleep(0.1)
    raise SystemExit("the drives did not come up")


def used_percent(pid: int, work: Callable[[], object]) -> float:
    """CPU of the daemon while `work` runs, % of a core."""
    cpu, began = cpu_s(pid), time.monotonic()
    work()
    return 100 * (cpu_s(pid) - cpu) / (time.monotonic() - began)


def wait_for_starts(pid: int, n: int) -> float:
    """Until the starts of n drives, which wait for each other, are over; how long that took, s."""
    began, before = time.monotonic(), math.inf
    while time.monotonic() - began < come_up_s(n):
        now = used_percent(pid, lambda: time.sleep(_WINDOW_S))
        if now > _NO_LESS * before:
            break
        before = now
    return time.monotonic() - began


def settled_share(api: Api, n: int) -> float:
    """Of the drives: R is tracked."""
    known = [api.get(f"/drives/axis{k}/estimates")["parameters"]["R"]["status"] == "tracking" for k in range(n)]
    return sum(known) / n


def load(n: int, seconds: float, folder: Path) -> None:
    """n drives: CPU at first and then, latency, lateness, losses, memory."""
    spare_s = 2 * come_up_s(n) + STARTED_S + 0.3 * n  # start-up, starts, questions
    with fed_drives(n, folder, seconds + spare_s) as (links, begin), daemon(tables_of(links), folder) as (pid, port):
        api = Api(port)
        wait_for_samples(api, n)
        first = used_percent(pid, lambda: time.sleep(FIRST_S))
        time.sleep(STARTED_S - FIRST_S)
        started_s = STARTED_S + wait_for_starts(pid, n)
        api, (asking_s, steady_s) = Api(port), (seconds / 3, max(seconds - FIRST_S - seconds / 3, 5.0))
        before, memory = [api.get(f"/drives/axis{k}") for k in range(n)], rss_MB(pid)
        cpu = cpu_s(pid)
        steady = used_percent(pid, lambda: time.sleep(steady_s))
        cpu = cpu_s(pid) - cpu
        api = Api(port)  # an idle connection has been closed meanwhile
        worked = sum(
            api.get(f"/drives/axis{k}")["counters"]["samples"] - before[k]["counters"]["samples"] for k in range(n)
        )
        latency_ms = frames_to_rest(Api(port), (0, n // 2), asking_s, begin, n)
        late_s = latest(Api(port), n, max(5.0, asking_s), begin)
        api = Api(port)  # an idle connection has been closed meanwhile
        grown, after = rss_MB(pid), [api.get(f"/drives/axis{k}") for k in range(n)]
        tracked = settled_share(api, n)
    pairs = zip(after, before, strict=True)
    counted = [{k: a["counters"][k] - b["counters"][k] for k in b["counters"]} for a, b in pairs]
    samples, lost = sum(c["samples"] for c in counted), sum(c["samples_lost"] for c in counted)
    bad = sum(c["crc_errors"] + c["framing_errors"] for c in counted)
    p50, p99 = np.percentile(latency_ms, [50, 99])
    print(f"{n} drive{'s' * (n > 1)} at {RATE_HZ} Hz over serial lines, R tracked by {100 * tracked:.0f} %")
    print(f"  CPU {first:6.2f} % of a core in the first {FIRST_S:.0f} s, {steady:.2f} % from {started_s:.0f} s on")
    print(f"  that is {1e6 * cpu / worked:.2f} ms per 1,000 samples")
    print(f"  sample to REST: median {p50:.0f} ms, p99 {p99:.0f} ms; the latest drive was {late_s:.2f} s behind")
    print(f"  samples {samples:,}, lost {lost}, bad frames {bad}")
    print(f"  resident memory {memory:.0f} MB, then {grown:.0f} MB", flush=True)


def sent_by(time_s: F64, drive: int, n: int, begin: float) -> F64:
    """How many samples have left for a drive (`feeder.play`)."""
    return np.maximum(np.floor((time_s - begin) * RATE_HZ / FRAME - drive // 8 * 8 / n) + 1.0, 0.0) * FRAME


def frames_to_rest(api: Api, drives: tuple[int, ...], seconds: float, begin: float, n: int) -> F64:
    """From the last byte of each frame to the first answer with its samples, ms.

    Samples sent before the daemon attached are not in its count: what is constant is told from the quickest answer.
    """
    answers: dict[int, list[tuple[float, float]]] = {k: [] for k in drives}
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        for k, of_drive in answers.items():
            samples = api.get(f"/drives/axis{k}/estimates")["samples"]
            of_drive.append((samples, time.monotonic()))
            time.sleep(1.0 / REQUESTS_PER_S)
    out = []
    for k, found in answers.items():
        got = np.array(found)
        offset = FRAME * np.floor((sent_by(got[:, 1], k, n, begin) - got[:, 0]).min() / FRAME)
        number = np.arange(got[0, 0] + offset + FRAME, got[-1, 0] + offset, FRAME)  # the last sample of each frame
        left = begin + ((number / FRAME - 1.0) + k // 8 * 8 / n) * FRAME / RATE_HZ
        at = np.searchsorted(got[:, 0] + offset, number)
        out.append(1e3 * (got[at, 1] - left))
    return np.concatenate(out)


def latest(api: Api, n: int, seconds: float, begin: float) -> float:
    """How far behind the published state of any drive was at the worst, s, beside its own best."""
    behind: dict[int, list[float]] = {k: [] for k in range(n)}
    end, k = time.monotonic() + seconds, 0
    while time.monotonic() < end:
        samples = api.get(f"/drives/axis{k % n}/estimates")["samples"]
        now = np.array([time.monotonic()])
        behind[k % n].append(float(sent_by(now, k % n, n, begin)[0] - samples) / RATE_HZ)
        k += 1
        time.sleep(1.0 / REQUESTS_PER_S)
    return max(max(late) - min(late) for late in behind.values() if late)


class Stamped:
    """A source that notes when each block has left: when the device comes for the next one."""

    def __init__(self) -> None:
        self._drive = SimulatedDrive(make_settings(seed=3))
        self.left: list[tuple[int, float]] = []
        self._samples = 0

    @property
    def info(self) -> DriveInfo:
        return self._drive.info

    def next_block(self, n: int) -> SampleBlock:
        if self._samples:
            self.left.append((self._samples, time.monotonic()))
        self._samples += n
        return self._drive.next_block(n)


def latency(seconds: float, folder: Path) -> None:
    """Frame written to REST answer."""
    source, stop, link = Stamped(), threading.Event(), folder / "latency"
    device = threading.Thread(target=run_serial_device, args=(link, source), kwargs={"stop": stop})
    device.start()
    answers: list[tuple[int, float]] = []
    try:
        with daemon([table(0, link)], folder) as (_, port):
            api = Api(port)
            wait_for_samples(api, 1)
            first = api.get("/drives/axis0")["counters"]
            end = time.monotonic() + seconds
            while time.monotonic() < end:
                answers.append((api.get("/drives/axis0/estimates")["samples"], time.monotonic()))
                time.sleep(0.001)
            last = api.get("/drives/axis0")["counters"]
    finally:
        stop.set()
        device.join()
    # Samples sent before the daemon attached are not in its count: align by the offset that stays constant.
    sent = np.array(source.left)
    got = np.array(answers)
    rate_offset = np.interp(got[:, 1], sent[:, 1], sent[:, 0]) - got[:, 0]
    step = source.left[1][0] - source.left[0][0]
    offset = step * np.floor(rate_offset.min() / step)
    at = np.searchsorted(got[:, 0] + offset, sent[:, 0])
    seen = (sent[:, 1] > answers[0][1]) & (at < len(got))
    delay_ms = 1e3 * (got[at[seen], 1] - sent[seen, 1])
    p50, p99 = np.percentile(delay_ms, [50, 99])
    print(f"sample to REST over {seen.sum()} frames: median {p50:.0f} ms, p99 {p99:.0f} ms (limit 60 ms)")
    print(f"  samples lost meanwhile: {last['samples_lost'] - first['samples_lost']}")


def first_estimate(folder: Path) -> None:
    """Start of the process to a tracked R, caches warm."""
    with simulated_drives(1, folder) as links:
        began = time.monotonic()
        with daemon(tables_of(links), folder) as (_, port):
            listening = time.monotonic() - began
            api, estimated = Api(port), None
            while time.monotonic() - began < 20:
                document = api.get("/drives/axis0/estimates")
                if document["samples"] and estimated is None:
                    estimated = time.monotonic() - began
                if document["parameters"]["R"]["status"] == "tracking":
                    break
                time.sleep(0.01)
            tracking = time.monotonic() - began
    print(
        f"start: API after {listening:.2f} s, first samples {estimated:.2f} s, R tracking {tracking:.2f} s (limit 3 s)"
    )


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=40.0, help="with each number of drives")
    parser.add_argument("--drives", type=int, nargs="+", default=[1, 8, 32, 64, 100], help="how many")
    parser.add_argument("--only-load", action="store_true", help="nothing about starts and one drive's latency")
    arguments = parser.parse_args()
    if not arguments.only_load:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            first_estimate(folder)
            for state in folder.glob("*.json"):
                state.unlink()
            first_estimate(folder)
            latency(min(30.0, arguments.seconds), folder)
    for n in arguments.drives:
        with tempfile.TemporaryDirectory() as name:
            load(n, arguments.seconds, Path(name))


if __name__ == "__main__":
    main()
