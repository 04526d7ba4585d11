"""How long the heavy steps of one drive hold up the ticks of another in the same process, beside no step at all.

A drive at 1 kHz gets a block of 40 samples every 40 ms in a thread of its own, as from a reader. Another thread makes
an estimator from nothing (derived, compiled), works off a start with its re-linearisations, a jump that is searched
for, the same without a C compiler, and with filterpy. Late is how much later than due a block is worked off. As in the
daemon, threads let each other on after `SWITCH_S`, and the garbage collector leaves alone what was there at the start.

    .venv/bin/python -m benchmarks.heavy_steps
"""

from __future__ import annotations

import gc
import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from servo_daemon.commands.run.serve import SWITCH_S
from servo_daemon.config import DriveConfig, parse_config
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.samples import SampleBlock
from servo_daemon.simulate import DEFAULT_NOMINAL, SimulatedDrive, make_settings

LIMIT_MS, BLOCK = 50.0, 40
#: A model whose step takes a compiler ten seconds.
LARGE = ("stribeck_friction", "gravity_load", "cogging_torque")
#: Nothing is done for so long, and every step again until it has taken so long together, s.
IDLE_S, LEAST_S = 10.0, 5.0


def config(engine: str = "compiled", effects: tuple[str, ...] = ()) -> DriveConfig:
    estimation = {"engine": engine, "refresh": False}
    drive = {"driver": "simulated", "nominal": dict(DEFAULT_NOMINAL), "model": list(effects), "estimation": estimation}
    return parse_config({"drive": [drive]}).drive[0]


def recording(seconds: float, rate_hz: float = 1000.0, ageing: tuple[str, ...] = ()) -> SampleBlock:
    return SimulatedDrive(make_settings(seed=5, rate_hz=rate_hz, ageing=ageing)).next_block(round(seconds * rate_hz))


def work_off(drive: DriveConfig, samples: SampleBlock) -> None:
    """In rounds of half a thousand, as the worker does."""
    pipeline = Pipeline(drive)
    for k in range(0, len(samples), 500):
        pipeline.process(samples.slice(k, min(k + 500, len(samples))), rows=False)


@contextmanager
def without_compiler() -> Iterator[None]:
    os.environ["SERVO_DAEMON_CC"] = ""
    try:
        yield
    finally:
        del os.environ["SERVO_DAEMON_CC"]


def steps() -> dict[str, Callable[[], None]]:
    slow, start, fast = recording(0.05), recording(20.0), recording(6.0, 10_000.0)
    jump = recording(30.0, ageing=("R=+0.2@15s",))

    def in_machine() -> None:
        with without_compiler():
            work_off(config(), start)

    return {
        "nothing": lambda: time.sleep(IDLE_S),
        f"an estimator with {', '.join(LARGE)}": lambda: work_off(config(effects=LARGE), slow),
        "a start at 1 kHz, re-linearised": lambda: work_off(config(), start),
        "a start at 10 kHz, re-linearised": lambda: work_off(config(), fast),
        "a jump of R, searched for": lambda: work_off(config(), jump),
        "a start in the virtual machine": in_machine,
        "filterpy": lambda: work_off(config("filterpy"), start.slice(0, 8000)),
    }


class Neighbour(threading.Thread):
    """The drive that is to be held up by nothing; endless samples of a motor that it has learned already."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self._source = SimulatedDrive(make_settings(seed=6))
        self._pipeline = Pipeline(config())
        self._pipeline.process(self._source.next_block(20_000), rows=False)
        self._blocks = [self._source.next_block(BLOCK) for _ in range(8_000)]
        self.late_ms: list[float] = []
        self.done = threading.Event()

    def run(self) -> None:
        due = time.monotonic()
        for block in self._blocks:
            due += BLOCK * 1e-3
            if self.done.wait(max(0.0, due - time.monotonic())):
                return
            self._pipeline.process(block, rows=False)
            self._pipeline.current()
            self.late_ms.append(1e3 * (time.monotonic() - due))


def main() -> None:
    with tempfile.TemporaryDirectory() as cache:
        os.environ["CACHE_DIRECTORY"] = cache
        heavy, neighbour = steps(), Neighbour()
        sys.setswitchinterval(SWITCH_S)
        gc.collect()
        gc.freeze()
        neighbour.start()
        print(f"a tick of another drive is late by, ms (limit {LIMIT_MS:.0f} more than beside nothing)")
        for name, step in heavy.items():
            neighbour.late_ms.clear()
            began = time.monotonic()
            repeats = 0
            while repeats == 0 or time.monotonic() - began < LEAST_S:
                step()
                repeats += 1
            late = np.array(neighbour.late_ms)
            took = (time.monotonic() - began) / repeats
            print(f"  {name:65s} {took:5.1f} s: median {np.median(late):5.1f}, longest {late.max():6.1f}", flush=True)
        neighbour.done.set()
        neighbour.join()


if __name__ == "__main__":
    main()
