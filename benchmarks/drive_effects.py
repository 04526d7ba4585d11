"""Loads hidden behind drives whose voltage is a measurement: what `diagnose` names on each link.

    python -m benchmarks.drive_effects              # a fresh draw: 4 causes and none, 2 motors, 2 motions, 4 links
    python -m benchmarks.drive_effects --seed 7     # the same again; what is in the draw's file is not run again

The motor is that of tests/recovery/foc: under field-oriented control at 20 kHz, with equations of its own.
"""

from __future__ import annotations

import argparse
import os
import random
import secrets
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.recovery.foc.hidden import LinkCase, cases, judge
from tests.recovery.resumed import run

#: What was asked for: share of causes named right, and wrong names.
LEAST_RIGHT, MOST_WRONG = 0.85, 0


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Shares by cause and link, then what was not right."""
    lines = ["| link | " + " | ".join(causes := sorted({r["case"]["cause"] for r in rows})) + " |"]
    lines.append("|---" * (len(causes) + 1) + "|")
    for kind, hz in sorted({(r["case"]["kind"], r["case"]["hz"]) for r in rows}):
        own = [r for r in rows if (r["case"]["kind"], r["case"]["hz"]) == (kind, hz)]
        lines.append(
            f"| {kind} {hz} Hz | "
            + " | ".join(_share([r for r in own if r["case"]["cause"] == c]) for c in causes)
            + " |"
        )
    hidden = [r for r in rows if r["case"]["cause"] != "clean"]
    wrong = [r for r in rows if set(r["found"]) - set(LinkCase(**r["case"]).expected)]
    named = sum(_right(r) for r in hidden)
    lines += ["", f"named right {named} of {len(hidden)}, {named / max(len(hidden), 1):.0%} (limit {LEAST_RIGHT:.0%})"]
    lines.append(f"wrong names {len(wrong)} of {len(rows)} (limit {MOST_WRONG})")
    lines += [
        f"{LinkCase(**r['case']).key}: {r['verdict']}, {' + '.join(r['found']) or 'nothing'}"
        for r in rows
        if not _right(r)
    ]
    return "\n".join(lines)


def _right(row: Mapping[str, Any]) -> bool:
    return tuple(row["found"]) == LinkCase(**row["case"]).expected


def _share(rows: Sequence[Mapping[str, Any]]) -> str:
    return f"{sum(map(_right, rows))} of {len(rows)}"


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.drive_effects")
    parser.add_argument("--seed", type=int, help="of the draw; without it a fresh one")
    parser.add_argument("--count", type=int, help="so many cases of the draw; without it all")
    parser.add_argument("--file", type=Path, help="of the results (build/drive-effects-SEED.jsonl)")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    asked = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    seed = secrets.randbelow(10**6) if asked.seed is None else asked.seed
    wanted = cases(seed)
    random.Random(seed).shuffle(wanted)  # what is there when it is stopped is then a fair sample
    rows = run(asked.file or Path(f"build/drive-effects-{seed}.jsonl"), wanted[: asked.count], judge, asked.workers)
    print(f"draw {seed}: {len(rows)} captures\n\n{table(rows)}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
