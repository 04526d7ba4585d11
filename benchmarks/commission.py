"""Commissioning: three healthy motors from nothing, and randomised faulty set-ups: how far beyond its limits a motor is
ever taken, and what the run calls the fault.

    python -m benchmarks.commission [--setups N] [--first SEED] [--keep FILE]

With `--keep` every set-up is a line of that file, and one that has its line is not run again. The motors are those of
`tests/commanded_motor.py`, written apart from the plant that is fitted.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from servo_daemon.commissioning import commission
from tests.commanded_motor import FAULTS, HEALTHY, CommandedMotor, drawn


def healthy(name: str) -> dict[str, Any]:
    """One motor, known from nothing."""
    setup, limits = HEALTHY[name]
    began, motor = time.process_time(), CommandedMotor(setup)
    result = commission(motor, limits)
    found = {} if result.fit is None else result.fit.values
    errors = [abs(found[p] / getattr(setup, p) - 1.0) if p in found else None for p in ("R", "L", "K", "J", "B")]
    return {
        "name": name,
        "outcome": result.outcome,
        "motion_s": round(result.motion_s, 1),
        "errors": errors,
        "share": motor.share_of(limits),
        "cpu_s": round(time.process_time() - began, 1),
    }


def faulty(seed: int) -> dict[str, Any]:
    """One set-up of `drawn`."""
    setup, limits, fault = drawn(seed)
    began, motor = time.process_time(), CommandedMotor(setup)
    result = commission(motor, limits)
    return {
        "seed": seed,
        "fault": fault,
        "reason": result.outcome if result.stop is None else result.stop.reason,
        "text": "" if result.stop is None else result.stop.text,
        "share": motor.share_of(limits),
        "cpu_s": round(time.process_time() - began, 1),
    }


def kept(path: Path | None) -> dict[int, dict[str, Any]]:
    """Set-ups that were run before, by seed."""
    if path is None or not path.exists():
        return {}
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    return {line["seed"]: line for line in lines}


def table(motors: Sequence[dict[str, Any]], setups: Sequence[dict[str, Any]]) -> str:
    """What docs/benchmarks.md shows."""
    lines = [
        "| motor | ended as | motion | largest error of R, L, K, J, B (limit 1%) | of a limit |",
        "|---|---|---|---|---|",
    ]
    for m in motors:
        worst = "open" if None in m["errors"] else f"{100 * max(m['errors']):.2f}%"
        lines.append(f"| {m['name']} | {m['outcome']} | {m['motion_s']:.1f} s | {worst} | {m['share']:.2f} |")
    lines += ["", "| fault | set-ups | largest share of a limit | ended as |", "|---|---|---|---|"]
    for fault in FAULTS:
        of = [s for s in setups if s["fault"] == fault]
        if of:
            names = ", ".join(f"{name} {n}" for name, n in Counter(s["reason"] for s in of).most_common())
            lines.append(f"| {fault} | {len(of)} | {max(s['share'] for s in of):.3f} | {names} |")
    over = sum(s["share"] > 1.01 for s in setups)
    lines.append(f"| all | {len(setups)} | {max(s['share'] for s in setups):.3f} | beyond 1.01: {over} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.commission")
    parser.add_argument("--setups", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--keep", type=Path, default=None)
    asked = parser.parse_args()
    done = kept(asked.keep)
    seeds = range(asked.first, asked.first + asked.setups)
    for seed in seeds:
        if seed not in done:
            done[seed] = faulty(seed)
            print(done[seed], file=sys.stderr, flush=True)
            if asked.keep is not None:
                with asked.keep.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(done[seed]) + "\n")
    print(table([healthy(name) for name in HEALTHY], [done[seed] for seed in seeds]))


if __name__ == "__main__":
    main()
