"""The running daemon: CPU, losses, latency, memory and the time to the first estimate; drives on real serial code.

Each drive is a `sim-drive` process on a pseudo-terminal, so the simulation's cost is not the daemon's. The API is asked
200 times a second meanwhile. Latency is from a frame's last byte written to the first REST answer that contains it,
asked for without pause.

    .venv/bin/python benchmarks/daemon.py                  one and eight drives, 10 minutes with eight
    .venv/bin/python benchmarks/daemon.py --seconds 60     shorter
"""

from __future__ import annotations

import argparse
import contextlib
import http.client
import json
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

from drivers.base import DriveInfo
from servo_daemon.samples import SampleBlock
from servo_daemon.sim_drive.serial_device import run_serial_device
from servo_daemon.simulate import SimulatedDrive, make_settings

RATE_HZ, REQUESTS_PER_S = 1000, 200


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


def tables_of(links: list[Path]) -> list[str]:
    return [table(k, link) for k, link in enumerate(links)]


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
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        if all((api.get(f"/drives/axis{k}/estimates")["samples"] or 0) > RATE_HZ for k in range(n)):
            return
        time.sleep(0.1)
    raise SystemExit("the drives did not come up")


def ask(api: Api, n: int, seconds: float) -> int:
    """`REQUESTS_PER_S` evenly for so long; returns how many it were."""
    began, asked = time.monotonic(), 0
    while time.monotonic() - began < seconds:
        api.get(f"/drives/axis{asked % n}/estimates")
        asked += 1
        time.sleep(max(0.0, asked / REQUESTS_PER_S - (time.monotonic() - began)))
    return asked


def used_percent(pid: int, work: Callable[[], object]) -> float:
    """CPU of the daemon while `work` runs, % of a core."""
    cpu, began = cpu_s(pid), time.monotonic()
    work()
    return 100 * (cpu_s(pid) - cpu) / (time.monotonic() - began)


def load(n: int, seconds: float, folder: Path) -> None:
    """CPU with n drives, alone and while the API answers; memory and losses over all of it."""
    with simulated_drives(n, folder) as links, daemon(tables_of(links), folder) as (pid, port):
        api = Api(port)
        wait_for_samples(api, n)
        before, memory = [api.get(f"/drives/axis{k}") for k in range(n)], rss_MB(pid)
        alone = used_percent(pid, lambda: time.sleep(max(10.0, seconds / 10)))
        asked = used_percent(pid, lambda: ask(Api(port), n, seconds))
        api = Api(port)  # an idle connection has been closed meanwhile
        grown, after = rss_MB(pid), [api.get(f"/drives/axis{k}") for k in range(n)]
    pairs = zip(after, before, strict=True)
    counted = [{k: a["counters"][k] - b["counters"][k] for k in b["counters"]} for a, b in pairs]
    samples, lost = sum(c["samples"] for c in counted), sum(c["samples_lost"] for c in counted)
    bad = sum(c["crc_errors"] + c["framing_errors"] for c in counted)
    limit = 5 if n == 1 else 30
    print(f"{n} drive{'s' * (n > 1)} at {RATE_HZ} Hz over serial lines")
    print(f"  CPU {alone:6.2f} % of a core (limit {limit} %: {alone / limit:.2f} of it)")
    print(f"  CPU {asked:6.2f} % with {REQUESTS_PER_S} requests a second, {seconds:.0f} s long")
    print(f"  samples {samples:,}, lost {lost}, bad frames {bad}")
    print(f"  resident memory {memory:.0f} MB at the start, {grown:.0f} MB at the end (limit 300 MB)")


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
    parser.add_argument("--seconds", type=float, default=600.0, help="with eight drives; a tenth of it with one")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        first_estimate(folder)
        for state in folder.glob("*.json"):
            state.unlink()
        first_estimate(folder)
        latency(min(30.0, arguments.seconds), folder)
        load(1, max(20.0, arguments.seconds / 10), folder)
        load(8, arguments.seconds, folder)


if __name__ == "__main__":
    main()
