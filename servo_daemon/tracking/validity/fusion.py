"""From what the estimators say to what is published: value, std, status and the reason in words.

RLS, EKF and GRNN see the same samples, so their errors are not independent and they are never averaged. The EKF is the
estimate; the RLS starts it, watches it and replaces it when it diverges (`pipeline/pipeline.py`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from servo_daemon.kalman.gaussian import from_coordinate
from servo_daemon.parameters import Parameter, Status, spaced
from servo_daemon.regression.estimate import KNOWS
from servo_daemon.tracking.validity import excitation
from servo_daemon.tracking.validity.gates import QUALIFIED, UNCONFIRMED

#: A held value further than so many standard deviations from the running filter's is not held any longer
#: (`test_what_the_running_filter_excludes_is_not_held` fails with half or twice as many).
EXCLUDED_STDS = 4.0
#: A regression agrees with a value within this share of it and 3 σ (see `make calibrate`).
AGREES = 0.15


@dataclass(frozen=True, slots=True)
class Fused:
    """One parameter as it will be published, in its own unit."""

    value: float | None
    std: float | None
    status: Status
    reason: str | None
    age_s: float | None = None


@dataclass(frozen=True, slots=True)
class Trusted:
    """A parameter when it was last known: its coordinate, and the 1 σ that its drift has made of it by now.

    Attributes:
        age_s: time since then.
        unconfirmed_s: how much of it the motion showed the parameter, and it was not known all the same.
    """

    coordinate: float
    std: float
    age_s: float
    unconfirmed_s: float


def confirms(found: float, found_std: float, value: float) -> bool:
    """Whether a regression's estimate speaks for the filter's: it knows the parameter, and they are not far apart. The
    filter alone, started far off on data that show little, can be sure of nonsense; a regression has no start."""
    return found_std < KNOWS * abs(found) and agrees(found, found_std, value)


def agrees(found: float, found_std: float, value: float) -> bool:
    """Whether a regression's estimate, however little it knows, does not exclude the filter's."""
    return abs(found - value) < AGREES * abs(value) + 3.0 * found_std


def fuse(
    parameter: Parameter,
    coordinate: float,
    coordinate_std: float,
    excited: bool,
    qualified: bool,
    nominal: float | None,
    floor_std: float = 0.0,
    why_not: str | None = None,
) -> Fused:
    """The published value of one free parameter, from both estimators.

    Args:
        coordinate, coordinate_std: the estimate, in the estimated coordinate.
        nominal: published while the estimate is not qualified.
        floor_std: 1 σ in the parameter's unit that no amount of data removes (sampling skew for L).
        why_not: what keeps it from being qualified, in words (`Qualification.why_not`).
    """
    value, std = from_coordinate(parameter, coordinate, coordinate_std)
    std = math.hypot(std, floor_std)
    if not math.isfinite(value) or not math.isfinite(std):
        return Fused(nominal, None, "invalid", "the filter's estimate is not a number: it is being restarted")
    if not qualified:
        why = _not_yet(parameter, value, std, why_not) if excited else excitation.reason(parameter.name)
        return Fused(nominal, None, "estimating", why)
    if value <= parameter.lower * (1 + 1e-9) or value >= parameter.upper * (1 - 1e-9):
        return Fused(value, std, "at_bound", f"at the edge of {parameter.lower:g} .. {parameter.upper:g}")
    if not excited:
        return Fused(value, std, "unexcited", excitation.reason(parameter.name))
    return Fused(value, std, "tracking", None)


def _not_yet(parameter: Parameter, value: float, std: float, why_not: str | None) -> str:
    if parameter.transform == "log" and std < QUALIFIED * value:
        return why_not or UNCONFIRMED
    return f"known to {_percent(parameter, value, std)} so far"


def as_last_known(
    parameter: Parameter,
    trusted: Trusted,
    why: str,
    present: tuple[float, float] | None = None,
    floor_std: float = 0.0,
    hold_s: float = math.inf,
) -> Fused:
    """A parameter that was known and is so no longer. It does not go back to a datasheet that it has once refuted: it
    is held at what it was, as uncertain as the present estimate. Nor is it held against the running filter, or for long
    on a motion that should show it: then there is no value.

    Args:
        why: in words.
        present: the running filter's coordinate and its 1 σ: what is held is no more certain than that.
        floor_std: as for `fuse`.
        hold_s: longest time for which it is held although the motion shows the parameter.
    """
    spread = trusted.std
    if present is not None and math.isfinite(present[1]):
        if abs(present[0] - trusted.coordinate) > EXCLUDED_STDS * math.hypot(trusted.std, present[1]):
            reason = "what was last known no longer fits the data, and the present estimate is not confirmed yet"
            return Fused(None, None, "estimating", reason, trusted.age_s)
        spread = max(spread, present[1])
    if trusted.unconfirmed_s > hold_s:
        reason = f"{why}: no value has been confirmed for longer than hold_s = {hold_s:g} s"
        return Fused(None, None, "estimating", reason, trusted.age_s)
    value, std = from_coordinate(parameter, trusted.coordinate, spread)
    return Fused(value, math.hypot(std, floor_std), "unexcited", f"held as last known: {why}", trusted.age_s)


def _percent(parameter: Parameter, value: float, std: float) -> str:
    if parameter.transform == "log":
        return f"± {100 * std / value:.0f} %"
    return f"± {std:.2g}{spaced(parameter.unit)}"
