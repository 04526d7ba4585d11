"""What the plant itself makes of a model and an input: what every export is held to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servo_daemon.export.model import ExportedModel
from servo_daemon.plant.build import PlantModel, build_plant
from servo_daemon.samples import F64

#: Of an input: both ways, standing, and half of the way to where friction is felt; shares of its size.
_SHAPE = (1.0, -0.6, 0.0, 0.5, -1.0)
PHASES = len(_SHAPE)


@dataclass(frozen=True)
class Run:
    """An input and what followed.

    Attributes:
        period_s: of its samples.
        u: input, held from each sample until the next, shape (n,).
        x: the plant's states at the samples, shape (n + 1, states).
    """

    plant: PlantModel
    period_s: float
    u: F64
    x: F64


def plant_of(model: ExportedModel) -> PlantModel:
    return build_plant(model.effects, model.drive)


def simulated(model: ExportedModel, u: F64, period_s: float) -> Run:
    """Free run from the plant's initial states.

    Raises:
        BadInputError: a parameter is not known.
    """
    plant = plant_of(model)
    values = model.require(plant.parameter_names, "a simulation")
    p = np.array([values[name] for name in plant.parameter_names])
    rows = [np.array([s.initial for s in plant.states])]
    for k, held in enumerate(u.tolist()):
        after = plant.step(rows[-1], held, p, k * period_s, period_s)
        rows.append(np.asarray(after.full(), dtype=np.float64)[:, 0])
    return Run(plant, period_s, u, np.array(rows))


def trial_input(model: ExportedModel, samples: int) -> tuple[F64, float]:
    """An input that moves the motor both ways and lets it stand in between, and its sample period, s.

    Args:
        samples: a multiple of `PHASES`.
    """
    v = {name: value.value for name, value in model.values.items()}
    if model.drive == "voltage":
        settles = v["R"] * v["J"] / (v["R"] * v["B"] + v["K"] ** 2)
        size = max(5.0 * v["R"] * v.get("Tc", 0.0) / v["K"], 10.0 * (v["K"] + v["R"] * v["B"] / v["K"]))
        size = min(size, model.limits.get("voltage_V", size))
    else:
        settles, per_torque = v["J"] / v["B"], v["K"] if model.drive == "current" else 1.0
        size = max(5.0 * v.get("Tc", 0.0), 10.0 * v["B"]) / per_torque
    return float(f"{size:.6g}") * np.repeat(_SHAPE, samples // PHASES), float(8.0 * settles / samples)
