"""The linear motor's step, exact, for one motor or for many: SciPy's `expm` in place of the closed form."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from servo_daemon.parameters import MOTOR_NAMES
from servo_daemon.samples import F64


def linear_step(p: Mapping[str, float | F64], h: float) -> tuple[F64, F64]:
    """(Ad, Bd) of (i, ω, θ) over h seconds with (voltage, load torque) held: shapes (…, 3, 3) and (…, 3, 2).

    Args:
        p: R, L, K, J, B: numbers, or arrays of one shape (…) for as many motors.
    """
    from scipy.linalg import expm  # 0.2 s to load, and a fit takes no such step

    R, L, K, J, B = np.broadcast_arrays(*(np.asarray(p[name], np.float64) for name in MOTOR_NAMES))
    augmented = np.zeros((*R.shape, 5, 5))
    augmented[..., 0, 0], augmented[..., 0, 1], augmented[..., 0, 3] = -R / L, -K / L, 1 / L
    augmented[..., 1, 0], augmented[..., 1, 1], augmented[..., 1, 4] = K / J, -B / J, -1 / J
    augmented[..., 2, 1] = 1.0
    step = expm(augmented * h)
    return step[..., :3, :3], step[..., :3, 3:]
