"""Feeds every decoder and reader and says how many inputs each took and which of them found a fault.

python -m tests.fuzz --inputs 1000000           a quarter of an hour of one core
python -m tests.fuzz --inputs 20000 --only slcan --seed 3
"""

from __future__ import annotations

import argparse
import logging
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path
from random import Random

from tests.fuzz.targets import TARGETS


def feed(name: str, inputs: int, seed: int) -> Counter[str]:
    """So many inputs for a target; where it failed, how often. After a failure it begins anew."""
    random, found = Random(f"{name} {seed}"), Counter[str]()
    with tempfile.TemporaryDirectory() as folder:
        step = TARGETS[name].make(random, Path(folder))
        for _ in range(inputs):
            try:
                step()
            except Exception as error:
                where = traceback.extract_tb(error.__traceback__)[-1]
                found[f"{type(error).__name__} in {Path(where.filename).name}:{where.lineno}: {str(error)[:160]}"] += 1
                step = TARGETS[name].make(random, Path(folder))
    return found


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--inputs", type=int, default=1_000_000, help="of all targets together")
    parser.add_argument("--only", choices=TARGETS, help="all of them to this target")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    logging.disable(logging.CRITICAL)
    total, faults = 0, 0
    for name, target in TARGETS.items():
        share = float(name == arguments.only) if arguments.only else target.share
        if (n := round(arguments.inputs * share)) > 0:
            cpu = time.process_time()
            found = feed(name, n, arguments.seed)
            total, faults = total + n, faults + found.total()
            print(f"{name}: {n:,} inputs, {found.total()} faults, {time.process_time() - cpu:.0f} s", flush=True)
            for what, count in found.most_common(8):
                print(f"  {count} × {what}")
    print(f"{total:,} inputs, {faults} faults, {time.process_time():.0f} s of CPU")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
