"""What the drive estimates itself, beside the daemon's own estimators."""

from __future__ import annotations

from dataclasses import replace

from drivers.base import OnboardEstimates
from servo_daemon.published.snapshot import Estimate, EstimatorView

#: A drive that has not told its estimates for so long, s, has stopped doing so.
_OLD_S = 10.0
#: Statuses whose numbers are not to be used.
_NO_VALUE = ("starting", "invalid")


def with_onboard(estimate: Estimate | None, told: OnboardEstimates | None, now_s: float) -> Estimate | None:
    """The estimate with `estimators.onboard`: of the model's parameters, none where the drive has no value yet.

    Args:
        now_s: on the monotonic clock.
    """
    if estimate is None or told is None or now_s - told.heard_s > _OLD_S:
        return estimate
    names = [p.name for p in estimate.parameters if p.name in told.values]
    values = {name: (None, None) if told.status in _NO_VALUE else told.values[name] for name in names}
    view = EstimatorView(values, {"status": told.status, "age_s": round(now_s - told.heard_s, 3)})
    return replace(estimate, estimators={**estimate.estimators, "onboard": view})
