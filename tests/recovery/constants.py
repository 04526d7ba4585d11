"""Constants of the live estimator, each halved and doubled: what of the tracking figures moves?

    python -m tests.recovery.constants                                    every constant that says it was not tried
    python -m tests.recovery.constants tracking.validity.gates._ONE_LINE  these; --file: one JSON line a trial

The figures are those of some starts with wrong nominal values (`tracking/starts.py`) and of ageing motors with a step
(`tracking/witness.py`). A constant is free within a half and twice where none of them is worse: as many starts
converge, no more values are published wrong, the errors grow by less than 5 %, what is delivered falls by less than
2 %.
A value in the trial replaces the constant wherever a module holds it; what is computed from it on import is not.
"""

from __future__ import annotations

import argparse
import json
import linecache
import math
import re
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from tests.recovery.calibration.watched import put, thresholds
from tests.recovery.tracking.starts import run_start
from tests.recovery.tracking.witness import AGEING_SECONDS, run_witness, runs_of

PACKAGES = ("servo_daemon.regression", "servo_daemon.tracking", "servo_daemon.kalman")
FACTORS = (0.5, 2.0)
#: Numbers of the starts, s of each; each fifth run of the witness' motors, motions and seeds.
_STARTS, _START_S, _EVERY = range(3000, 3020), 20.0, 5
#: Factors that are applied at each tick or sample are no smaller.
_NEARLY_ONE = 0.95
#: So much worse is worse.
_ERRORS, _DELIVERED = 1.05, 0.98

Figures = Mapping[str, float]


def constants() -> dict[str, Any]:
    """All that may be tried, by "package.module.NAME" without servo_daemon: numbers, and tuples of them."""
    found = {}
    for package in PACKAGES:
        for module, name, value in thresholds(package):
            numbers = value if isinstance(value, tuple) else (value,)
            if numbers and all(type(v) in (int, float) and math.isfinite(v) for v in numbers):
                found[f"{module.__name__.removeprefix('servo_daemon.')}.{name}"] = value
    return found


def says_not_tried(constant: str) -> bool:
    """Whether the comment above a constant says so."""
    module, name = constant.rsplit(".", 1)
    lines = linecache.getlines(str(sys.modules[f"servo_daemon.{module}"].__file__))
    at = next(k for k, line in enumerate(lines) if re.match(rf"(.*, )?{re.escape(name)}\b.* = ", line))
    above = at - 1
    while lines[above].startswith("#:"):
        above -= 1
    return "not tried" in " ".join(line.removeprefix("#:").strip() for line in lines[above + 1 : at])


def scaled(value: Any, factor: float) -> Any:
    """A number or each of a tuple; whole numbers stay whole and at least one. Of what is little less than one, as a
    factor that is applied again and again, the difference to one is scaled."""
    if isinstance(value, tuple):
        return tuple(scaled(v, factor) for v in value)
    if isinstance(value, int):
        return max(1, round(value * factor))
    return 1.0 - factor * (1.0 - value) if _NEARLY_ONE <= value < 1.0 else value * factor


def figures() -> dict[str, float]:
    """Of all starts and ageing motors, with the constants as they are now."""
    starts = [run_start((k, _START_S)) for k in _STARTS]
    rows = [run_witness(run) for run in runs_of(1, AGEING_SECONDS, "", first=41)[::_EVERY]]
    found: dict[str, float] = {
        "converged": sum(not s.failure for s in starts),
        "wrong": sum(s.claimed for s in starts) + sum(bool(s.on_the_way) for s in starts),
    }
    for voice in ("rls", "ekf", "published"):
        found[f"{voice} error"] = float(np.nanmean([row[voice]["rms"] for row in rows]))
        found[f"{voice} wrong"] = float(np.mean([row[voice]["wrong"] for row in rows]))
        found[f"{voice} delivered"] = float(np.mean([row[voice]["delivering"] for row in rows]))
    return found


def worse(now: Figures, usual: Figures) -> list[str]:
    """Which figures are worse, with how much they are and were."""

    def is_worse(name: str) -> bool:
        if name.endswith("error"):
            return not now[name] <= _ERRORS * usual[name]
        if name.endswith("delivered"):
            return now[name] < _DELIVERED * usual[name]
        return (
            now[name] < usual[name]
            if name == "converged"
            else now[name] > usual[name] + (0 if name == "wrong" else 1e-3)
        )

    return [f"{name} {now[name]:.4g} ({usual[name]:.4g})" for name in usual if is_worse(name)]


def said(row: Mapping[str, Any], usual: Figures) -> str:
    """Of a trial. What moves no figure at all has not been tried by it."""
    if "failed" in row:
        return str(row["failed"])
    if row["figures"] == usual:
        return "no say in these runs"
    return "; ".join(worse(row["figures"], usual)) or "free"


def tried(job: tuple[str | None, float]) -> dict[str, Any]:
    """One constant scaled, or none of them."""
    constant, factor = job
    if constant is None:
        return {"constant": None, "factor": factor, "figures": figures()}
    value = constants()[constant]
    with put([(constant.rsplit(".", 1)[1], value, scaled(value, factor))]):
        try:
            found: Figures = figures()
        except Exception as error:  # a value may be out of the question
            return {"constant": constant, "value": value, "factor": factor, "failed": repr(error)}
    return {"constant": constant, "value": value, "factor": factor, "figures": found}


def main() -> None:
    """Prints a line for each trial."""
    parser = argparse.ArgumentParser(prog="python -m tests.recovery.constants")
    parser.add_argument("constants", nargs="*", metavar="PACKAGE.MODULE.NAME")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--file", type=Path, help="one JSON line a trial is added to it")
    asked = parser.parse_args()
    chosen: Sequence[str] = asked.constants or [c for c in constants() if says_not_tried(c)]
    jobs: list[tuple[str | None, float]] = [(None, 1.0), *((c, f) for c in chosen for f in FACTORS)]
    usual: Figures = {}
    with ProcessPoolExecutor(asked.jobs) as pool:
        for row in pool.map(tried, jobs):
            if asked.file:
                with asked.file.open("a", encoding="utf-8") as file:
                    print(json.dumps(row), file=file)
            if row["constant"] is None:
                usual = row["figures"]
                print(usual, flush=True)
            else:
                print(f"{row['constant']} {row['value']} × {row['factor']}: {said(row, usual)}", flush=True)


if __name__ == "__main__":
    main()
