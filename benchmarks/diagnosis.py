"""How long a diagnosis takes and what it holds in memory, by length of the capture: `python -m benchmarks.diagnosis`.

Captures are of the independent generator (a gear motor, 20 % Coulomb friction, 1 kHz). "cold" compiles every model
anew, in a cache directory of its own; "warm" is the run after it. Each run is a process of its own, as users start it.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.recovery.generator import GEAR_MOTOR, Scenario, generate, typical

_LENGTHS_S, _LIMIT_S = (10.0, 20.0, 60.0), {"cold": 90.0, "warm": 30.0}
_LIMIT_MB = 1024.0


def _diagnose(capture: Path, cache: Path) -> tuple[float, float]:
    """Wall time, s, and peak memory of all children so far, MB."""
    began = time.perf_counter()
    command = [sys.executable, "-m", "servo_daemon", "diagnose", str(capture), "--json"]
    environment = {**os.environ, "XDG_CACHE_HOME": str(cache), "OMP_NUM_THREADS": "1"}
    subprocess.run(command, check=True, capture_output=True, env=environment)
    return time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, nargs="+", default=_LENGTHS_S, help="lengths of the captures")
    arguments = parser.parse_args()
    print(f"{os.cpu_count()} cores, 1 kHz, whole library; limits for 60 s: cold {_LIMIT_S['cold']:g} s, warm "
          f"{_LIMIT_S['warm']:g} s, {_LIMIT_MB:g} MB")  # fmt: skip
    print(f"{'capture':>10s}  {'cold':>7s}  {'warm':>7s}  {'peak':>7s}")
    with tempfile.TemporaryDirectory() as folder:
        for seconds in arguments.seconds:
            effects = typical("coulomb_friction", GEAR_MOTOR, 0.2, seconds=seconds)
            recording = generate(GEAR_MOTOR, Scenario("pick_and_place", seconds=seconds, effects=effects, seed=3))
            capture, cache = Path(folder) / f"{seconds:g}.csv", Path(folder) / f"cache-{seconds:g}"
            recording.write_csv(capture)
            cold, _ = _diagnose(capture, cache)
            warm, peak = _diagnose(capture, cache)
            print(f"{seconds:8g} s  {cold:5.1f} s  {warm:5.1f} s  {peak:4.0f} MB")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
