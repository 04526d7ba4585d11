"""A fleet of drives with short captures: what pooling gains, and what the work on several processes costs.

    python -m benchmarks.fleet                              # 200 drives, one capture of 2 s each
    python -m benchmarks.fleet --drives 1000 --seconds 20   # 40 minutes; 20 with --alone 200

Efficiency is that of two workers against one, a drive: half of the one's time is 100 %. On a machine of two cores the
scheduler and the client have no core of their own. Overhead is what a unit without work costs.
"""

from __future__ import annotations

import argparse
import os
import resource
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from servo_daemon.commands.fleet.analysis import Fleet, analyse
from servo_daemon.commands.fleet.work import fit_unit
from servo_daemon.fleet.cluster import cluster, results
from servo_daemon.fleet.units import Unit, find_units
from tests.recovery.many_drives import SPREAD, draw, record

#: Asked for: rms of pooled values against unpooled ones; share of twice one worker's speed; s a unit; bytes a worker.
MOST_RATIO, LEAST_EFFICIENCY, MOST_OVERHEAD_S, MOST_BYTES = 0.8, 0.9, 0.020, 1e9
_EMPTY = 2000


def nothing(_unit: Unit, _asked: tuple[str, ...]) -> dict[str, Any]:
    """A unit without work."""
    return {}


def largest_bytes() -> int:
    """Most memory that this process has had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def make(folder: Path, seed: int, seconds: float, number: int) -> None:
    """The capture of one drive."""
    motion = ("steps", "reversals", "pick_and_place", "multisine")[number % 4]
    record(folder / f"axis{number:05d}.csv", draw(number, seed), seconds=seconds, motion=motion, seed=seed + number)


def timed(units: tuple[Unit, ...], workers: int) -> tuple[float, list[dict[str, Any]], int]:
    """Seconds without starting the cluster and the workers' imports, documents, bytes of the largest worker."""
    with cluster(None, workers) as client:
        for _ in results(client, units[: 2 * workers], fit_unit, ()):
            pass
        began = time.perf_counter()
        found = dict(results(client, units, fit_unit, ()))
        took = time.perf_counter() - began
        memory = max(client.run(largest_bytes).values())
    return took, [found[unit] for unit in units], memory


def overhead_s(workers: int) -> float:
    """Of a unit without work."""
    units = [Unit(str(k), (), ()) for k in range(_EMPTY)]
    with cluster(None, workers) as client:
        began = time.perf_counter()
        for _ in results(client, units, nothing, ()):
            pass
        return (time.perf_counter() - began) / _EMPTY


def gain_table(fleet: Fleet, seed: int) -> list[str]:
    """rms errors of each drive's own values and of the pooled ones, and how many intervals hold."""
    lines = ["| parameter | own rms | pooled rms | ratio | 95 % intervals hold |", "|---|---|---|---|---|"]
    if fleet.pooled is None:
        return ["nothing was pooled"]
    motors = [draw(int(d["drive"].removeprefix("axis")), seed) for d in fleet.documents]
    ratios = []
    for j, name in enumerate(fleet.names):
        if name not in SPREAD:
            continue
        true = np.log([getattr(m, name) for m in motors])
        own, pooled = fleet.own[:, j] - true, fleet.pooled.mean[:, j] - true
        inside = np.mean(np.abs(pooled) < 1.96 * np.sqrt(fleet.pooled.cov[:, j, j]))
        before, after = (float(np.sqrt(np.mean(e**2))) for e in (own, pooled))
        ratios.append(after / before)
        lines.append(f"| {name} | {before:.2%} | {after:.2%} | {after / before:.2f} | {inside:.0%} |")
    lines.append(
        f"| in the mean (geometric) |  |  | {float(np.exp(np.mean(np.log(ratios)))):.2f} (≤ {MOST_RATIO}) |  |"
    )
    return lines


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fleet")
    parser.add_argument("--drives", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=2.0, help="of each capture")
    parser.add_argument("--alone", type=int, help="drives that one worker is timed with; else all")
    parser.add_argument("--seed", type=int, default=27)
    asked = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with ProcessPoolExecutor() as pool:
            list(pool.map(partial(make, folder, asked.seed, asked.seconds), range(asked.drives)))
        units = find_units([name])
        alone = units[: asked.alone]
        one_s = timed(alone, 1)[0] / len(alone)
        took_s, documents, memory = timed(units, 2)
    two_s = took_s / len(units)
    fleet = analyse(documents)
    strangers = 0 if fleet.pooled is None else int(fleet.pooled.stranger.sum())
    print(
        f"{asked.drives} drives, {asked.seconds:g} s each: without result {len(fleet.failed)}, strangers {strangers}\n"
    )
    print("\n".join(gain_table(fleet, asked.seed)))
    print("\n| work | measured | limit |\n|---|---|---|")
    print(f"| one worker, {len(alone)} drives | {one_s:.3f} s a drive | |")
    print(f"| two workers | {two_s:.3f} s a drive, {one_s / (2 * two_s):.0%} of twice | {LEAST_EFFICIENCY:.0%} |")
    print(f"| a unit without work | {1e3 * overhead_s(2):.1f} ms | {1e3 * MOST_OVERHEAD_S:.0f} ms |")
    print(f"| largest worker | {memory / 1e6:.0f} MB | {MOST_BYTES / 1e6:.0f} MB |")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
