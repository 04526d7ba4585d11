"""Candidates that bring no formula for their screening: from the terms of the effect alone.

What is linear in a parameter is a column, the others are scanned about the size that their `Scale` gives them. Where
nothing is linear, the whole is a column, near whose coefficient of one its values are physical.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product

import numpy as np

from servo_daemon.identification.output_error.starts import effect_start
from servo_daemon.parameters import Parameter
from servo_daemon.plant.columns.screening import Basis, Context, Family, Motion, Start, Trace
from servo_daemon.plant.contribution import BALANCES, SENSORS, Contribution, contribution
from servo_daemon.samples import F64

#: Most points of a scan, in all: each costs a column, 3 ms for 10,000 samples.
_POINTS = 64
#: A size is scanned over so many times the usual one either way; without any slope to start from a fit finds its way
#: over a factor of about three.
_RANGE = 10.0
#: Where nothing is linear a coefficient further from one than this is of other values than those of its column
#: (chosen; not tried).
_NEAR_ONE = 5.0
#: The counts that are tried.
_COUNTS = range(1, 17)


def derived(name: str) -> Family:
    """The bases of an effect, over a scan of what is not linear; none where its terms do not show along a motion that
    is given (a second inertia, a lag)."""

    def bases(c: Context) -> Iterator[Basis]:
        added = contribution(name)
        if not added.is_along_motion:
            return
        motion, usual = motion_for(c), usual_values(added, c.motion)
        scanned = [p for p in added.effect.parameters if p not in added.linear]
        points = int(_POINTS ** (1.0 / max(len(scanned), 1)))
        for k, at in enumerate(product(*(scan(p, usual[p.name], points, c.motion) for p in scanned))):
            values = {**usual, **c.motion.p, **dict(zip((p.name for p in scanned), at, strict=True))}
            columns = added.along(motion, values)
            m = len(added.linear)
            used = range(1, 1 + m) if m else (0,)
            keys = tuple(c.add(f"{name} {k} {j}", _trace(columns, j)) for j in used)
            yield Basis(keys, _start(added, values), len(added.effect.parameters))

    return bases


def motion_for(c: Context) -> dict[str, F64]:
    """As `Contribution.along` takes it."""
    m = c.motion
    torque = m.p["K"] * m.i if "K" in m.p else m.u
    return {
        "t": m.t + m.h / 2,
        "v": m.u if "R" in m.p else np.zeros_like(m.u),  # else the input is no voltage
        "i": m.i,
        "omega": m.omega,
        "theta": m.theta,
        "torque": torque,
        "h": m.h,
        "sliding": c.rest_friction,
        "flowing": np.sign(m.i),
    }


def usual_values(added: Contribution, m: Motion) -> dict[str, float]:
    """Where a search begins on a motor of this size, natural units."""
    torque = m.p["K"] * m.i if "K" in m.p else m.u
    signals = {"torque": torque, "voltage": m.u, "current": m.i, "speed": m.omega}
    sizes = {name: float(np.percentile(np.abs(x), 95.0)) or 1.0 for name, x in signals.items()}
    sizes |= {"travel": float(np.ptp(m.theta)) / 2 or 1.0, "seconds": float(m.t[-1] - m.t[0])}
    sizes |= {name: m.p[name] for name in ("R", "J", "B") if name in m.p}
    return {p.name: m.p.get(p.name, effect_start(p, sizes)) for p in added.effect.parameters}


def scan(p: Parameter, usual: float, points: int, m: Motion) -> Sequence[float]:
    """Values of a parameter that nothing is linear in, natural units."""
    if p.choices:
        return [float(k) for k in range(len(p.choices))]
    if p.held == "always":
        return sorted({usual, *(float(n) for n in _COUNTS if p.lower <= n <= p.upper)})
    if p.unit == "s" and p.held == "live":
        return _within(p, np.linspace(float(m.t[0]), float(m.t[-1]), points + 2)[1:-1])
    if p.transform == "log":
        return _within(p, usual * np.geomspace(1 / _RANGE, _RANGE, points | 1))
    if p.unit == "rad":
        return _within(p, np.linspace(-math.pi, math.pi, points, endpoint=False))
    size = max(abs(usual), 1.0 if p.scale is None else abs(usual - p.nominal))
    return _within(p, np.r_[usual, usual + size * np.linspace(-2.0, 2.0, points)])


def _within(p: Parameter, values: F64) -> list[float]:
    return sorted({float(v) for v in np.clip(values, p.lower, p.upper)})


def _trace(columns: Mapping[str, F64], k: int) -> Trace:
    torque, voltage = (columns[name][:, k] for name in BALANCES)
    shown = {name: columns[name][:, k] for name in SENSORS if columns[name][:, k].any()}
    return Trace(torque if torque.any() else None, voltage if voltage.any() else None, shown)


def _start(added: Contribution, values: Mapping[str, float]) -> Callable[[F64], Start | None]:
    own = {p.name: values[p.name] for p in added.effect.parameters}

    def start(b: F64) -> Start | None:
        if not added.linear:
            return own if 1 / _NEAR_ONE < b[0] < _NEAR_ONE else None
        found = dict(zip((p.name for p in added.linear), b.tolist(), strict=True))
        if any(not p.lower <= found[p.name] <= p.upper for p in added.linear):
            return None
        return {**own, **found}

    return start
