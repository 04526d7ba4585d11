"""`make calibrate`, or `python -m tests.recovery.calibration [PART…] [--clean N] [--rounds N] [--file F] [--table]`.

Prints for every threshold of diagnosis and tracker how what it is compared with is distributed where nothing is to be
found and where something is, and the shares of false alarms and misses that it makes of that: see `table`. Each run is
a line of JSON in the file; what is there is not run again, so it may be stopped and gone on with. After a change of the
code another file has to be begun.
"""

from __future__ import annotations

import argparse
import os
import random
import sys
from pathlib import Path
from typing import Any

from tests.recovery.calibration.cases import CalibrationCase, Result, diagnosed, run_case, tracked
from tests.recovery.calibration.table import table
from tests.recovery.resumed import rows_of, run

#: Runs of a part with nothing to find, and rounds over all that may be: 77 captures and 60 recordings, by the processor
#: time of single ones about 20 minutes of two idle cores.
_CLEAN = {"diagnosis": 24, "tracker": 24}
_ROUNDS = {"diagnosis": 1, "tracker": 4}


def read(path: Path) -> list[Result]:
    """Results of a file; none where there is no file."""
    return [_result(row) for row in rows_of(path)]


def _result(row: dict[str, Any]) -> Result:
    seen = {name: (value, tuple(statistics)) for name, (value, statistics) in row["seen"].items()}
    return Result(CalibrationCase(**row["case"]), tuple(row["outcome"]), row["right"], seen)


def main() -> int:
    parser = argparse.ArgumentParser(prog="make calibrate", description="what the thresholds are compared with")
    parser.add_argument("parts", nargs="*", choices=[*_CLEAN, []], metavar="PART", help=" and ".join(_CLEAN))
    parser.add_argument("--clean", type=int, help="runs with nothing to find")
    parser.add_argument("--rounds", type=int, help="over all that may be found, each time other motors")
    parser.add_argument("--file", type=Path, default=Path("build/calibration.jsonl"))
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--table", action="store_true", help="only print what is in the file")
    asked = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    for part in asked.parts or list(_CLEAN):
        clean = _CLEAN[part] if asked.clean is None else asked.clean
        rounds = _ROUNDS[part] if asked.rounds is None else asked.rounds
        wanted = list((diagnosed if part == "diagnosis" else tracked)(clean, rounds))
        random.Random(part).shuffle(wanted)  # what is there when it is stopped is then a fair sample
        found = [r for r in read(asked.file) if r.case.part == part] if asked.table else None
        results = [_result(r) for r in run(asked.file, wanted, run_case, asked.workers)] if found is None else found
        sys.stdout.write(f"{part}: {len(results)} runs\n{table(results) if results else ''}\n\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
