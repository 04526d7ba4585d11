"""A daemon that records, killed (SIGKILL) again and again, and started anew on the same files.

Half of the kills come at any moment, half within milliseconds of a write to the database. After each the next daemon
starts on what is there; then what is in the database is compared with the moment of the kill and with what was there
before it.

    .venv/bin/python -m benchmarks.kills                 50 kills, by two daemons with two drives each
"""

from __future__ import annotations

import argparse
import contextlib
import sqlite3
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from signal import SIGKILL

import numpy as np

from servo_daemon.daemon.recording import FILE
from servo_daemon.history.codec import unpack
from servo_daemon.numerics import milliseconds
from tests.system.harness import DaemonProgram, nominal_table, wait_for, write_config

DRIVES = ("axis1", "axis2")
#: A life before its kill, s: turns of the writer are 3 s apart.
LIFE_S = (0.5, 6.0)
#: After the database has been written to, s: in the middle of a turn, or just after it.
AFTER_WRITE_S = 0.01
PLAIN = 'driver = "simulated"\n'


@dataclass
class Found:
    """Attributes:
    lost_s: of each kill, the drive that lost most: from its last row (or its first moment alive) to the kill.
    in_write: how many came right after a write.
    gone: rows that were there before a kill and no more after it.
    twice: rows that are there twice.
    broken: files that were set aside, and what SQLite finds.
    starts_s: from the start of a process to its answer.
    """

    lost_s: list[float] = field(default_factory=list)
    starts_s: list[float] = field(default_factory=list)
    in_write: int = 0
    rows: int = 0
    gone: int = 0
    twice: int = 0
    broken: list[str] = field(default_factory=list)


def times_of_rows(file: Path) -> dict[str, list[float]]:
    """Moments of the single rows of each drive, ms since the epoch; each as often as it is there."""
    found: dict[str, list[float]] = {drive: [] for drive in DRIVES}
    if not file.exists():
        return found
    with contextlib.closing(sqlite3.connect(f"file:{file}?mode=ro", uri=True)) as connection:
        query = "SELECT name, data FROM block JOIN drive ON drive.id = block.drive WHERE level = 0"
        for name, data in connection.execute(query):
            # As where single rows are packed: one of 8,000 times is a half.
            found[name] += milliseconds(unpack(data).time_s).tolist()
    return found


def live(config: Path, state: Path, rng: np.random.Generator, in_write: bool, found: Found) -> tuple[float, float]:
    """One life: from its API's first answer to its kill, both s since the epoch."""
    began = time.monotonic()
    program = DaemonProgram("--config", config, "--state-dir", state)
    try:
        found.starts_s.append(time.monotonic() - began)
        up_s = time.time()
        time.sleep(rng.uniform(*LIFE_S))
        if in_write:
            wal = state / f"{FILE}-wal"
            wait_for(wal.exists, "the history is opened")
            before = wal.stat().st_mtime_ns
            wait_for(lambda: wal.stat().st_mtime_ns != before, "the history is written", every_s=2e-4)
            time.sleep(rng.uniform(0.0, AFTER_WRITE_S))
            found.in_write += 1
        killed_s = time.time()
        program.send(SIGKILL)
        program.wait()
        found.broken += [line for line in program.log if "set aside" in line or "Traceback" in line]
    finally:
        program.end()
    return up_s, killed_s


def compare(
    file: Path, before: dict[str, list[float]], up_s: float, killed_s: float, found: Found
) -> dict[str, list[float]]:
    """What a kill has cost; the rows that are there now. Reading recovers the database as the next start would."""
    now = times_of_rows(file)
    found.lost_s.append(max(killed_s - max([up_s, *(t / 1e3 for t in now[drive])]) for drive in DRIVES))
    found.gone += sum(len(set(before[drive]) - set(now[drive])) for drive in DRIVES)
    found.twice += sum(len(times) - len(set(times)) for times in now.values())
    found.rows = sum(map(len, now.values()))
    with contextlib.closing(sqlite3.connect(file)) as connection:
        (verdict,) = connection.execute("PRAGMA integrity_check").fetchone()
    found.broken += [] if verdict == "ok" else [str(verdict)]
    return now


def lives(folder: Path, kills: int, seed: int) -> Found:
    """One daemon's lives, each ended by a kill; and a last one that ends cleanly."""
    folder.mkdir()
    tables = [f'name = "{drive}"\n{PLAIN}{nominal_table()}' for drive in DRIVES]
    config, state, found = write_config(folder / "kills.toml", *tables), folder / "state", Found()
    rng = np.random.default_rng(seed)
    before = times_of_rows(state / FILE)
    for k in range(kills):
        up_s, killed_s = live(config, state, rng, k % 2 == 1, found)
        before = compare(state / FILE, before, up_s, killed_s, found)
        print(f"kill {k + 1} of {kills}: {found.lost_s[-1]:.1f} s lost", file=sys.stderr, flush=True)
    program = DaemonProgram("--config", config, "--state-dir", state)
    try:
        health = program.get("/health")
        assert health["status"] == "ok", health
        program.stop()
    finally:
        program.end()
    found.broken += sorted(path.name for path in state.iterdir() if ".bad" in path.name)
    return found


def report(found: list[Found]) -> str:
    """The table."""
    lost = np.concatenate([f.lost_s for f in found])
    starts = np.concatenate([f.starts_s for f in found])
    broken = [text for f in found for text in f.broken]
    lines = [
        "| | measured | wanted |",
        "|---|---|---|",
        f"| kills; right after a write | {len(lost)}; {sum(f.in_write for f in found)} | 50 |",
        f"| history lost by a kill, s: median, most | {np.median(lost):.1f}, {lost.max():.1f} | ≤ 5 |",
        f"| rows there before a kill and gone after it, of {sum(f.rows for f in found):,} "
        f"| {sum(f.gone for f in found)} | 0 |",
        f"| rows there twice | {sum(f.twice for f in found)} | 0 |",
        f"| databases broken or set aside | {len(broken)} | 0 |",
        f"| from the start of the process to its first answer, s: median, most "
        f"| {np.median(starts):.1f}, {starts.max():.1f} | |",
    ]
    return "\n".join([*lines, *broken])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--daemons", type=int, default=2, help="that live and die beside each other")
    arguments = parser.parse_args()
    shares = [len(part) for part in np.array_split(np.arange(arguments.kills), arguments.daemons)]
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(arguments.daemons) as pool:
        running = [pool.submit(lives, Path(name) / f"daemon{k}", share, k) for k, share in enumerate(shares)]
        print(report([r.result() for r in running]))


if __name__ == "__main__":
    main()
