"""The smoothed signals as the formulas take them: means over the steps, with derivatives."""

from __future__ import annotations

import numpy as np

from servo_daemon.diagnosis.missing.missing import Missing
from servo_daemon.identification.output_error.problem.rollout import STEP, TIME
from servo_daemon.plant.columns.screening import Motion
from servo_daemon.samples import F64

#: At rest is slower than this many standard deviations, or than this share of the usual speed (chosen; not tried).
_REST_STD, _REST_SHARE = 3.0, 2e-3


def motion_of(missing: Missing) -> Motion:
    """The motion of a capture from its smoothed states."""
    a = missing.augmented
    p = {
        q.name: float(np.exp(v)) if q.transform == "log" else float(v)
        for q, v in zip(a.plant.parameters, missing.coordinates, strict=True)
    }
    parts = [_of_stretch(s.z, s.rows[:, STEP], a.plant.state_names) for s in missing.stretches]
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    names = a.plant.state_names
    voltage = a.plant.drive == "voltage"
    if voltage:
        i, i_rate = joined["current_A"], joined["current_A_rate"]
    else:
        i = missing.input if a.plant.drive == "current" else np.zeros(len(missing.input))
        i_rate = np.gradient(i, missing.time_s)
    omega = joined["velocity_rad_s"]
    std = np.concatenate([s.std[:, names.index("velocity_rad_s")] for s in missing.stretches])
    step = missing.resolution.get("position_rad", 0.0)
    h = np.concatenate([s.rows[:, STEP] for s in missing.stretches])
    slow = np.maximum(_REST_STD * std, _REST_SHARE * float(np.percentile(np.abs(omega), 95.0)))
    slow = np.maximum(slow, step / (20.0 * float(np.median(h))))
    at_sample = {
        "current_A": missing.states["current_A"] if voltage else missing.input,
        "current_A_rate": i_rate,
        "position_rad": missing.states["position_rad"],
        "velocity_rad_s": missing.states["velocity_rad_s"],
    }
    return Motion(
        p=p,
        t=np.concatenate([s.rows[:, TIME] for s in missing.stretches]),
        h=h,
        u=missing.input,
        i=i,
        omega=omega,
        theta=joined["position_rad"],
        i_rate=i_rate,
        omega_rate=joined["velocity_rad_s_rate"],
        at_sample=at_sample,
        rest=np.abs(omega) < slow,
    )


def _of_stretch(z: F64, h: F64, names: tuple[str, ...]) -> dict[str, F64]:
    out = {}
    for k, name in enumerate(names):
        ahead = np.append(z[1:, k], 2 * z[-1, k] - z[-2, k])
        out[name] = (z[:, k] + ahead) / 2
        out[name + "_rate"] = (ahead - z[:, k]) / h
    return out
