"""`python -m tests.identity` compares with the references, `python -m tests.identity --write` makes them anew.

About two minutes on one core.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path

from tests.identity.recording import REFERENCES, differences, record, references


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="make the references anew")
    parser.add_argument("--references", type=Path, default=REFERENCES, metavar="F", help="another file of references")
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
