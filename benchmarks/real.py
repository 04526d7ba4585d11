"""Field data: the independent generator's captures as people's loggers write them, through `fit` and `diagnose`.

    python -m benchmarks.real                       # 300 files of a fresh draw, every eighth diagnosed as well
    python -m benchmarks.real --count 60 --seed 7   # the same files again; what is in the draw's file is not run again

A number is wrong beyond 4 of its standard deviations and 5 % of the truth; numbers are parameters and combinations with
a standard deviation. A file that does not mean what its columns are called must be refused or warned of with its mend,
and mended so it must give R, K, J and B; what is claimed beside such a warning does not count.
"""

from __future__ import annotations

import argparse
import os
import random
import secrets
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.recovery.field.dressings import DRESSINGS
from tests.recovery.field.judge import FieldCase, Number, cases, judge
from tests.recovery.resumed import run

_HEAD = "files | numbers | wrong | open | mend told | mended right | diagnosed | wrong names"
_TITLES = {
    "files": "The same numbers in other files",
    "meaning": "Columns that do not mean what they are called",
    "readings": "Instruments and motions that tell less",
    "hidden": "Causes beside the linear motor",
}
#: What was asked for: wrong ones of all numbers claimed, and wrong names.
MOST_WRONG, MOST_NAMES = 0.01, 0


def wrong_numbers(row: Mapping[str, Any]) -> list[Number]:
    """Of one file."""
    return [n for values in row["claimed"] if (n := Number(**values)).wrong]


def line(name: str, rows: Sequence[Mapping[str, Any]]) -> str:
    """One line of a table."""
    told = [r["told"] for r in rows if r["mended"] is not None]
    diagnosed = sum(r["case"]["diagnosed"] for r in rows)
    cells = [
        len(rows),
        sum(len(r["claimed"]) for r in rows),
        sum(len(wrong_numbers(r)) for r in rows),
        sum(len(r["missing"]) for r in rows),
        f"{sum(t != 'unsaid' for t in told)} of {len(told)}" if told else "",
        f"{sum(r['mended'] is True for r in rows)} of {len(told)}" if told else "",
        diagnosed or "",
        sum(len(r["wrong_names"]) for r in rows) if diagnosed else "",
    ]
    return f"| {name.replace('|', chr(92) + '|')} | {' | '.join(map(str, cells))} |"


def tables(rows: Sequence[Mapping[str, Any]]) -> str:
    """A table for each group of dressings, then what was wrong."""
    lines: list[str] = []
    for group, kinds in DRESSINGS.items():
        lines += [f"| {_TITLES[group]} | {_HEAD} |", "|---" * (_HEAD.count("|") + 2) + "|"]
        lines += [line(kind, own) for kind in kinds if (own := [r for r in rows if r["case"]["kind"] == kind])]
        lines.append("")
    lines += [f"| All | {_HEAD} |", "|---" * (_HEAD.count("|") + 2) + "|", line("", rows), "", *_told(rows)]
    return "\n".join(lines)


def _told(rows: Sequence[Mapping[str, Any]]) -> Iterable[str]:
    claimed, wrong = sum(len(r["claimed"]) for r in rows), sum(len(wrong_numbers(r)) for r in rows)
    names = sum(len(r["wrong_names"]) for r in rows)
    yield f"wrong numbers {wrong} of {claimed}, {wrong / max(claimed, 1):.2%} (limit {MOST_WRONG:.0%})"
    yield f"wrong names {names} (limit {MOST_NAMES})"
    for r in rows:
        what = [
            f"{n.name} {n.value / n.true - 1:+.0%}, {abs(n.value - n.true) / n.std:.0f} σ" for n in wrong_numbers(r)
        ]
        what += [f"named {name}" for name in r["wrong_names"]]
        if r["told"] == "unsaid":
            what.append("no mend is said")
        elif r["told"] and r["mended"] is None:
            what.append("refused")
        elif r["mended"] is False:
            what.append("mended not right")
        if what:
            yield f"{r['case']['kind']} ({r['motor']}, {r['case']['seed']}): {'; '.join(what)}"


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.real")
    parser.add_argument("--count", type=int, default=300, help="files")
    parser.add_argument("--seed", type=int, help="of the draw; without it a fresh one")
    parser.add_argument("--diagnose", type=int, default=8, metavar="N", help="every N-th file is diagnosed; 0: none")
    parser.add_argument("--file", type=Path, help="of the results (build/real-SEED.jsonl)")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    asked = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    seed = secrets.randbelow(10**6) if asked.seed is None else asked.seed
    wanted: list[FieldCase] = cases(seed, asked.count, asked.diagnose)
    random.Random(seed).shuffle(wanted)  # what is there when it is stopped is then a fair sample
    rows = run(asked.file or Path(f"build/real-{seed}.jsonl"), wanted, judge, asked.workers)
    print(f"draw {seed}: {len(rows)} files, {sum(c.diagnosed for c in wanted)} of them diagnosed\n\n{tables(rows)}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
