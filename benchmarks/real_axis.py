"""The EMPS axis: how far its free runs are off, and how far any parameters of the same effects would be.

Two measures on the whole capture: the speed of one free run of 25 s, and the angle (here the position) of free runs of
1 s begun at what was measured. Diagnosed: effects and values chosen by `diagnose`, which does not choose by these
measures; fitted: `fit --segment 1` with the effects given; the least: least squares spent on each measure by itself,
which is the bound for every way to find parameters of these effects. By hand: what the project began with.

    SERVO_DATA=../shared/data .venv/bin/python benchmarks/real_axis.py
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from servo_daemon.captures import read_capture
from servo_daemon.estimators.output_error.score import Errors, errors
from servo_daemon.plant.build import PlantModel, build_plant
from servo_daemon.samples import F64, SampleBlock
from tests.unit.commands import run_command

EFFECTS = (("asymmetric_friction",), ("asymmetric_friction", "position_dependent_friction"))
#: mm/s of the free run, mm of the runs of 1 s.
BY_HAND = ((1.25, 0.42), (1.00, 0.34))
SPEED, ANGLE = "velocity_rad_s", "position_rad"
#: Every so many samples, steps of the differences.
EVERY, STEP = 5, 1e-4


def main() -> None:
    path = Path(os.environ.get("SERVO_DATA", "../shared/data")) / "emps_train.csv.gz"
    block = read_capture(path).block()
    print("EMPS, free run of 25 s (mm/s) and free runs of 1 s (mm)")
    for effects, by_hand in zip(EFFECTS, BY_HAND, strict=True):
        words = [word for effect in effects for word in ("--effect", effect)]
        document = run_command("fit", path, *words, "--segment", "1", "--json").document
        plant = build_plant(effects, "torque")
        q = _coordinates(plant, document["parameters"])
        fitted, least = _figures(errors(block, plant, q)), _least(block, plant, q)
        ratios = f"{fitted[0] / least[0]:.2f} × and {fitted[1] / least[1]:.2f} ×"
        ours = f"fitted {fitted[0]:.2f} {fitted[1]:.2f}; the least {least[0]:.2f} {least[1]:.2f} ({ratios})"
        print(f"  {' + '.join(effects)}: {ours}; by hand {by_hand[0]:.2f} {by_hand[1]:.2f}")
    (runs,) = run_command("diagnose", path, "--json").document["free_runs"]
    for kind in ("baseline", "extended"):
        long, short = runs[kind]["rmse"]["velocity_m_s"], runs[kind]["rmse_1s"]["position_m"]
        print(f"  diagnosed, {kind}: {1e3 * long:.2f} {1e3 * short:.2f}")


def _coordinates(plant: PlantModel, found: dict[str, Any]) -> F64:
    values = [found[p.name]["value"] if p.name in found else p.nominal for p in plant.parameters]
    logs = [p.transform == "log" for p in plant.parameters]
    return np.array([np.log(value) if log else value for value, log in zip(values, logs, strict=True)])


def _figures(e: Errors) -> tuple[float, float]:
    long, short = e.long[:, e.channels.index(SPEED)], e.short[:, e.channels.index(ANGLE)]
    return 1e3 * float(np.sqrt(np.mean(long**2))), 1e3 * float(np.sqrt(np.mean(short**2)))


def _least(block: SampleBlock, plant: PlantModel, q: F64) -> tuple[float, float]:
    """The smallest of each figure that any coordinates give, from these on."""
    unit = np.where([p.transform == "log" for p in plant.parameters], 1.0, np.maximum(np.abs(q), 1.0))

    def found(which: int) -> float:
        def residuals(z: F64) -> F64:
            e = errors(block, plant, q + z * unit)
            values = (e.long[:, e.channels.index(SPEED)], e.short[:, e.channels.index(ANGLE)])[which]
            return np.asarray(1e3 * values[::EVERY])

        z = least_squares(residuals, np.zeros(len(q)), diff_step=STEP).x
        return _figures(errors(block, plant, q + z * unit))[which]

    return found(0), found(1)


if __name__ == "__main__":
    main()
