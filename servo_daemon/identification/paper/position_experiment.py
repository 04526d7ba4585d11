"""The paper's position test: a step of the wanted angle by 50°, and where the axis stands 5 s later.

The paper gives no gains and no feedback of the angle; the loop is closed as in `plant/servo_loop.py`. Without the
tacho (k_g = 0) only the product k_io·k_s is left, and one reported figure fixes it: with the parameters of the
paper's method 1 the axis shall stand at 45° after 5 s. Whatever else comes out is then a result.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.optimize import brentq

from servo_daemon.errors import BadInputError
from servo_daemon.plant.servo_loop import ServoGains, closed_servo
from servo_daemon.samples import F64

#: The paper's test: a step of the reference, and for how long it is looked at.
STEP_DEG, TEST_S = 50.0, 5.0
#: What the paper reports for its method 1.
REPORTED_DEG = 45.0
#: 1 ms: finer than the loop's fastest mode.
_POINTS = 5001
#: An axis that ends further away than this many steps is unstable in that loop.
_UNSTABLE = 10.0
#: Where the product k_io·k_s is looked for, V/rad.
_PRODUCTS = (1e-6, 1e9)


@dataclass(frozen=True, slots=True)
class PositionTest:
    """How an axis follows the step.

    Attributes:
        time_s, angle_deg: shape (n,) each.
        final_deg: angle after 5 s.
        overshoot: of the step, 0 … .
        distance_deg: RMS distance to the reference curve; None without one.
        stable: whether it settles at all.
    """

    time_s: F64
    angle_deg: F64
    final_deg: float
    overshoot: float
    distance_deg: float | None
    stable: bool


def loop_gains(product_V_rad: float) -> ServoGains:
    """Gains with this k_io·k_s and no tacho: everything beside the potentiometer in the servo amplifier."""
    gains = ServoGains()
    rest = gains.k_io * gains.k_op * gains.k_au * gains.k_pu
    return ServoGains(k_su=product_V_rad / rest, k_g=0.0)


def position_test(
    parameters: Mapping[str, float], product_V_rad: float, reference: PositionTest | None = None
) -> PositionTest:
    """The step response of the closed loop with these parameters.

    Args:
        parameters: R, L, K, J, B, natural units.
        reference: the curve to compare with (the true motor's).
    """
    from scipy.signal import step

    loop = closed_servo(parameters, loop_gains(product_V_rad))
    time = np.linspace(0.0, TEST_S, _POINTS)
    stable = bool(np.max(np.roots(loop.denominator).real) < 0.0)
    with np.errstate(over="ignore", invalid="ignore"):
        _, response = step(loop, T=time)
    angle = STEP_DEG * np.clip(np.nan_to_num(response, nan=_UNSTABLE), -_UNSTABLE, _UNSTABLE)
    distance = None if reference is None else float(np.sqrt(np.mean((angle - reference.angle_deg) ** 2)))
    return PositionTest(
        time,
        angle,
        final_deg=float(angle[-1]),
        overshoot=max(float(np.max(angle)) / STEP_DEG - 1.0, 0.0),
        distance_deg=distance,
        stable=stable,
    )


def product_for(parameters: Mapping[str, float], final_deg: float = REPORTED_DEG) -> float:
    """The k_io·k_s, V/rad, with which these parameters give this angle after 5 s (the slow branch: no overshoot).

    Raises:
        BadInputError: no product does.
    """

    def missing(logarithm: float) -> float:
        return position_test(parameters, float(np.exp(logarithm))).final_deg - final_deg

    # The first crossing from below: beyond it the loop overshoots and crosses again.
    grid = np.log(np.geomspace(*_PRODUCTS, 60)).tolist()
    below = missing(grid[0])
    for low, high in pairwise(grid):
        above = missing(high)
        if below < 0.0 <= above:
            return float(np.exp(brentq(missing, low, high, xtol=1e-10)))
        below = above
    raise BadInputError(f"no gain brings this motor to {final_deg:g}° after {TEST_S:g} s")
