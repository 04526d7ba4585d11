"""Free run: a model integrated from a start state with nothing but its recorded input."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import numpy as np

from servo_daemon.errors import BadInputError
from servo_daemon.plant.build import PlantModel
from servo_daemon.plant.compiled import SampleLoop
from servo_daemon.samples import F64


@lru_cache(maxsize=16)
def _loop(plant: PlantModel) -> SampleLoop:
    """(x; p; t, h, u) → (x after h, x)."""
    import casadi as ca

    x, p = ca.SX.sym("x", len(plant.states)), ca.SX.sym("p", len(plant.parameters))
    row = ca.SX.sym("row", 3)
    return SampleLoop(ca.Function("step", [x, p, row], [plant.step(x, row[2], p, row[0], row[1]), x]), paced_by=1)


def free_run(plant: PlantModel, values: Mapping[str, float], time_s: F64, held: F64, start: Mapping[str, float]) -> F64:
    """States at every sample, shape (n, states) in the order of `plant.state_names`.

    Dry friction sticks and breaks away exactly at its level (Moreau's time stepping), so a linear axis under force
    control (`drive="torque"`) comes to rest where the measured one does.

    Args:
        plant: with the drive that `held` is: voltage, current or torque (force).
        values: natural units, every parameter of the plant.
        time_s: shape (n,), increasing.
        held: shape (n,), the input, held from each sample to the next.
        start: states at the first sample by name; a missing one begins at its initial value.

    Raises:
        BadInputError: a parameter is missing, or the run leaves the numbers.
    """
    missing = [name for name in plant.parameter_names if name not in values]
    if missing:
        raise BadInputError(f"a free run needs a value for {', '.join(missing)}")
    x = np.array([start.get(s.name, s.initial) for s in plant.states], float)
    constants = np.array([values[name] for name in plant.parameter_names], float)
    period = np.diff(time_s)
    rows = np.column_stack([time_s - time_s[0], np.append(period, period[-1]), held])
    states = _loop(plant).run(x, constants, np.ascontiguousarray(rows, float))
    if not np.all(np.isfinite(states)):
        raise BadInputError("the free run diverges with these parameters")
    return states
