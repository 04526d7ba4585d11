"""Stands in for `servo-daemon diagnose` in tests of the daemon: reads what it is given and says what it is told to.

    python fake_diagnose.py WHAT [GATE] -- CAPTURE --out DIR --config FILE --drive NAME --json --progress-json …

WHAT: found, none, unexplained, fail, garbage, empty, hang. With GATE it waits in the middle until that file is there.
`found` finds a dry friction of the strength that the environment's FAKE_TC says (N·m), at a hundredth of it as std.
Nothing but the standard library, so that it starts at once.
"""

from __future__ import annotations

import json
import os
import sys
import time
import tomllib
from pathlib import Path
from typing import Any

REPORT = "<!doctype html><title>report</title><h1>what the simulation lacks</h1>"


def say(progress: float, step: str) -> None:
    print(json.dumps({"progress": progress, "step": step}), file=sys.stderr, flush=True)


def document(what: str, tc: float) -> dict[str, Any]:
    found: dict[str, Any] = {
        "name": "coulomb_friction",
        "cause": "bearings and brushes rub with a force that hardly depends on the speed",
        "equation": r"T_c \\operatorname{sgn} \\omega",
        "parameters": {"Tc": {"value": tc, "std": tc / 100, "unit": "N·m"}},
        "gain": 0.93,
        "equivalent": [],
    }
    score = {"parameters": {}, "heldout_rmse": {"current_A": 0.1}, "heldout_nrmse": 0.2}
    is_found = what == "found"
    follows = [{"series": "torque", "on": "speed", "share": 0.7}] if what == "unexplained" else []
    return {
        "schema": 1,
        "verdict": what,
        "effects": [found] if is_found else [],
        "baseline": score,
        "extended": {**score, "parameters": {"Tc": found["parameters"]["Tc"]}} if is_found else None,
        "noise_floor": 0.05,
        "gain": {"error_removed": 0.93, "ci95": [0.91, 0.95], "measured_on": "unseen"} if is_found else None,
        "validation": [],
        "candidates": [{"name": "coulomb_friction", "heldout_nrmse": 0.06, "delta_bic": -900.0}],
        "missing": {
            "torque": {
                "unit": "N·m",
                "working_rms": 1.5,
                "before_rms": 0.0124,
                "after_rms": 0.002 if is_found else None,
                "over_speed": {
                    "unit": "rad/s",
                    "before": {"speed": [-6.0, -0.1, 0.0, 0.1, 6.0], "value": [-tc, -tc, None, tc, tc]},
                    "after": {"speed": [-6.0, 6.0], "value": [0.001, -0.001]} if is_found else None,
                },
            }
        },
        "remaining": {"white": what != "unexplained", "depends_on": follows},
        "unfinished": None,
    }


def main(arguments: list[str]) -> int:
    split = arguments.index("--")
    (what, *gate), (capture, *options) = arguments[:split], arguments[split + 1 :]
    given = dict(zip(options[::2], options[1::2], strict=False))
    out, config = Path(given["--out"]), tomllib.loads(Path(given["--config"]).read_text(encoding="utf-8"))
    (drive,) = (d for d in config["drive"] if d["name"] == given["--drive"])
    lines = Path(capture).read_text(encoding="utf-8").splitlines()
    say(0.1, f"{sum(not line.startswith('#') for line in lines) - 1} samples, model {drive['model']}")
    print("a line that is no progress", file=sys.stderr, flush=True)
    say(0.5, "round 1: fitting coulomb_friction")
    while (gate and not Path(gate[0]).exists()) or what == "hang":
        time.sleep(0.02)
    if what == "fail":
        print("error: nothing moves in this recording", file=sys.stderr)
        return 1
    out.mkdir(parents=True)
    if what == "empty":
        return 0
    written = document("unexplained" if what == "short" else what, float(os.environ.get("FAKE_TC", "0.02")))
    journal = Path(given["--journal"])
    if what == "short" and not journal.exists():  # the first try leaves something, the second ends with it
        written["unfinished"] = {"budget_s": float(given["--budget"]), "cpu_s": 1.0, "not_tried": [capture]}
        journal.write_text("half", encoding="utf-8")
    text = "{" if what == "garbage" else json.dumps(written)
    (out / "diagnosis.json").write_text(text)
    (out / "report.html").write_text(REPORT)
    say(1.0, "done")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
