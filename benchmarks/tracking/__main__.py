"""Command line of the package."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path

from tests.recovery.tracking.ageing import report_ageing
from tests.recovery.tracking.bound import report_bound, report_realistic
from tests.recovery.tracking.models import report_models
from tests.recovery.tracking.published import report_published
from tests.recovery.tracking.scenarios import report_scenarios
from tests.recovery.tracking.starts import report_starts
from tests.recovery.tracking.witness import AGEING_SECONDS, SLOW_SECONDS, report_witness

from .cost import report_cost
from .false_steps import report_false_steps
from .long import report_long
from .rivals import report_rivals
from .steady import report_steady
from .steps import report_steps

Part = Callable[[argparse.Namespace], None]


def _parts() -> Mapping[str, Part]:
    return {
        "bound": lambda a: report_bound(a.runs or 20, a.seconds or 600.0),
        "realistic": lambda a: report_realistic(a.runs or 20, a.seconds or 600.0),
        "ageing": lambda a: report_ageing(a.runs or 5, a.seconds or 300.0),
        "scenarios": lambda a: report_scenarios(a.runs or 1, a.seconds or 60.0, a.only, a.plots),
        "steps": lambda a: report_steps(a.runs or 2, a.seconds or 40.0),
        "starts": lambda a: report_starts(a.first or 0, a.runs or 1000, a.seconds or 20.0),
        "witness": lambda a: report_witness(
            a.runs or 2,
            a.seconds or (SLOW_SECONDS if a.slow else AGEING_SECONDS),
            a.only,
            slow=a.slow,
            first=a.first or 1,
            processes=a.jobs,
            out=a.out,
        ),
        "steady": lambda a: report_steady(a.runs or 1, a.only, processes=a.jobs, out=a.out),
        "published": lambda a: report_published(
            a.runs or 200, a.seconds or 150.0, a.only, first=a.first or 1, processes=a.jobs, out=a.out
        ),
        "false-steps": lambda a: report_false_steps(
            a.runs or 100, a.seconds or 300.0, a.only, first=a.first or 1, processes=a.jobs, out=a.out
        ),
        "models": lambda a: report_models(a.motion),
        "rivals": lambda a: report_rivals(a.seconds or 60.0),
        "cost": lambda _: report_cost(),
        "long": lambda a: report_long(a.steps),
    }


def main() -> None:
    """Runs the parts named, or all."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.tracking")
    parser.add_argument("parts", nargs="*", choices=[*_parts(), []], metavar="PART", help=", ".join(_parts()))
    parser.add_argument("--runs", type=int, help="of each case (starts, published, false-steps: in all)")
    parser.add_argument("--seconds", type=float, help="of each run; scenarios: of each quiet stretch too")
    parser.add_argument(
        "--only", default="", help="scenarios, witness, steady, published, false-steps: whose name contains this"
    )
    parser.add_argument("--slow", action="store_true", help="witness: 10 %% an hour")
    parser.add_argument("--jobs", type=int, default=2, help="witness, steady, published, false-steps: processes")
    parser.add_argument(
        "--out", type=Path, help="witness, steady, published, false-steps: one JSON line a run into this file"
    )
    parser.add_argument("--motion", default="multisine", help="models: which")
    parser.add_argument("--plots", type=Path, help="scenarios: write one PNG of each into this directory")
    parser.add_argument(
        "--first", type=int, help="starts: number of the first; witness, published, false-steps: first seed"
    )
    parser.add_argument("--steps", type=float, default=1e8, help="long: how many")
    arguments = parser.parse_args()
    for part in arguments.parts or _parts():
        _parts()[part](arguments)


if __name__ == "__main__":
    main()
