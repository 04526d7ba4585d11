"""The NumPy twin: the same step as `build.py`, from other building blocks, for tests to compare with.

The linear core is SciPy's `expm` of the augmented matrix instead of the closed form, the splitting is written out in
NumPy, and only the effects' own terms are shared (evaluated on numbers): an effect's formula exists once.
"""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np
from scipy.linalg import expm

from servo_daemon.plant.build import PlantModel
from servo_daemon.plant.effects import Signals, effects_by_name
from servo_daemon.samples import F64


def linear_step(p: Mapping[str, float | F64], h: float) -> tuple[F64, F64]:
    """(Ad, Bd) of (i, ω, θ) over h seconds with (voltage, load torque) held: shapes (…, 3, 3) and (…, 3, 2).

    Args:
        p: R, L, K, J, B: numbers, or arrays of one shape (…) for as many motors.
    """
    R, L, K, J, B = np.broadcast_arrays(*(np.asarray(p[name], np.float64) for name in ("R", "L", "K", "J", "B")))
    augmented = np.zeros((*R.shape, 5, 5))
    augmented[..., 0, 0], augmented[..., 0, 1], augmented[..., 0, 3] = -R / L, -K / L, 1 / L
    augmented[..., 1, 0], augmented[..., 1, 1], augmented[..., 1, 4] = K / J, -B / J, -1 / J
    augmented[..., 2, 1] = 1.0
    step = expm(augmented * h)
    return step[..., :3, :3], step[..., :3, 3:]


def _terms(model: PlantModel, x: F64, u: float, p: Mapping[str, float], t: float) -> dict[str, float]:
    """Sums (factors: products) of all effects' terms, and the rates of their states, as numbers."""
    own = dict(zip(model.state_names[3:], map(ca.DM, x[3:]), strict=True))
    time, voltage, current, speed, angle = map(ca.DM, (t, u, x[0], x[1], x[2]))
    signals = Signals(time, voltage, current, speed, angle, states=own, p={k: ca.DM(v) for k, v in p.items()})
    total = {"load_torque": 0.0, "voltage_drop": 0.0, "factor_R": 1.0, "factor_K": 1.0, "factor_B": 1.0}
    levels, rates = np.zeros(2), dict[str, float]()
    for name in model.effects:
        term = effects_by_name()[name].terms(signals)
        for key, before in total.items():
            value = float(getattr(term, key))
            total[key] = before * value if key.startswith("factor") else before + value
        levels += [float(level) for level in term.dry_levels]
        rates |= {state: float(rate) for state, rate in term.rates.items()}
    return total | rates | {"dry_forward": float(levels[0]), "dry_backward": float(levels[1])}


def reference_step(model: PlantModel, x: F64, u: float, p: F64, t: float, h: float) -> F64:
    """x(t + h) with the voltage u held. Shapes as in `PlantModel.step`; voltage-driven models only."""
    named = dict(zip(model.parameter_names, map(float, p), strict=True))
    own_middle = [_own_state(model, k, x, u, named, t, h / 2) for k in range(3, len(x))]
    ahead = _terms(model, np.r_[x[:2], x[2] + h / 2 * x[1], own_middle], u, named, t + h / 2)
    guess, _ = _core_step(x, u, ahead, named, h)
    middle_x = (x[:3] + guess) / 2
    middle = _terms(model, np.r_[middle_x, own_middle], u, named, t + h / 2)
    core, per_load = _core_step(x, u, middle, named, h)
    core += per_load * np.clip(-core[1] / per_load[1], -middle["dry_backward"], middle["dry_forward"])
    own = [_own_state(model, k, np.r_[middle_x, x[3:]], u, named, t + h / 2, h) for k in range(3, len(x))]
    return np.concatenate((core, own))


def _core_step(x: F64, u: float, terms: Mapping[str, float], p: Mapping[str, float], h: float) -> tuple[F64, F64]:
    """(i, ω, θ) after h under these terms without dry friction, and the change per N·m of load torque."""
    scaled = {**p, "R": p["R"] * terms["factor_R"], "K": p["K"] * terms["factor_K"]}
    scaled["B"] = p["B"] * terms["factor_B"]
    Ad, Bd = linear_step(scaled, h)
    return Ad @ x[:3] + Bd @ [u - terms["voltage_drop"], terms["load_torque"]], Bd[:, 1]


def _own_state(model: PlantModel, k: int, x: F64, u: float, p: Mapping[str, float], t: float, h: float) -> float:
    """Exponential step of one state of an effect; the slope of its rate by a central difference."""
    name, d = model.state_names[k], 1e-4 * (1.0 + abs(x[k]))
    shift = d * np.eye(len(x))[k]
    rate, above, below = (_terms(model, at, u, p, t)[name] for at in (x, x + shift, x - shift))
    z = (above - below) / (2 * d) * h
    return float(x[k] + h * rate * (np.expm1(z) / z if z else 1.0))
