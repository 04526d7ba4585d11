"""Eight drives at 1 kHz on one daemon, and everything that can go wrong around it, in turn.

Four simulated drives speak the serial wire, four CAN through an slcan adapter, all over pseudo-terminals. Rounds of
faults hit one process; then it is killed and stopped again and again. Between two faults the drives pause for a moment,
and what they sent whole is compared with what the daemon has: to the last sample, of every drive whose port was there.

    .venv/bin/python -m benchmarks.soak                  3 minutes
    .venv/bin/python -m benchmarks.soak --minutes 30     for a release
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from benchmarks.soak.run import Plan, soak
from benchmarks.soak.tally import report

#: What a round and a life take on a machine that has time, s.
_ROUND_S, _LIFE_S = 55.0, 12.0
#: Of the time for rounds; the rest for lives.
_ROUNDS = 0.65


def plan(minutes: float) -> Plan:
    return Plan(max(1, round(60 * minutes * _ROUNDS / _ROUND_S)), max(1, round(60 * minutes * (1 - _ROUNDS) / _LIFE_S)))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=3.0, help="about so long (3)")
    minutes: float = parser.parse_args().minutes
    with tempfile.TemporaryDirectory() as name:
        tally = soak(Path(name), plan(minutes), say=lambda text: print(text, file=sys.stderr, flush=True))
    print(report(tally))
    return 0


if __name__ == "__main__":
    sys.exit(main())
