"""Between configuration, estimators and the published records: conversions only."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np

from drivers.base import DriveInfo
from servo_daemon.config import DriveConfig
from servo_daemon.kalman.gaussian import Gaussian, from_coordinate
from servo_daemon.parameters import J_D, KNOWN, LINEAR, Parameter
from servo_daemon.pipeline.refresher import Refresher
from servo_daemon.pipeline.views import State, Views, health_of
from servo_daemon.plant.effects import effects_by_name, parameter_table
from servo_daemon.published.snapshot import Covariance, Estimate, ParameterEstimate, finite_or_none
from servo_daemon.regression.columns.terms import waves_per_turn
from servo_daemon.signal_meaning import SignalMeaning
from servo_daemon.tracking.plan.settings import Resolutions, TrackerSettings
from servo_daemon.tracking.plant_tracker import PlantTracker
from servo_daemon.tracking.tracker import Tracker
from servo_daemon.tracking.validity import excitation
from servo_daemon.tracking.validity.fusion import Fused, as_last_known, fuse


@dataclass(frozen=True, slots=True)
class Adopted:
    """A model that was adopted while the daemon ran, against what the configuration says.

    Attributes:
        configured: the configuration's own model then.
        nominal: values of the effects' parameters that came with it.
    """

    configured: tuple[str, ...]
    nominal: Mapping[str, float]

    @classmethod
    def of(cls, config: DriveConfig, active: DriveConfig) -> Adopted | None:
        """Of a drive whose configuration is `config`; None where it has the model that this says."""
        if active.model == config.model and active.nominal == config.nominal:
            return None
        return cls(config.model, {k: v for k, v in active.nominal.items() if config.nominal.get(k) != v})

    def configure(self, config: DriveConfig, model: tuple[str, ...]) -> DriveConfig:
        """The drive's configuration with the adopted model."""
        return config.model_copy(update={"model": model, "nominal": {**config.nominal, **self.nominal}})


@dataclass(frozen=True, slots=True)
class SavedState:
    """What survives a restart of the daemon: coordinates and covariance of the qualified parameters, and an adopted
    model."""

    model: tuple[str, ...]
    names: tuple[str, ...]
    mean: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]
    adopted: Adopted | None = None


def tracker_settings(config: DriveConfig) -> TrackerSettings:
    """What the tracker needs of a drive's configuration."""
    drift = {name: value for name in config.drift if (value := config.drift_per_sqrt_s(name)) is not None}
    return TrackerSettings(config.model, config.nominal, drift, config.estimation.engine)


def resolutions(config: DriveConfig, info: DriveInfo | None) -> Resolutions:
    """Least significant bits, from the driver or, for the encoder, from the configuration."""
    counts = config.load.counts_per_rev or (info.counts_per_rev if info is not None else None)
    position = 2 * math.pi / counts if counts else None
    if info is None:
        return Resolutions(position_rad=position)
    return Resolutions(position, info.current_lsb_A, info.voltage_lsb_V)


def prior(config: DriveConfig, saved: SavedState | None) -> Gaussian | None:
    """A saved state as the filter's start, if it is of this model."""
    if saved is None or saved.model != config.model or not saved.names:
        return None
    return Gaussian(saved.names, np.array(saved.mean), np.array(saved.covariance))


def published_parameters(config: DriveConfig) -> tuple[Parameter, ...]:
    """The linear motor's parameters, then the effects' own, each once."""
    table = {p.name: p for p in LINEAR}
    for name in config.model:
        for p in effects_by_name()[name].parameters:
            table.setdefault(p.name, p)
    return tuple(table.values())


def published_names(config: DriveConfig) -> tuple[str, ...]:
    """Names of everything published, J_d last where it is."""
    return (*(p.name for p in published_parameters(config)), *((J_D.name,) if "J_m" in config.nominal else ()))


class Publisher:
    """Makes one drive's records. What the configuration alone decides is looked up once.

    Args:
        config: the drive's.
    """

    def __init__(self, config: DriveConfig) -> None:
        self._config = config
        self._parameters = published_parameters(config)
        self._table = parameter_table()
        self._views = Views()

    def estimate(self, tracker: Tracker, samples: int, refresher: Refresher | None = None) -> Estimate:
        """The published record of this moment."""
        gaussian = tracker.published()
        filtered = self._fused(tracker, gaussian)
        fused = self._refreshed(filtered, tracker, refresher)
        parameters = self._parameter_estimates(fused)
        learned = {p.name for p, f, g in zip(self._parameters, filtered, fused, strict=True) if f is not g}
        assert tracker.last_s is not None
        period = tracker.sample_period_s
        return Estimate(
            time_s=tracker.last_s,
            samples=samples,
            sample_rate_hz=None if not period else finite_or_none(1.0 / period),
            model=self._config.model,
            parameters=parameters,
            state=State.of(tracker).published(),
            estimators=self._views.of(tracker) | ({} if refresher is None else {"grnn": refresher.view}),
            health=health_of(tracker),
            covariance=self._covariance(tracker, gaussian, parameters, learned),
        )

    def _refreshed(self, filtered: list[Fused], tracker: Tracker, refresher: Refresher | None) -> list[Fused]:
        if refresher is None or tracker.last_s is None:
            return filtered
        now_s = tracker.last_s
        return [refresher.instead_of(p.name, f, now_s) for p, f in zip(self._parameters, filtered, strict=True)]

    def _parameter_estimates(self, fused: list[Fused]) -> tuple[ParameterEstimate, ...]:
        nominal = self._config.nominal
        out = [
            ParameterEstimate(
                p.name,
                finite_or_none(f.value),
                finite_or_none(f.std),
                p.unit,
                nominal.get(p.name),
                f.status,
                f.reason,
                finite_or_none(f.age_s),
            )
            for p, f in zip(self._parameters, fused, strict=True)
        ]
        if "J_m" in nominal:
            out.append(_load_inertia(self._config, next(p for p in out if p.name == "J")))
        return tuple(out)

    def _fused(self, tracker: Tracker, g: Gaussian | None) -> list[Fused]:
        """Of each of `_parameters`."""
        known = {} if g is None else {n: k for k, n in enumerate(g.names)}
        mean, std = ([], []) if g is None else (g.mean.tolist(), g.std.tolist())
        excited: list[bool] = []
        qualified: list[bool] = []
        ages_s = tracker.ages_s
        if isinstance(tracker, PlantTracker):
            excited, qualified = tracker.excitation.excited.tolist(), tracker.qualification.qualified.tolist()
        out = []
        for p in self._parameters:
            nominal = self._config.nominal.get(p.name)
            if p.name not in tracker.plan.free:
                why = tracker.plan.reasons.get(p.name, f"{p.name} is not visible in these signals")
                taken = tracker.plan.held.get(p.name, nominal)  # what the filter runs with, whoever chose it
                out.append(Fused(taken, None, "fixed" if taken is not None else "estimating", why))
            elif g is None:
                out.append(self._before_the_filter(p, tracker, nominal))
            else:
                k = known[p.name]
                floor = self._floor(p.name, g, tracker)
                last = None if qualified[k] else tracker.last_known(p.name)
                if last is None:
                    open_ = tracker.qualification.why_not(p.name) if isinstance(tracker, PlantTracker) else None
                    found = fuse(p, mean[k], std[k], excited[k], qualified[k], nominal, floor, open_)
                    if qualified[k]:
                        found = replace(found, age_s=ages_s[k])
                    unclaimed = tracker.plan.unclaimed.get(p.name)
                    out.append(found if unclaimed is None else replace(found, reason=unclaimed))
                    continue
                why = "the data no longer confirm a value" if excited[k] else excitation.reason(p.name)
                hold_s = self._config.estimation.hold_s
                out.append(as_last_known(p, last, why, (mean[k], std[k]), floor, hold_s))
        return out

    def _covariance(
        self, tracker: Tracker, g: Gaussian | None, parameters: tuple[ParameterEstimate, ...], learned: Collection[str]
    ) -> Covariance | None:
        """Of what is known, as published: with what unknown skew leaves open of L; None before the filter runs.

        Args:
            learned: parameters whose value is not the filter's.
        """
        if g is None or not isinstance(tracker, PlantTracker):
            return None
        known = {p.name: p for p in parameters if p.status in KNOWN and p.name in g.names}
        if not known:
            return None
        rows, covariance = [g.names.index(name) for name in known], g.covariance.tolist()
        own = [q and n not in learned for n, q in zip(g.names, tracker.qualification.qualified.tolist(), strict=True)]
        values = [[covariance[a][b] if a == b or (own[a] and own[b]) else 0.0 for b in rows] for a in rows]
        for k, p in enumerate(known.values()):
            if not own[rows[k]]:  # as it was last known: its error has to do with nobody's of now
                values[k][k] = self._coordinate_var(p)
            elif floor := self._floor(p.name, g, tracker):
                scale = self._value(p.name, g) if self._table[p.name].transform == "log" else 1.0
                values[k][k] += (floor / scale) ** 2
        if not all(math.isfinite(value) for row in values for value in row):
            return None
        return Covariance(tuple(known), tuple(map(tuple, values)))

    def _coordinate_var(self, p: ParameterEstimate) -> float:
        """Of a published parameter."""
        scale = p.value if self._table[p.name].transform == "log" else 1.0
        return ((p.std or 0.0) / (scale or 1.0)) ** 2

    def _floor(self, name: str, g: Gaussian, tracker: Tracker) -> float:
        """1 σ in the parameter's unit that no amount of data removes."""
        if name == "L":
            # Unknown skew of current and voltage sampling: a delay δ looks like an inductance δ·R.
            return self._config.estimation.skew_s * self._value("R", g)
        return 0.5 * tracker.position_lsb_rad * waves_per_turn(name, tracker.plan.held)

    def _before_the_filter(self, p: Parameter, tracker: Tracker, nominal: float | None) -> Fused:
        """A free parameter while no filter runs: at the start, while it starts again, and of a shaft that is held."""
        last = tracker.last_known(p.name)
        if last is not None:
            return as_last_known(p, last, "the filter is starting again")
        winding = tracker.winding
        if winding is None:
            text = "the shaft has not moved yet" if tracker.stands else "collecting the first samples"
            return Fused(nominal, None, "estimating", text)
        known = {n: v for n, v in self._views.possible(winding, tracker.plan.biases).items() if n in ("R", "L")}
        value, std = known.get(p.name, (None, None))
        if value is None or std is None:
            return Fused(nominal, None, "estimating", "the motion does not show it (is the shaft held?)")
        if (why := tracker.plan.unclaimed.get(p.name)) is not None:
            return Fused(nominal, None, "estimating", why)
        R = float(winding.value[winding.names.index("R")])
        floor = self._config.estimation.skew_s * R if p.name == "L" else 0.0
        return Fused(value, math.hypot(std, floor), "tracking", None, 0.0)

    def _value(self, name: str, g: Gaussian) -> float:
        return from_coordinate(self._table[name], float(g.mean[g.names.index(name)]), 0.0)[0]


def with_equivalents(estimate: Estimate, meaning: SignalMeaning) -> Estimate:
    """With R, L and K of the other DC motors that stand for a drive of dq values."""
    by_choice = meaning.equivalents()
    if not by_choice:
        return estimate
    own = {p.name: p for p in estimate.parameters}

    def times(value: float | None, factor: float) -> float | None:
        return None if value is None else value * factor

    equivalents = {
        choice: {n: (times(own[n].value, f), times(own[n].std, f)) for n, f in factors.items()}
        for choice, factors in by_choice.items()
    }
    return replace(estimate, equivalents=equivalents)


def _load_inertia(config: DriveConfig, J: ParameterEstimate) -> ParameterEstimate:
    """J_d = J − J_m."""
    J_m = config.nominal["J_m"]
    nominal = None if J.nominal is None else J.nominal - J_m
    value = None if J.value is None else J.value - J_m
    return ParameterEstimate(J_D.name, value, J.std, J_D.unit, nominal, J.status, J.reason, J.age_s)
