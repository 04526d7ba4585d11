"""The whole matrix of hidden effects: `make matrix`, or `python -m tests.recovery.matrix [--seed N] [--repeats N] …`.

Without a seed the draw is one that nobody has seen. Its number is printed with the result, and with it (`--seed N`) the
same captures are made again. Every case is a line of JSON in the draw's file; what is there is not run again, so a draw
may be stopped and gone on with. At the end it prints what was named for what was hidden, with Wilson's 95 % intervals
(Wilson 1927).
"""

from __future__ import annotations

import argparse
import os
import random
import secrets
import sys
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from math import sqrt
from pathlib import Path
from typing import Any

from tests.recovery.generator import LISTED
from tests.recovery.hidden import INVISIBLE, UNNAMED, Case, cases, judge
from tests.recovery.resumed import rows_of, run

_Z = 1.959964
#: Share of the error that the true causes remove, which what is named must remove.
OF_TRUE = 0.9
#: Draws to choose from: short to write down, and none twice by chance.
_DRAWS = 10**9


def wilson(right: int, of: int) -> tuple[float, float]:
    """95 % interval of a share."""
    if of == 0:
        return 0.0, 1.0
    p = right / of
    middle, half = p + _Z**2 / (2 * of), _Z * sqrt(p * (1 - p) / of + _Z**2 / (4 * of**2))
    return (middle - half) / (1 + _Z**2 / of), (middle + half) / (1 + _Z**2 / of)


def kind(row: Mapping[str, Any]) -> str:
    """To which target a case counts."""
    cause = row["case"]["cause"]
    if cause == "clean":
        return "clean: nothing named"
    if cause in UNNAMED:
        return "not in the library: nothing named"
    if cause in INVISIBLE or (cause in LISTED and not Case(**row["case"]).shows(cause)):
        return "not visible in one capture: nothing named"
    if "+" in cause:
        return "pair: both named right"
    return f"{row['case']['strength']}: named right"


def right(row: Mapping[str, Any]) -> bool:
    """All that is hidden was named and nothing else."""
    return set(row["found"]) == set(row["expected"])


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Shares by kind, parameters, and the confusions."""
    groups: defaultdict[str, list[Mapping[str, Any]]] = defaultdict(list)
    for row in rows:
        groups[kind(row)].append(row)
    lines = [_share(name, sum(map(right, group)), len(group)) for name, group in sorted(groups.items())]
    named = [r for r in rows if set(r["found"]) & set(r["expected"])]
    checked = sum(r["checked"] for r in named)
    lines.append(_share("parameters within 3 std", sum(r["checked"] - len(r["outside"]) for r in named), checked))
    compared = [g for r in rows if (g := r.get("of_true")) is not None]
    lines.append(_share("90 % of what the true causes remove", sum(g >= OF_TRUE for g in compared), len(compared)))
    return "\n".join([*(line for line in lines if line), "", *_confusions(rows)])


def _share(name: str, good: int, of: int) -> str:
    """A line of the table; empty: there is none of it."""
    if not of:
        return ""
    low, high = wilson(good, of)
    return f"{name:45s} {good:4d} of {of:4d}  {good / of:6.1%}  ({low:.1%} .. {high:.1%})"


def _confusions(rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """hidden → what was named, with counts, where that is not the same."""
    counts: Counter[tuple[str, str]] = Counter()
    total: Counter[str] = Counter()
    for row in rows:
        cause = f"{row['case']['cause']} ({row['case']['strength']})"
        total[cause] += 1
        if not right(row):
            counts[cause, " + ".join(sorted(row["found"])) or row["verdict"]] += 1
    return [f"{cause:60s} → {named}: {n} of {total[cause]}" for (cause, named), n in sorted(counts.items())]


def options(words: Sequence[str] | None = None) -> argparse.Namespace:
    """What was asked for; a seed and a file are always in it."""
    parser = argparse.ArgumentParser(description="hide every effect, diagnose, count")
    parser.add_argument("--seed", type=int, help="of the draw; without it a fresh one")
    parser.add_argument("--file", type=Path, help="of the results (build/matrix-SEED.jsonl)")
    parser.add_argument("--repeats", type=int, default=1, help="rounds over causes, strengths and motors")
    parser.add_argument("--clean", type=int, default=400, help="captures with nothing hidden")
    parser.add_argument("--most", type=int, help="captures drawn of these at most: a fair sample of all")
    parser.add_argument("--without-current", action="store_true", help="leave it out of every capture")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--table", action="store_true", help="only print what is in the file")
    found = parser.parse_args(words)
    if found.table and found.seed is None and found.file is None:
        parser.error("--table of which draw? --seed or --file")
    if found.seed is None:
        found.seed = secrets.randbelow(_DRAWS)
    kind = "-without-current" if found.without_current else ""
    found.file = found.file or Path(f"build/matrix-{found.seed}{kind}.jsonl")
    return found


def main() -> int:
    asked = options()
    if asked.table:
        rows = rows_of(asked.file)
        sys.stdout.write(f"{asked.file}: {len(rows)} captures\n{table(rows)}\n")
        return 0
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    print(f"draw {asked.seed}: go on with --seed {asked.seed}", file=sys.stderr)
    wanted = [replace(c, current=not asked.without_current) for c in cases(asked.seed, asked.repeats, asked.clean)]
    random.Random(asked.seed).shuffle(wanted)  # what is there when it is stopped is then a fair sample
    rows = run(asked.file, wanted[: asked.most], judge, asked.workers)
    sys.stdout.write(f"draw {asked.seed}: {len(LISTED)} causes, {len(rows)} captures\n{table(rows)}\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
