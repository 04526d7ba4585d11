"""Settings of the estimators: the length of a tick, resolutions of the drive, and the configuration's values."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

#: Period of everything that is slower than a sample (of a calm drive several are judged together), and of the rows of
#: EST.csv, s (decision 46).
TICK_S = 0.1
#: Something to tell: kind, text, and numbers with units in their names.
Message = tuple[str, str, Mapping[str, float | int | str | None]]

#: Random walk of a parameter's coordinate when the user says nothing, 1 σ after a minute: copper follows the load,
#: magnets and bearings take their time, inertia changes with what is mounted (chosen; with twice as much the filter
#: errs no more, with half by 1.5 times as much; `drift` of the configuration says what holds for a drive).
_DRIFT_PER_SQRT_MIN = {"R": 0.03, "L": 0.006, "K": 0.01, "J": 0.015, "B": 0.03}
_DRIFT_OTHER_PER_SQRT_MIN = 0.02
#: An offset of a sensor or a hanging cable moves slowly, over its scale (decision 16).
_OFFSET_DRIFT_PER_SQRT_MIN = 0.003


@dataclass(frozen=True, slots=True)
class Resolutions:
    """Least significant bits, where they are known."""

    position_rad: float | None = None
    current_A: float | None = None
    voltage_V: float | None = None

    def of(self, name: str) -> float | None:
        return getattr(self, name, None)


@dataclass(frozen=True, slots=True)
class TrackerSettings:
    """Settings of the live estimator from the configuration.

    Attributes:
        effects: names of the effects in the model.
        nominal: given values by parameter, natural units.
        drift_per_sqrt_s: 1 σ of each coordinate's random walk over its scale, 1/√s; defaults where absent.
        engine: "compiled" or "filterpy".
        mean_current: a current as the input is the mean over the interval that ends at its sample.
    """

    effects: tuple[str, ...] = ()
    nominal: Mapping[str, float] | None = None
    drift_per_sqrt_s: Mapping[str, float] | None = None
    engine: str = "compiled"
    mean_current: bool = False

    def drift_of(self, name: str, *, offset: bool = False) -> float:
        """1 σ of this parameter's random walk over its scale, 1/√s.

        Args:
            offset: a bias state.
        """
        given = (self.drift_per_sqrt_s or {}).get(name)
        if given is not None and not offset:
            return given
        other = _OFFSET_DRIFT_PER_SQRT_MIN if offset else _DRIFT_OTHER_PER_SQRT_MIN
        return _DRIFT_PER_SQRT_MIN.get(name, other) / math.sqrt(60.0)
