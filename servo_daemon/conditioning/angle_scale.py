"""Whether a motor's values stand to their nominal ones as an angle in another scale makes them.

An angle that is f times too small makes K f times, J, B and every torque f² times too large, and R and L none: no data
of such a drive contradict it. What is told of the motor does. f is that of quadrature counting, or of a gear: its ratio
given where the encoder is on the motor's shaft, or not given where it is behind the gear.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

#: K of a motor lies within 10 % of its datasheet (as makers say), J and B with load and friction within 40 %.
_NEAR, _SQUARE_NEAR = 0.1, 0.35
_COUNTED = (0.25, 0.5, 2.0, 4.0)
#: A gear that nobody told of turns the motor at least so many times: a smaller one cannot be told from counts.
_LEAST_GEAR = 4.5
#: A gear whose ratio is nearer to 1 (its logarithm) makes no K that is no usual one.
_TOLD_APART = 3.0 * _NEAR


def angle_hint(found: Mapping[str, float | None], nominal: Mapping[str, float], gear_ratio: float = 1.0) -> str | None:
    """In words, with the key that is probably wrong; None: the values do not show it.

    Args:
        found: values by name.
        gear_ratio: with which they were found.
    """
    ratio = {n: v / nominal[n] for n, v in found.items() if v is not None and v > 0.0 and nominal.get(n, 0.0) > 0.0}
    geared = abs(math.log(gear_ratio)) > _TOLD_APART
    if geared and _as_if(ratio, 1.0 / gear_ratio, alone=True):
        return (
            f"{_told(ratio, 1.0 / gear_ratio)} times nominal, as if the encoder were on the motor's shaft: is "
            f"gear_ratio = {gear_ratio:g} right?"
        )
    for factor in _COUNTED:
        if _as_if(ratio, factor, alone=False):
            times = f"{factor:g} times too large" if factor > 1.0 else f"{1 / factor:g} times too small"
            return (
                f"{_told(ratio, factor)} times nominal, as if the counts of a turn (counts_per_rev) were told {times}: "
                "lines, or counts after quadrature?"
            )
    turns = ratio.get("K", 1.0)
    if math.isclose(gear_ratio, 1.0) and turns > _LEAST_GEAR and _as_if(ratio, turns, alone=False):
        return (
            f"{_told(ratio, turns)} times nominal, as if the encoder were behind a gear of {turns:.3g} turns: "
            "gear_ratio in [drive.signals] says it"
        )
    return None


def _as_if(ratio: Mapping[str, float], factor: float, *, alone: bool) -> bool:
    """Whether the angle is so many times too small. K `alone` is enough, as are J and B of a drive that tells no K,
    unless J contradicts it."""
    squares = _squares(ratio, factor)
    if "K" not in ratio:
        return alone and {"J", "B"} <= set(squares)
    if abs(math.log(ratio["K"] / factor)) > _NEAR:
        return False
    return "J" in squares or (alone and "J" not in ratio)


def _squares(ratio: Mapping[str, float], factor: float) -> list[str]:
    return [n for n in ("J", "B") if n in ratio and abs(math.log(ratio[n] / factor**2)) < _SQUARE_NEAR]


def _told(ratio: Mapping[str, float], factor: float) -> str:
    names = [n for n in ("K",) if n in ratio] + _squares(ratio, factor)
    parts = [f"{name} {ratio[name]:.3g}" for name in names[1:]]
    return ", ".join([f"{names[0]} is {ratio[names[0]]:.3g}", *parts])
