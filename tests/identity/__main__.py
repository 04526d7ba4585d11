"""`python -m tests.identity --write --references F` records every answer before a change that must not change any,
`python -m tests.identity --references F` compares with that after it, on the same machine.

About two minutes on one core.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path

from tests.identity.recording import differences, record, references


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="make the references anew")
    parser.add_argument("--references", type=Path, required=True, metavar="F", help="the file of the recording")
    arguments = parser.parse_args()
    data = Path(os.environ.get("SERVO_DATA") or Path(__file__).resolve().parents[3] / "shared" / "data")
    with tempfile.TemporaryDirectory() as folder:
        found = record(Path(folder), data)
    if arguments.write:
        arguments.references.write_text(json.dumps(found, indent=1, sort_keys=True) + "\n")
        return 0
    wrong = differences(references(arguments.references), found)
    for name in wrong:
        print(f"differs: {name}")
    print(f"{len(found['answers'])} answers, {len(wrong)} differ", file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
