"""Reading and writing a capture of 10^6 samples with 4 columns against the usual ways, in one run.

Reading: ours checks everything (columns, finite values, increasing time) and names the line if something is wrong; the
rivals are a loop over Python's csv module and numpy.genfromtxt (on a tenth of the rows, time scaled up), which check
nothing, and the bare numpy.loadtxt inside ours, which is the limit. Writing: ours gives the shortest decimals that read
back exactly; numpy.savetxt needs %.17g for that.

    .venv/bin/python benchmarks/captures.py [samples]
"""

from __future__ import annotations

import csv
import io
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from servo_daemon.captures import read_capture, write_capture
from servo_daemon.samples import SampleBlock, make_block

REPEATS = 3
RIVAL_SHARE = 10


def motor_like(n: int) -> SampleBlock:
    """A walk with the digits of real measurements: full doubles, 1 kHz with 1 % jitter."""
    rng = np.random.default_rng(1)
    return make_block(
        np.cumsum(1e-3 + 1e-5 * rng.uniform(-1, 1, n)),
        voltage_V=12 * np.sin(np.arange(n) / 300) + 0.01 * rng.normal(size=n),
        current_A=rng.normal(size=n),
        position_rad=np.cumsum(rng.normal(size=n)) * 1e-3,
    )


def shortest_s(action: Callable[[], object], repeats: int = REPEATS) -> float:
    """Shortest wall-clock time of several runs, s."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        action()
        times.append(time.perf_counter() - start)
    return min(times)


def csv_loop(path: Path) -> np.ndarray:
    """The rival everybody writes first."""
    with path.open(newline="") as lines:
        rows = csv.reader(lines)
        next(rows)
        return np.array([[float(cell) for cell in row] for row in rows])


def savetxt(block: SampleBlock) -> None:
    """The rival of writing, at the same precision."""
    table = np.column_stack([block.time_s, *(getattr(block, name) for name in block.channels)])
    np.savetxt(io.StringIO(), table, fmt="%.17g", delimiter=",")


def main() -> None:
    n = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
    block = motor_like(n)
    part = block.slice(0, n // RIVAL_SHARE)
    with tempfile.TemporaryDirectory() as folder:
        path, packed, small = (Path(folder) / name for name in ("a.csv", "a.csv.gz", "small.csv"))
        writing = {
            "write .csv, ours": shortest_s(lambda: write_capture(path, block)),
            "write .csv.gz, ours": shortest_s(lambda: write_capture(packed, block), 1),
            "numpy.savetxt to memory": RIVAL_SHARE * shortest_s(lambda: savetxt(part)),
        }
        write_capture(small, part)
        capture = read_capture(path)
        assert all(np.array_equal(getattr(capture, c), getattr(block, c)) for c in ("time_s", *block.channels))
        reading = {
            "read .csv, ours": shortest_s(lambda: read_capture(path)),
            "read .csv.gz, ours": shortest_s(lambda: read_capture(packed)),
            "numpy.loadtxt, no checks": shortest_s(lambda: np.loadtxt(path, delimiter=",", skiprows=1)),
            "csv module, loop": RIVAL_SHARE * shortest_s(lambda: csv_loop(small)),
            "numpy.genfromtxt": RIVAL_SHARE * shortest_s(lambda: np.genfromtxt(small, delimiter=",", skip_header=1)),
        }
        size = path.stat().st_size
    print(f"{n} samples × {1 + len(block.channels)} columns, {size / 1e6:.0f} MB as CSV")
    for results in (reading, writing):
        ours = next(iter(results.values()))
        for what, seconds in results.items():
            print(f"{what:26s} {seconds:6.2f} s  {seconds / n * 1e6:6.2f} µs/sample  {seconds / ours:5.2f} × ours")


if __name__ == "__main__":
    main()
