"""From published records to what tuning needs: the motor as it is known, and the loop around it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from servo_daemon.errors import TuningError
from servo_daemon.parameters import KNOWN, LINEAR
from servo_daemon.plant.effects.winding_heating import ALPHA_COPPER_1_K
from servo_daemon.published.snapshot import Covariance, ParameterEstimate
from servo_daemon.samples import F64
from servo_daemon.tuning.knowledge import (
    NEEDED,
    Ask,
    CascadeGains,
    Known,
    LoopSetup,
    MarginLimits,
    MotorKnowledge,
    Source,
)


@dataclass(frozen=True, slots=True)
class LoopFacts:
    """What configuration and driver say of a drive's loop. None: not known.

    Attributes:
        rate_hz: of the controller; None: it runs at the rate of the samples.
        nominal: parameters by name, SI units.
    """

    ask: Ask = field(default_factory=Ask)
    in_use: CascadeGains | None = None
    rate_hz: float | None = None
    delay_samples: float = 1.0
    filter_hz: float | None = None
    limits: MarginLimits = field(default_factory=MarginLimits)
    voltage_V: float | None = None
    counts_per_rev: float | None = None
    nominal: Mapping[str, float] = field(default_factory=dict)

    def setup(self, sample_rate_hz: float | None) -> LoopSetup:
        """The loop at the configured rate, else that of the samples.

        Raises:
            TuningError: neither is known.
        """
        rate = self.rate_hz or sample_rate_hz
        if not rate:
            raise TuningError(
                "the loop's sample rate is not known: no samples yet, and no rate_hz in [drive.controller]"
            )
        return LoopSetup(
            rate_hz=rate,
            rate_source="configured" if self.rate_hz else "measured",
            delay_samples=self.delay_samples,
            in_use=self.in_use,
            filter_hz=self.filter_hz,
            limits=self.limits,
            voltage_V=self.voltage_V,
            counts_per_rev=self.counts_per_rev,
        )

    @property
    def log_nominal(self) -> F64 | None:
        """Logarithms of the nominal R, L, K, J, B, shape (5,); None where one is missing."""
        if any(name not in self.nominal for name in NEEDED):
            return None
        return np.log([self.nominal[name] for name in NEEDED])


def motor_knowledge(
    parameters: Sequence[ParameterEstimate],
    covariance: Covariance | None,
    effects: tuple[str, ...],
    state: Mapping[str, float | None],
    source: Source = "estimate",
    fixed: Mapping[str, float] | None = None,
) -> MotorKnowledge:
    """The motor from a published estimate.

    Args:
        parameters, covariance, effects, state: as published.
        source: what an estimated value is called.
        fixed: values that the user gave; they win.

    Raises:
        TuningError: R, L, K, J or B is neither estimated nor nominal nor fixed; the text says why not.
    """
    published = {p.name: p for p in parameters}
    found: dict[str, Known] = {}
    missing: dict[str | None, list[str]] = {}  # by reason
    for name in NEEDED:
        known = _known(name, published.get(name), source, fixed or {})
        if known is None:
            p = published.get(name)
            missing.setdefault(None if p is None else p.reason, []).append(name)
        else:
            found[name] = known
    if missing:
        told = ", ".join(", ".join(n) + (f" ({why})" if why else "") for why, n in missing.items())
        raise TuningError(f"no gains without {told}: neither estimated, nor nominal, nor given")
    names, values = _joint(covariance, {n for n, k in found.items() if k.source == source and k.std is not None})
    return MotorKnowledge(
        parameters=_warm(found, effects, state),
        uncertain=names,
        covariance=values,
        effects=effects,
        extras={p.name: p.value for p in parameters if p.name not in NEEDED and p.value is not None},
    )


def _known(name: str, p: ParameterEstimate | None, source: Source, fixed: Mapping[str, float]) -> Known | None:
    if name in fixed:
        return Known(fixed[name], "fixed")
    if p is None:
        return None
    if p.status in KNOWN and p.value is not None and p.value > 0:
        return Known(p.value, source, p.std, p.reason)
    if p.nominal is not None and p.nominal > 0:
        return Known(p.nominal, "nominal", None, None if p.reason is None else f"{p.status}: {p.reason}")
    return None


def _joint(covariance: Covariance | None, wanted: set[str]) -> tuple[tuple[str, ...], F64]:
    """The part of the covariance that is of `wanted`, in the order of `NEEDED`."""
    if covariance is None:
        return (), np.zeros((0, 0))
    names = tuple(p.name for p in LINEAR if p.name in wanted and p.name in covariance.names)
    rows = [covariance.names.index(name) for name in names]
    return names, np.array(covariance.values)[np.ix_(rows, rows)]


def _warm(found: dict[str, Known], effects: tuple[str, ...], state: Mapping[str, float | None]) -> dict[str, Known]:
    """With `winding_heating` in the model R is the cold value, and the loop has the warm one."""
    rise = state.get("winding_rise_K")
    cold = found["R"]
    if "winding_heating" not in effects or rise is None or cold.source in ("nominal", "fixed"):
        return found
    factor = 1.0 + ALPHA_COPPER_1_K * rise
    std = None if cold.std is None else cold.std * factor
    return {
        **found,
        "R": Known(cold.value * factor, cold.source, std, f"warm by {rise:.0f} K, cold {cold.value:.4g} Ω"),
    }
