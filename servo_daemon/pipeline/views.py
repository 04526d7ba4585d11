"""What is published beside the parameters: what each estimator says, the drive's own among them, state and
temperature, the filter's health."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from drivers.base import OnboardEstimates
from servo_daemon.kalman.gaussian import Gaussian, from_coordinate
from servo_daemon.plant.effects import parameter_table
from servo_daemon.published.snapshot import Estimate, EstimatorView, finite_or_none
from servo_daemon.regression.estimate import KNOWS, RegressionEstimate
from servo_daemon.samples import F64, SampleBlock
from servo_daemon.tracking.tracker import Tracker

#: A drive that has not told its estimates for so long, s, has stopped doing so.
_OLD_S = 10.0
#: Statuses of the drive's own estimates whose numbers are not to be used.
_NO_VALUE = ("starting", "invalid")
_NONE = np.empty(0)
#: Parameter -> (value, std), natural units.
Values = Mapping[str, tuple[float | None, float | None]]


class Views:
    """What is published of one drive's estimators."""

    def __init__(self) -> None:
        self._table = parameter_table()
        self._regression: tuple[RegressionEstimate, EstimatorView] | None = None  # the last one, as published

    def of(self, tracker: Tracker) -> dict[str, EstimatorView]:
        """What each estimator says by itself."""
        views = {}
        hidden = tracker.plan.biases
        if tracker.ekf is not None and tracker.ekf.started:
            views["ekf"] = EstimatorView(self._natural(tracker.ekf.estimate(), hidden), {"restarts": tracker.restarts})
        rls = tracker.rls.estimate() if tracker.rls is not None else None
        if rls is None:
            views["rls"] = EstimatorView({})
        else:
            if self._regression is None or self._regression[0] is not rls:  # it changes once a second or so
                detail = {"window_s": rls.span_s, "balances_close": rls.closes}
                self._regression = rls, EstimatorView(self.possible(rls.with_unseen, hidden), detail)
            views["rls"] = self._regression[1]
        return views

    def possible(self, e: RegressionEstimate, hidden: tuple[str, ...]) -> Values:
        """Possible values only, of positive parameters those that it knows: a negative resistance, or one that is known
        to ± 40 %, says that the regression does not know it (yet, or with balances that do not close)."""
        return {
            name: (finite_or_none(value), finite_or_none(std))
            for name, value, std in zip(e.names, e.value.tolist(), e.std.tolist(), strict=True)
            if name not in hidden
            and self._table[name].lower <= value <= self._table[name].upper
            and (self._table[name].transform != "log" or std < KNOWS * value)
        }

    def _natural(self, g: Gaussian, hidden: tuple[str, ...]) -> Values:
        pairs = (
            (name, from_coordinate(self._table[name], m, s))
            for name, m, s in zip(g.names, g.mean.tolist(), g.std.tolist(), strict=True)
            if name not in hidden
        )
        return {name: (finite_or_none(value), finite_or_none(std)) for name, (value, std) in pairs}


@dataclass(frozen=True, slots=True)
class State:
    """A drive's state after a sample, as a tracker has it.

    Attributes:
        measured: by channel.
        names, x: of the plant's states, shape (n_x,); none before the filter runs.
    """

    measured: Mapping[str, float | None]
    names: tuple[str, ...]
    x: F64

    @classmethod
    def of(cls, tracker: Tracker) -> State:
        ekf, measured = tracker.ekf, tracker.measured_state.copy()
        return (
            cls(measured, (), _NONE) if ekf is None or not ekf.started else cls(measured, ekf.plant.state_names, ekf.x)
        )

    def published(self) -> dict[str, float | None]:
        """What the filter says, else what is measured."""
        state: dict[str, float | None] = dict.fromkeys(("current_A", "velocity_rad_s", "position_rad"))
        state.update(self.measured)
        state.update(zip(self.names, self.x.tolist(), strict=True))
        return {name: finite_or_none(value) for name, value in state.items()}


@dataclass(frozen=True, slots=True)
class Moment:
    """The record after the very last sample, from which it is made when it is asked for: of most nobody does.

    Attributes:
        tick: the last tick's record, whose parameters are those of now.
        time_s, samples: of now.
        temperature_C: the last that was measured.
    """

    tick: Estimate
    time_s: float
    samples: int
    state: State
    temperature_C: float | None

    def estimate(self) -> Estimate:
        """The record."""
        now = self.tick
        if now.time_s != self.time_s:
            now = replace(now, time_s=self.time_s, samples=self.samples, state=self.state.published())
        return with_temperature(now, self.temperature_C)


def health_of(tracker: Tracker) -> dict[str, float | int | bool | str | None]:
    health: dict[str, float | int | bool | str | None] = {
        "innovation_white": tracker.explained if tracker.watch.whiteness else None,
        "gated_samples": tracker.watch.gated,
        "filter_restarts": tracker.restarts,
    }
    for name, w in tracker.watch.whiteness.items():
        channel = name.split("_")[0]
        health[f"nis_{channel}"] = finite_or_none(w.nis)
        health[f"innovation_correlation_{channel}"] = finite_or_none(w.correlation)
    return health


def last_temperature(block: SampleBlock, before: float | None) -> float | None:
    """The last finite temperature of a block, °C; without one that from before, as long as the channel is there."""
    if block.temperature_C is None:
        return None
    known = block.temperature_C[np.isfinite(block.temperature_C)]
    return float(known[-1]) if len(known) else before


def with_temperature(estimate: Estimate, temperature_C: float | None) -> Estimate:
    """With the drive's temperature in its state; where none is measured as it is."""
    if temperature_C is None or estimate.state.get("temperature_C") == temperature_C:
        return estimate
    return replace(estimate, state={**estimate.state, "temperature_C": temperature_C})


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
