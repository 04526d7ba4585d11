"""`make mutants`: all named faults and a sample of others, and the table in docs/mutants.md.

`python -m tests.mutants [--only GROUP…] [--sample N] [--seed N] [--table]`; every outcome is a line of JSON in the
draw's file, and what is there is not run again, so it may be stopped and gone on with.
"""

from __future__ import annotations

import argparse
import json
import os
import queue
import random
import secrets
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path

from tests.mutants.groups import GROUPS, found
from tests.mutants.mechanisms import MECHANISMS
from tests.mutants.named import NAMED
from tests.mutants.run import Fault, Outcome, Workshop, tests_of
from tests.mutants.sites import sites

ROOT = Path(__file__).resolve().parents[2]
_NAMED = "named"
_LISTS = {_NAMED: NAMED, "mechanisms": MECHANISMS}


def listed_faults(group: str, root: Path = ROOT) -> Iterator[Fault]:
    """Those of a list."""
    for fault in _LISTS[group]:
        path = root / fault.file
        text = fault.applied(path.read_text(encoding="utf-8")) if path.exists() else None
        yield Fault(group, fault.name, fault.file, text, tests_of(root, fault.tests))


def drawn_faults(group: str, wanted: int, seed: int, root: Path = ROOT) -> list[Fault]:
    """So many of a group's, each file's places alike."""
    every = []
    for file in found(root, GROUPS[group].files):
        source = (root / file).read_text(encoding="utf-8")
        every += [(file, source, site) for site in sites(source)]
    drawn = random.Random(f"{seed}/{group}").sample(every, min(wanted, len(every)))
    tests = tests_of(root, GROUPS[group].tests)
    return [Fault(group, f"{s.line}:{s.column}: {s.title}", f, s.applied(source), tests) for f, source, s in drawn]


def run(faults: Sequence[Fault], path: Path, workers: int) -> list[Outcome]:
    """Their outcomes, those in the file as they are there; so many copies of the tree beside each other."""
    done: dict[str, Outcome] = {}
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists():
        for line in path.read_text(encoding="utf-8").splitlines():
            outcome = Outcome(**json.loads(line))
            done[f"{outcome.group}: {outcome.file}: {outcome.title}"] = outcome
    workshops: queue.Queue[Workshop] = queue.Queue()

    def judged(fault: Fault) -> Outcome:
        workshop = workshops.get()
        try:
            return workshop.judge(fault)
        finally:
            workshops.put(workshop)

    with (
        tempfile.TemporaryDirectory() as folder,
        path.open("a", encoding="utf-8") as file,
        ThreadPoolExecutor(workers) as pool,
    ):
        for k in range(workers):
            workshops.put(Workshop(ROOT, Path(folder) / f"tree{k}"))
        futures = {pool.submit(judged, f): f.key for f in faults if f.key not in done}
        try:
            for future in as_completed(futures):
                done[futures[future]] = outcome = future.result()
                print(json.dumps(asdict(outcome), ensure_ascii=False), file=file, flush=True)
                print(f"{outcome.outcome:9s}{outcome.seconds:5.0f} s  {futures[future]}  {outcome.by}", file=sys.stderr)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)  # when it is stopped those that wait are not begun
            raise
    return [done[f.key] for f in faults]


def document(outcomes: Sequence[Outcome], seed: int) -> str:
    """The table as Markdown."""
    lines = [
        "# Mutants",
        "",
        "Faults put into the code on purpose, each with the fast tests of its part run on it. Written by",
        f"`make mutants`; those drawn at random are of `--seed {seed}`.",
        "",
        "| part | killed | of | share |",
        "|---|---|---|---|",
    ]
    for group in dict.fromkeys(o.group for o in outcomes):
        own = [o for o in outcomes if o.group == group]
        killed = sum(o.outcome == "killed" for o in own)
        lines.append(f"| {group} | {killed} | {len(own)} | {killed / len(own):.0%} |")
    for group in _LISTS:
        lines += ["", f"## {group.capitalize()}", "", "| fault | outcome | by |", "|---|---|---|"]
        lines += [f"| {_cell(o.title)} | {o.outcome} | {_cell(_test(o.by))} |" for o in outcomes if o.group == group]
    survived = [o for o in outcomes if o.group not in _LISTS and o.outcome != "killed"]
    lines += ["", "## Drawn, and not killed", "", "| part | file | fault |", "|---|---|---|"]
    lines += [f"| {o.group} | `{o.file}` | {_cell(o.title)} |" for o in survived]
    return "\n".join(lines) + "\n"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _test(by: str) -> str:
    """A test's own name, without its file and parameters."""
    return by.rsplit("::", 1)[-1].split("[", maxsplit=1)[0]


def main() -> int:
    parser = argparse.ArgumentParser(prog="make mutants", description="put faults into the code, see which tests fail")
    parser.add_argument("--only", nargs="+", choices=[*_LISTS, *GROUPS], default=[*_LISTS, *GROUPS])
    parser.add_argument("--sample", type=int, default=8, help="faults drawn for each part")
    parser.add_argument("--seed", type=int, help="of the draw; without it a fresh one")
    parser.add_argument("--file", type=Path, help="of the outcomes (build/mutants-SEED.jsonl)")
    parser.add_argument("--docs", type=Path, default=ROOT / "docs/mutants.md", help="where the table goes")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    asked = parser.parse_args()
    seed = secrets.randbelow(10**9) if asked.seed is None else asked.seed
    print(f"draw {seed}: go on with --seed {seed}", file=sys.stderr)
    faults = [fault for group in _LISTS if group in asked.only for fault in listed_faults(group)]
    for group in GROUPS:
        faults += drawn_faults(group, asked.sample, seed) if group in asked.only else []
    outcomes = run(faults, asked.file or ROOT / f"build/mutants-{seed}.jsonl", asked.workers)
    asked.docs.write_text(document(outcomes, seed), encoding="utf-8")
    killed = sum(o.outcome == "killed" for o in outcomes)
    print(f"{killed} of {len(outcomes)} killed ({killed / max(len(outcomes), 1):.0%}): {asked.docs}")
    return int(any(o.outcome != "killed" for o in outcomes if o.group == _NAMED))


if __name__ == "__main__":
    raise SystemExit(main())
