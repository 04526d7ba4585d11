"""What a diagnosis costs: `python -m benchmarks.diagnosis`.

Twenty captures of the independent generator at 1 kHz, one of every family of effects, each diagnosed in a process of
its own as users start it: processor time (compilers included), wall time, cores used, peak memory, and what was named.
Models that one capture has compiled are there for the next; `--cold` compiles them anew.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.recovery.generator import MOTORS, Scenario, generate
from tests.recovery.hidden import Case

#: Seed of every capture, and what is asked of 60 s: processor time of the median and of the worst, s; MB.
_SEED, _MEDIAN_S, _WORST_S, _MOST_MB = 31, 15.0, 60.0, 600.0
#: Cause, motor, motion.
_CASES = (
    ("clean", "gear", "pick_and_place"),
    ("coulomb_friction", "gear", "pick_and_place"),
    ("asymmetric_friction", "re40", "reversals"),
    ("stribeck_friction", "paper", "steps"),
    ("load_dependent_friction", "gear", "multisine"),
    ("quadratic_drag", "large", "multisine"),
    ("gravity_load", "re40", "reversals"),
    ("cogging_torque", "re40", "multisine"),
    ("torque_ripple", "large", "steps"),
    ("constant_load_torque", "gear", "reversals"),
    ("load_torque_step", "re40", "multisine"),
    ("periodic_disturbance", "paper", "pick_and_place"),
    ("brush_voltage_drop", "gear", "reversals"),
    ("magnetic_saturation", "re40", "reversals"),
    ("winding_heating", "re40", "pick_and_place"),
    ("backlash", "gear", "multisine"),
    ("shaft_compliance", "re40", "reversals"),
    ("encoder_eccentricity", "large", "reversals"),
    ("measurement_delay", "large", "reversals"),
    ("hysteresis_spring", "paper", "steps"),
)


@dataclass(frozen=True, slots=True)
class Cost:
    """Of one diagnosis: s, s, MB, and the effects named."""

    cpu_s: float
    wall_s: float
    peak_MB: float
    found: tuple[str, ...]


def diagnosed(capture: Path, cache: Path) -> Cost:
    """One `servo-daemon diagnose` of a file."""
    command = [sys.executable, "-m", "servo_daemon", "diagnose", str(capture), "--json"]
    environment = {**os.environ, "XDG_CACHE_HOME": str(cache), "OMP_NUM_THREADS": "1"}
    began = time.perf_counter()
    with tempfile.TemporaryFile() as answer:
        process = subprocess.Popen(command, stdout=answer, stderr=subprocess.DEVNULL, env=environment)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        answer.seek(0)
        if process.returncode != 0:
            raise SystemExit(f"{capture.name}: exit code {process.returncode}: {answer.read().decode()}")
        found = tuple(effect["name"] for effect in json.load(answer)["effects"])
    wall_s = time.perf_counter() - began
    return Cost(used.ru_utime + used.ru_stime, wall_s, used.ru_maxrss / 1024.0, found)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="length of the captures")
    parser.add_argument("--only", nargs="+", choices=[c[0] for c in _CASES], help="captures of these causes")
    parser.add_argument("--cold", action="store_true", help="every model is compiled anew for each capture")
    arguments = parser.parse_args()
    kept = "compiled anew" if arguments.cold else "compiled before as far as other captures needed them"
    print(f"{os.cpu_count()} cores, {arguments.seconds:g} s at 1 kHz, models {kept}")
    print(f"limits for 60 s: median {_MEDIAN_S:g} s, worst {_WORST_S:g} s, {_MOST_MB:g} MB")
    print(f"{'hidden':<24s} {'CPU s':>7s} {'wall s':>7s} {'cores':>6s} {'MB':>5s}  named")
    costs = []
    with tempfile.TemporaryDirectory() as folder:
        for cause, motor, motion in _CASES:
            if arguments.only and cause not in arguments.only:
                continue
            case = Case(cause, "clear", motor, motion, _SEED)
            effects, path = case.effects(arguments.seconds), Path(folder) / f"{cause}.csv"
            scenario = Scenario(motion, seconds=arguments.seconds, effects=effects, seed=_SEED)
            generate(MOTORS[motor], scenario).write_csv(path)
            cost = diagnosed(path, Path(folder) / (cause if arguments.cold else "cache"))
            print(_line(cause, cost), flush=True)
            costs.append(cost)
    print(_summary(costs))
    return 0


def _line(name: str, cost: Cost) -> str:
    used = f"{cost.cpu_s:7.1f} {cost.wall_s:7.1f} {cost.cpu_s / cost.wall_s:6.2f} {cost.peak_MB:5.0f}"
    return f"{name:<24s} {used}  {', '.join(cost.found) or '-'}"


def _summary(costs: Sequence[Cost]) -> str:
    cpu, wall, peak = [c.cpu_s for c in costs], [c.wall_s for c in costs], [c.peak_MB for c in costs]
    median = f"median {statistics.median(cpu):.1f} s of CPU, {statistics.median(wall):.1f} s"
    cores = sum(cpu) / sum(wall)
    return f"{median}; worst {max(cpu):.1f} s of CPU, {max(wall):.1f} s, {max(peak):.0f} MB; {cores:.2f} cores used"


if __name__ == "__main__":
    raise SystemExit(main())
