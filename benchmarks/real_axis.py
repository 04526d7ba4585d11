"""The EMPS axis: how far its free runs are off, and how far any parameters of the same effects would be.

Two measures on the whole capture: the speed of one free run of 25 s, and the angle (here the position) of free runs of
1 s begun at what was measured. Diagnosed: effects and values chosen by `diagnose`, which does not choose by these
measures; fitted: `fit --segment 1` with the effects given; the least: least squares spent on each measure by itself,
which is the bound for every way to find parameters of these effects. By hand: what the project began with. Where the
runs of 1 s happen to begin moves their figure by a quarter: behind it stands what it is over ten begins, 0.1 s apart.

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
from servo_daemon.identification.output_error.problem.score import Errors, errors
from servo_daemon.plant.build import PlantModel, build_plant
from servo_daemon.samples import F64, SampleBlock
from tests.command_line import run_command

EFFECTS = (("asymmetric_friction",), ("asymmetric_friction", "position_dependent_friction"))
#: mm/s of the free run, mm of the runs of 1 s.
BY_HAND = ((1.25, 0.42), (1.00, 0.34))
SPEED, ANGLE = "velocity_rad_s", "position_rad"
#: Every so many samples, steps of the differences.
EVERY, STEP = 5, 1e-4
#: Samples.
ONE_SECOND = 1000


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
        ours = f"fitted {_told(block, plant, q)}; the least {least[0]:.2f} {least[1]:.2f} ({ratios})"
        print(f"  {' + '.join(effects)}: {ours}; by hand {by_hand[0]:.2f} {by_hand[1]:.2f}")
    document = run_command("diagnose", path, "--json").document
    names = [effect["name"] for effect in document["effects"]]
    found = document["extended"]["parameters"]
    plant = build_plant(tuple(names), "torque")
    print(f"  diagnosed, {' + '.join(names)}: {_told(block, plant, _coordinates(plant, found))}")


def _told(block: SampleBlock, plant: PlantModel, q: F64) -> str:
    long, short = _figures(errors(block, plant, q))
    begins = range(0, ONE_SECOND, ONE_SECOND // 10)
    others = [_figures(errors(block.slice(begin, len(block)), plant, q))[1] for begin in begins]
    rms = float(np.sqrt(np.mean(np.square(others))))
    return f"{long:.2f} {short:.2f} ({min(others):.2f} … {max(others):.2f}, rms {rms:.2f})"


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
