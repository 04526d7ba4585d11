"""Randomised faulty set-ups: how far beyond its limits a motor is ever taken, and what the run calls the fault.

    python -m benchmarks.commission [N] [FIRST_SEED]

The motors are those of `tests/commanded_motor.py`, written apart from the plant that is fitted.
"""

from __future__ import annotations

import json
import sys
import time
from collections import Counter

from servo_daemon.commissioning import commission
from tests.commanded_motor import FAULTS, CommandedMotor, drawn


def main(count: int, first: int) -> None:
    began, worst, names, over = time.process_time(), 0.0, Counter[str](), []
    for seed in range(first, first + count):
        setup, limits, fault = drawn(seed)
        motor = CommandedMotor(setup)
        result = commission(motor, limits)
        share = motor.share_of(limits)
        worst = max(worst, share)
        reason = result.outcome if result.stop is None else result.stop.reason
        names[f"{fault}: {reason}"] += 1
        if share > 1.01:
            over.append((seed, fault, round(share, 3), reason))
        text = "" if result.stop is None else result.stop.text
        print(
            seed,
            fault,
            reason,
            text,
            round(share, 3),
            {k: round(v, 2) for k, v in motor.peaks.items()},
            file=sys.stderr,
        )
    print(
        json.dumps(
            {
                "setups": count,
                "faults": FAULTS,
                "worst_share": worst,
                "beyond_1_percent": over,
                "named": dict(sorted(names.items())),
                "cpu_s": round(time.process_time() - began, 1),
            },
            indent=1,
        )
    )


if __name__ == "__main__":
    given = [int(a) for a in sys.argv[1:3]]
    main(*given, *(200, 0)[len(given) :])
