"""A drive whose voltage is a measurement, live: R, L and K by regression on its balance, the rest by the filter.

The filter is driven by the measured current, and needs a K for its torques: the regression's first one. Every torque is
K times a current, so what it finds is scaled by what the regression says now over what it was given then, exactly.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from servo_daemon.conditioning.current_moment import earlier
from servo_daemon.config import DriveConfig
from servo_daemon.parameters import KNOWN, WINDING_NAMES, Status
from servo_daemon.pipeline.link.torques import is_torque, motion_std
from servo_daemon.plant.effects import parameter_table
from servo_daemon.published.snapshot import Covariance, Estimate, EstimatorView, ParameterEstimate
from servo_daemon.regression.winding.estimate import (
    WINDOWS_S,
    WindingEstimate,
    as_meant,
    estimate_winding,
)
from servo_daemon.regression.winding.rows import FINE, RESOLVED, Rows, joined, unresolved, winding_rows
from servo_daemon.samples import F64, Quality, SampleBlock, concatenate
from servo_daemon.signal_meaning import SignalMeaning
from servo_daemon.tracking.noise.watch import WHITE_OUT

#: How far back the regression looks, s: a winding warms up by a few per cent in a minute (chosen; not tried).
_SPAN_S = 20.0
#: Device time from one estimate to the next, s, and how often all lengths of windows are tried.
_EVERY_S, _ALL_LENGTHS_EVERY = 1.0, 10
#: Fewest seconds of samples from which anything is published (chosen; not tried).
_LEAST_S = 3.0
#: Samples at most so many of the control's steps apart show nearly all that the current does, however much it changes:
#: what is left, as a share (`unresolved`), is worth so much of every torque, 1 σ. (Servos of benchmarks/drives.py with
#: steps of 1 ms: at 500 Hz J is 0.6 and 2.4 % off at shares of 0.24 and 0.25; at 100 Hz 10 and 30 %. Three others, on
#: which nothing was chosen: 1.6, 3.2 and 1.9 % at 0.24, 0.28 and 0.21, a tenth of the share rms.)
_STEPS_SEEN, _UNSEEN_STD = 2.5, 0.1
#: A K that is known so well, 1 σ, is good enough for the filter to begin with (chosen; not tried).
_TO_BEGIN = 0.1


@dataclass(frozen=True, slots=True)
class _Known:
    """A parameter when it was last determined."""

    value: float
    std: float
    time_s: float


@dataclass(slots=True)
class MeasuredLink:
    """R, L and K of one drive whose voltage is measured; fed ticks, as the tracker is.

    Args:
        config: the drive's.
        meaning: of its signals; `converted` has gone over the samples.

    Attributes:
        K: with which the filter runs; None: not known yet.
    """

    config: DriveConfig
    meaning: SignalMeaning
    K: float | None = None
    _rows: deque[Rows] = field(default_factory=deque)
    _tail: SampleBlock | None = None  # the last samples, whose rows need those after them
    _before: SampleBlock | None = None  # the last sample that the filter was given
    _estimate: WindingEstimate | None = None
    _known: dict[str, _Known] = field(default_factory=dict)
    _due_s: float = -math.inf
    _count: int = 0
    _end_s: float = 0.0
    _unresolved: float = 0.0

    def __post_init__(self) -> None:
        self.K = self.config.nominal.get("K")

    def filter_config(self, config: DriveConfig) -> DriveConfig:
        """The drive's with the K that its filter runs with."""
        K = {} if self.K is None else {"K": self.K}
        return config.model_copy(update={"nominal": {**config.nominal, **K}})

    def driven(self, block: SampleBlock) -> SampleBlock:
        """The samples as the filter takes them: without the voltage, their motion of the current's moment."""
        late_s = self.meaning.current_late_s
        if not late_s:
            return replace(block, voltage_V=None)
        before = self._before
        if before is not None and (before.channels != block.channels or block.quality[0] & Quality.TIME_RESTART):
            before = None
        self._before = block.slice(len(block) - 1, len(block))
        return replace(_earlier(block, before, late_s), voltage_V=None)

    def close_tick(self, tick: SampleBlock) -> bool:
        """Take a tick's samples, in a DC motor's units. Returns whether K has become known."""
        self._end_s = float(tick.time_s[-1])
        if self._tail is not None and (self._tail.channels != tick.channels or tick.quality[0] & Quality.TIME_RESTART):
            self._tail = None
        whole = tick if self._tail is None else concatenate([self._tail, tick])
        rows = winding_rows(whole, self.meaning)
        keep = 2 * FINE + self.meaning.of_means
        self._tail = whole.slice(max(0, len(whole) - keep), len(whole))
        if rows is not None and len(rows.time_s):
            self._rows.append(rows)
        while self._rows and self._end_s - float(self._rows[0].time_s[-1]) > _SPAN_S:
            self._rows.popleft()
        if self._end_s < self._due_s or not self._rows:
            return False
        self._due_s = self._end_s + _EVERY_S
        self._look()
        first = self.K is None and "K" in self._known
        if first and self._known["K"].std < _TO_BEGIN * self._known["K"].value:
            self.K = self._known["K"].value
            return True
        return False

    def _look(self) -> None:
        rows = joined(tuple(self._rows))
        if rows.time_s[-1] - rows.time_s[0] < _LEAST_S:
            return
        self._unresolved = 0.0 if self.meaning.current == "mean" else unresolved([rows])
        every = self._count % _ALL_LENGTHS_EVERY == 0 or self._estimate is None
        self._count += 1
        lengths = WINDOWS_S if every or self._estimate is None else (self._estimate.window_s,)
        found = estimate_winding([rows], windows_s=lengths)
        if found is not None:
            found = as_meant(found, self.meaning, rows.step_s)
        self._estimate = found
        for name in found.names if found is not None else ():
            pair = found.of(name) if found is not None else None
            if pair is not None:
                self._known[name] = _Known(*pair, self._end_s)

    @property
    def link(self) -> str:
        """What there is to say of it in a reason."""
        rate = f" at {1.0 / self._period_s:.0f} Hz" if self._period_s > 0.0 else ""
        return f"the voltage of this drive is {self.meaning.words}{rate}"

    def instead(self, estimate: Estimate) -> Estimate:
        """The record with R, L and K from the winding's balance, and all torques by its K."""
        own = {name: self._parameter(name, estimate) for name in WINDING_NAMES}
        scale, K_std = self._scale()
        # White by raised process noise alone is no reproach here: a current in coarse steps is such a noise, and the
        # filter's standard deviations hold it. Nor is noise that is set too large for most of the time.
        white = all(
            isinstance(value, float) and value < WHITE_OUT
            for name, value in estimate.health.items()
            if name.startswith("innovation_correlation")
        )
        parameters = tuple(
            own[p.name] if p.name in own else self._motion(p, scale, K_std, white=white) for p in estimate.parameters
        )
        regression = EstimatorView({n: (k.value, k.std) for n, k in self._known.items() if n in WINDING_NAMES})
        views = dict(estimate.estimators)
        views["rls"] = replace(
            views.get("rls", regression),
            parameters={**_scaled(views.get("rls", EstimatorView({})).parameters, scale), **regression.parameters},
        )
        if "ekf" in views:
            views["ekf"] = replace(views["ekf"], parameters=_scaled(views["ekf"].parameters, scale))
        covariance = self._covariance(estimate, parameters, scale)
        return replace(estimate, parameters=parameters, estimators=views, covariance=covariance)

    def _scale(self) -> tuple[float, float]:
        """K now over the filter's, and the relative 1 σ that every torque has of it and of the sampling."""
        K = self._known.get("K")
        if K is None or self.K is None:
            return 1.0, 0.0
        unseen = _UNSEEN_STD * self._unresolved * self._sees_steps
        return K.value / self.K, math.hypot(K.std / K.value, motion_std(self._period_s), unseen)

    @property
    def _period_s(self) -> float:
        return self._rows[-1].step_s if self._rows else 0.0

    @property
    def _sees_steps(self) -> bool:
        """Whether the samples come nearly as often as the control's steps."""
        return self._period_s <= _STEPS_SEEN * self.meaning.control_period_s

    def _parameter(self, name: str, estimate: Estimate) -> ParameterEstimate:
        old = next(p for p in estimate.parameters if p.name == name)
        known = self._known.get(name)
        if known is None:
            why = f"{self.link}: its balance does not determine {name}"
            return replace(old, value=old.nominal, std=None, status="estimating", reason=why, age_s=None)
        age_s = max(0.0, self._end_s - known.time_s)
        fresh = self._estimate is not None and name in self._estimate.names
        silent = None if fresh else f"{self.link}: its balance says nothing of {name} now"
        status: Status = "tracking" if fresh else "unexcited"
        return replace(old, value=known.value, std=known.std, status=status, reason=silent, age_s=age_s)

    def _motion(self, p: ParameterEstimate, scale: float, K_std: float, *, white: bool) -> ParameterEstimate:
        unknown = self.K is None and is_torque(p.name) and p.status == "estimating"
        if "K" not in self._known and (p.status == "tracking" or unknown):
            why = f"{self.link}: its balance does not determine K, without which no torque is known"
            return replace(p, status="estimating", reason=why)
        if is_torque(p.name) and p.value is not None:
            std = None if p.std is None else scale * math.hypot(p.std, p.value * K_std)
            p = replace(p, value=scale * p.value, std=std)
        why = "" if white else "innovations are not white"
        if self._unresolved > RESOLVED and not self._sees_steps:
            why = "its current changes too much from one sample to the next"
        if p.status == "tracking" and why:
            return replace(p, status="estimating", reason=f"{self.link}: {why}")
        return p

    def _covariance(
        self, estimate: Estimate, parameters: tuple[ParameterEstimate, ...], scale: float
    ) -> Covariance | None:
        """Of all that is known: the filter's, with K's error in every torque, and the winding's."""
        table = parameter_table()
        old = estimate.covariance
        inner = old.names if old is not None else ()
        known = {p.name: p for p in parameters if p.status in KNOWN and p.std is not None}
        motion = [n for n in inner if n in known and n not in WINDING_NAMES]
        winding = [n for n in WINDING_NAMES if n in known]
        names = (*winding, *motion)
        if not names:
            return None
        C = np.zeros((len(names), len(names)))
        W = self._winding_covariance(winding)
        C[: len(winding), : len(winding)] = W
        size = np.array([1.0 if table[n].transform == "log" else scale if is_torque(n) else 1.0 for n in motion])
        if old is not None and motion:
            at = [old.names.index(n) for n in motion]
            C[len(winding) :, len(winding) :] = np.array(old.values)[np.ix_(at, at)] * np.outer(size, size)
        if "K" in winding and motion:
            k = winding.index("K")
            values = [1.0 if table[n].transform == "log" else known[n].value or 0.0 for n in motion]
            slope = np.array([v * is_torque(n) for n, v in zip(motion, values, strict=True)])
            C[len(winding) :, len(winding) :] += np.outer(slope, slope) * W[k, k]
            C[len(winding) :, len(winding) :] += np.diag(np.square(slope) * max(self._scale()[1] ** 2 - W[k, k], 0.0))
            C[len(winding) :, : len(winding)] = np.outer(slope, W[k])
            C[: len(winding), len(winding) :] = np.outer(W[k], slope)
        return Covariance(names, tuple(map(tuple, C.tolist()))) if np.isfinite(C).all() else None

    def _winding_covariance(self, names: list[str]) -> F64:
        """Relative, shape (n, n)."""
        e = self._estimate
        if e is not None and all(n in e.names for n in names):
            at = [e.names.index(n) for n in names]
            return e.covariance[np.ix_(at, at)] / np.outer(e.value[at], e.value[at])
        return np.diag([(self._known[n].std / self._known[n].value) ** 2 for n in names])


def _earlier(block: SampleBlock, before: SampleBlock | None, by_s: float) -> SampleBlock:
    """Position and speed as they were a while before each sample, on the line from the sample before it. The first one
    of all stays: how samples are cut into blocks must not show."""
    whole = block if before is None else concatenate([before, block])
    moved: dict[str, Any] = {
        name: earlier(whole.time_s, values, by_s)[len(whole) - len(block) :]
        for name in ("position_rad", "velocity_rad_s")
        if (values := getattr(whole, name)) is not None
    }
    return replace(block, **moved)


def _scaled(
    values: Mapping[str, tuple[float | None, float | None]], scale: float
) -> dict[str, tuple[float | None, float | None]]:
    out = {}
    for name, (value, std) in values.items():
        f = scale if is_torque(name) else 1.0
        out[name] = (None if value is None else value * f, None if std is None else std * f)
    return out
