"""A motor on steps of voltage whose current is recorded as its mean over the row before, or at the row.

Integrated exactly over hundredths of a row; nothing of it is the plant that is fitted.
"""

from __future__ import annotations

import numpy as np

from servo_daemon.plant.linear import linear_step
from servo_daemon.samples import SampleBlock, make_block

MOTOR = {"R": 1.2, "K": 0.05, "J": 5e-5, "B": 1e-5}
PERIOD_S, FINE, COUNT = 1e-3, 100, 2 * np.pi / 4096


def recorded(
    L: float, *, means: bool, friction_Nm: float = 0.0, seed: int = 5, n: int = 3000, period_s: float = PERIOD_S
) -> SampleBlock:
    """Steps of voltage every 30 rows, angles in counts; the current's mean by the trapezoidal rule over the hundredths
    of a row. A dry friction turns round with the rows."""
    rng = np.random.default_rng(seed)
    voltage = np.repeat(rng.uniform(-24.0, 24.0, n // 30 + 1), 30)[:n]
    free, forced = [np.eye(3)], [np.zeros((3, 2))]  # after each hundredth
    Ad, Bd = linear_step({**MOTOR, "L": L}, period_s / FINE)
    for _ in range(FINE):
        free.append(Ad @ free[-1])
        forced.append(Ad @ forced[-1] + Bd)
    after, by = np.array(free), np.array(forced)
    x, at, mean = np.zeros(3), np.empty((n, 3)), np.zeros(n + 1)
    for k in range(n):
        at[k] = x
        path = after @ x + by @ [voltage[k], friction_Nm * np.sign(x[1])]
        mean[k + 1] = np.mean(path[1:, 0] + path[:-1, 0]) / 2.0
        x = path[-1]
    return make_block(
        np.asarray(period_s * np.arange(n), np.float64),
        voltage_V=voltage,
        current_A=(mean[:-1] if means else at[:, 0]) + rng.normal(0.0, 0.01, n),
        position_rad=np.asarray(np.floor(at[:, 2] / COUNT) * COUNT),
    )
