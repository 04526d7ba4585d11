"""The history of 32 drives over a simulated year, through the real store.

    python -m benchmarks.life [--drives 32] [--filled 2] [--days 365] [--store FOLDER]

Some of the drives live the whole year, all write afterwards (a year of 32 takes an hour and shows no more). Each
minute of the year is a bucket as the recorder makes them, from an estimate that ages, wanders with the filter's memory
and follows a temperature; the last day comes in seconds and the last hour in single rows, so that every level is as
full as in service. Then the year is asked for in the process that writes, as the daemon answers: beside a thread that
brings ten rows a second of 32 drives each and writes them every three seconds.
"""

from __future__ import annotations

import argparse
import contextlib
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from servo_daemon.commands.run.serve import SWITCH_S
from servo_daemon.config import HistoryConfig
from servo_daemon.history.archive import StoreArchive
from servo_daemon.history.blocks import BlockWriter, drive_id
from servo_daemon.history.database import Database
from servo_daemon.history.levels import Level, levels_of
from servo_daemon.history.recorder import Recorder
from servo_daemon.published.buckets import STATUSES, Buckets
from servo_daemon.published.diagnosis_state import Adoption, Diagnosis, DiagnosisView
from servo_daemon.published.history import HistoryRing
from servo_daemon.published.rollup import roll_up
from servo_daemon.published.snapshot import Estimate, Event, ParameterEstimate, Snapshot

#: Value, published std as a share, drift a year as a share; the filter's memory is 20 s.
PARAMETERS = {"R": (0.5, 2e-3, 0.05), "L": (2e-3, 1e-2, 0.0), "K": (0.3, 2e-3, -0.02), "J": (1e-2, 5e-3, 0.0),
              "B": (0.5, 1e-2, 0.1), "Tc": (0.02, 1e-2, 0.2)}  # fmt: skip
UNITS = {"R": "Ω", "L": "H", "K": "N·m/A", "J": "kg·m²", "B": "N·m·s/rad", "Tc": "N·m"}
CHANNELS = {"current_A": 3.0, "velocity_rad_s": 6.0, "position_rad": 1.0}
MEMORY_S, DAY, YEAR = 20.0, 86_400.0, 365.25 * 86_400.0
#: Rows of a drive between two turns of the writer (`daemon/recording.py`); the pause between two questions, s: 400 of
#: them meet a dozen turns.
ROWS, ASK_EVERY_S = 30, 0.08
END = 1.8e9 // 86_400 * 86_400


def rows(begin_s: float, end_s: float, step_s: float, rng: np.random.Generator) -> Buckets:
    """Estimates at these moments: correlated over the filter's memory, with the temperature of the day and of the year
    in R, ageing in what ages."""
    time_s = np.arange(begin_s, end_s, step_s)
    n, names = len(time_s), [*PARAMETERS, *CHANNELS, "temperature_C"]
    warm = 40.0 + 10.0 * np.sin(2 * np.pi * time_s / DAY) + 8.0 * np.sin(2 * np.pi * time_s / YEAR)
    keep = np.exp(-step_s / MEMORY_S)
    value, std = np.empty((n, len(names))), np.full((n, len(names)), np.nan)
    for k, (base, share, drift) in enumerate(PARAMETERS.values()):
        noise = rng.normal(size=n) * np.sqrt(1 - keep**2)
        wander = lfilter([1.0], [1.0, -keep], noise)
        heat = 0.0039 * (warm - 25.0) if k == 0 else 0.0
        value[:, k] = base * (1 + share * wander + drift * (time_s - END + YEAR) / YEAR + heat)
        std[:, k] = base * share * (1 + 0.1 * rng.random(n))
    for k, size in enumerate(CHANNELS.values(), len(PARAMETERS)):
        value[:, k] = size * rng.normal(size=n)
    value[:, -1] = np.round(warm + 0.2 * rng.normal(size=n), 1)
    kinds = [name in PARAMETERS for name in names]
    tracking, idle = STATUSES.index("tracking") + 1, STATUSES.index("unexcited") + 1
    at_rest = np.floor(time_s / 1800.0) % 5 == 0
    code = np.where(at_rest[:, None], idle, tracking) * np.array(kinds)
    units = [UNITS.get(name) or name.partition("_")[2] for name in names]
    return Buckets.of_rows(time_s, names, units, kinds, value, std, code.astype(np.int8))


def minutes(begin_s: float, end_s: float, rng: np.random.Generator) -> Buckets:
    """A day of minutes: means of six looks each, counted as the 600 rows that they stand for."""
    rolled = roll_up(rows(begin_s, end_s, 10.0, rng), 60.0)
    return replace(rolled, count=rolled.count * 100, status=rolled.status * 100)


class Lapse(BlockWriter):
    """A writer that also takes rows of a coarser level than the finest."""

    def put(self, connection: object, drive: int, level: Level, buckets: Buckets) -> None:
        self._insert_open(connection, drive, level, buckets)  # type: ignore[arg-type]


def live_a_year(database: Database, drives: int, days: int, config: HistoryConfig) -> None:
    """Fill the store."""
    levels = levels_of(config)
    engine, writer = database.open(), Lapse(levels)
    for n in range(drives):
        rng = np.random.default_rng(n)
        with engine.begin() as connection:
            number = drive_id(connection, f"axis{n}", make=True) or 0
            for day in range(days - 1):
                begin = END - (days - day) * DAY
                writer.put(connection, number, levels[2], minutes(begin, begin + DAY, rng))
            writer.prune(connection, END)
            seconds = roll_up(rows(END - DAY, END - 3600.0, 0.5, rng), 1.0)
            writer.put(connection, number, levels[1], seconds)
            writer.add(connection, number, rows(END - 3600.0, END, 0.1, rng))


def lived(file: Path, kept: Path | None, drives: int, days: int, config: HistoryConfig) -> float:
    """A year in a new file, or one that was lived before; seconds that took."""
    before = None if kept is None else kept / f"life-{drives}-{days}.sqlite"
    began = time.perf_counter()
    if before is not None and before.exists():
        shutil.copy(before, file)
        return time.perf_counter() - began
    with contextlib.closing(Database(file)) as database:
        live_a_year(database, drives, days, config)
    if before is not None:
        before.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(file, before)
    return time.perf_counter() - began


IDLE = DiagnosisView(Diagnosis(), Adoption(False), False, None)


@dataclass
class Live:
    """A `Source` whose rows come by themselves."""

    name: str
    history: HistoryRing
    model: tuple[str, ...] = ()
    diagnosis: DiagnosisView = IDLE

    @property
    def log(self) -> Live:
        return self

    def since(self, number: int) -> tuple[int, Sequence[Event]]:
        return number, ()

    def step(self, now_s: float, rng: np.random.Generator) -> None:
        parameters = tuple(
            ParameterEstimate(n, v * (1 + s * rng.normal()), v * s, UNITS[n], v, "tracking")
            for n, (v, s, _) in PARAMETERS.items()
        )
        state = {name: size * rng.normal() for name, size in CHANNELS.items()}
        estimate = Estimate(now_s, 1, 1e3, (), parameters, {**state, "temperature_C": 40.0}, {}, {})
        self.history.append(Snapshot(self.name, "x", now_s, "connected", None, estimate, {}))


def serve(database: Database, drives: int, filled: int, config: HistoryConfig) -> tuple[float, np.ndarray]:
    """The writer's share of a core over ten minutes of service, as fast as it goes; and then the times of queries
    of a year beside it."""
    rng = np.random.default_rng(7)
    sources = [Live(f"axis{n}", HistoryRing()) for n in range(drives)]
    recorder = Recorder(database, levels_of(config), sources, config.quota_MB * 1e6)
    now = [END]
    archive = StoreArchive(recorder, lambda: now[0])
    cpu = 0.0

    def turns(number: int, pause: Callable[[], object] = lambda: None) -> None:
        nonlocal cpu
        for _ in range(number):
            for _ in range(ROWS):
                now[0] += 0.1
                for source in sources:
                    source.step(now[0], rng)
                pause()
            began = time.thread_time()
            recorder.turn(now[0], now[0])
            cpu += time.thread_time() - began

    turns(1)  # opens the database
    cpu = 0.0
    turns(200)
    share, done = cpu / 600.0, threading.Event()
    took: list[tuple[float, float]] = []

    def write() -> None:
        while not done.is_set():
            turns(1, lambda: done.wait(0.1))

    writing = threading.Thread(target=write)
    writing.start()
    for k in range(400):
        began, worked = time.perf_counter(), time.thread_time()
        span = archive.span(f"axis{k % filled}", ["R"], now[0] - YEAR, None, 500)
        took.append((time.perf_counter() - began, time.thread_time() - worked))
        time.sleep(ASK_EVERY_S)
        assert 200 < len(span.buckets) <= 500 and span.level == "1 h", (len(span.buckets), span.level)
    done.set()
    writing.join()
    assert recorder.problem is None, recorder.problem
    return share, np.array(took)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=32)
    parser.add_argument("--filled", type=int, default=2, help="of them live the whole year")
    parser.add_argument("--days", type=int, default=365)
    parser.add_argument("--store", type=Path, help="keep the year that was lived here, and begin with it next time")
    arguments = parser.parse_args()
    sys.setswitchinterval(SWITCH_S)
    config = HistoryConfig()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "history.sqlite"
        filled = lived(file, arguments.store, arguments.filled, arguments.days, config)
        database = Database(file)
        with database.open().connect() as connection:
            size = database.size_bytes(connection) / arguments.filled / 1e6
            by_level = connection.exec_driver_sql(
                "SELECT level, sum(length(data)), sum(rows) FROM block WHERE open = 0 GROUP BY level"
            ).all()
        share, took = serve(database, arguments.drives, arguments.filled, config)
        database.close()
    kinds = f"{len(PARAMETERS)} parameters and {len(CHANNELS) + 1} channels"
    of_them = f"{arguments.filled} of them over {arguments.days} days (in {filled:.0f} s)"
    print(f"{arguments.drives} drives, {kinds} each; {of_them}\n")
    print("| | measured | wanted |\n|---|---|---|")
    print(f"| on disk, MB a drive after the year | {size:.1f} | ≤ 15 |")
    for level, stored, count in by_level:
        name, MB = levels_of(config)[level].name, stored / arguments.filled / 1e6
        print(f"| … packed blocks of {name}: MB a drive, bytes a row | {MB:.2f}, {stored / count:.0f} | |")
    for what, times, wanted in (("", took[:, 0], "p99 ≤ 50"), (" (its own time on the processor)", took[:, 1], "")):
        p50, p99 = np.percentile(times, [50, 99]) * 1e3
        text = f"a year of R in 500 points beside the writers{what}, ms: median, p99 of {len(took)}"
        print(f"| {text} | {p50:.0f}, {p99:.0f} | {wanted} |")
    print(f"| the writer's share of a core, % | {100 * share:.1f} | ≤ 2 |")


if __name__ == "__main__":
    main()
