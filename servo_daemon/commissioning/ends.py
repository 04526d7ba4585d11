"""Where the travel ends: a shaft that stands at the ends of its way although it is pushed on."""

from __future__ import annotations

import numpy as np

from servo_daemon.samples import F64

#: The last of the way, in counts and as a share of it: an encoder at rest, and what a stop gives way.
_COUNTS, _SHARE = 6.0, 0.01
#: A push is so many times the current that moved the shaft first: no dry friction stands against it. s: so long
#: altogether; a shaft that turns round by itself is pushed inward.
_PUSH, _STANDS_S = 3.0, 0.02


def stops(time_s: F64, position_rad: F64, current_A: F64, moving_A: float, count_rad: float) -> list[float]:
    """Positions beyond which the shaft does not go, rad; none where the data do not say so.

    Args:
        current_A: positive where it drives towards positive positions.
        moving_A: that moved the shaft first.
    """
    margin = max(_COUNTS * count_rad, _SHARE * float(np.ptp(position_rad)))
    step_s = np.diff(time_s, append=time_s[-1])
    found = []
    for side in (-1.0, 1.0):
        way = side * position_rad
        against = (way > way.max() - margin) & (side * current_A > _PUSH * moving_A)
        if float(step_s[against].sum()) > _STANDS_S:
            found.append(side * float(way.max()))
    return found


def words(at: list[float]) -> str:
    """'a stop at -0.535 and at 0.534 rad'."""
    places = " and at ".join(f"{x:.3g}" for x in at)
    return f"the shaft stands although it is pushed on: a stop at {places} rad from where it began"
