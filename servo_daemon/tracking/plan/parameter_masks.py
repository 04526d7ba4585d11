"""Which of the plant's parameters are estimated, published, in a regression; as masks in the plant's order."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from servo_daemon.kalman.gaussian import natural_values
from servo_daemon.parameters import Parameter
from servo_daemon.regression.sampling import settles_between
from servo_daemon.samples import F64
from servo_daemon.tracking.plan.settings import TrackerSettings
from servo_daemon.tracking.plan.signals import SignalPlan

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class ParameterMasks:
    """Masks over the plant's parameters, shape (n,) each.

    Attributes:
        parameters: the plant's.
        published: estimated and published.
        biases: estimated and not published.
        covered: estimated, and in a regression that can judge them.
        claimable: published, and to be believed (`SignalPlan.unclaimed`).
        logarithmic: positive ones, estimated as logarithms.
        drift: 1 σ of the coordinate's random walk over its scale, 1/√s.
    """

    parameters: tuple[Parameter, ...]
    published: Mask
    biases: Mask
    covered: Mask
    claimable: Mask
    logarithmic: Mask
    drift: F64

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(p.name for p in self.parameters)

    @cached_property
    def free(self) -> Mask:
        """Parameters that the filter estimates."""
        mask: Mask = self.published | self.biases
        return mask

    @cached_property
    def _winding(self) -> tuple[int, int] | None:
        """Indices of R and L."""
        return (self.names.index("R"), self.names.index("L")) if {"R", "L"} <= set(self.names) else None

    @cached_property
    def _without_L(self) -> Mask:
        mask: Mask = self.free & np.array([name != "L" for name in self.names])
        return mask

    @cached_property
    def drift_square(self) -> F64:
        """Variance of the coordinate's random walk over its scale squared, 1/s."""
        return np.square(self.drift)

    @cached_property
    def offsets(self) -> list[int]:
        """Indices of the bias states."""
        return [int(k) for k in np.flatnonzero(self.biases)]

    def free_along_own_states(self, coordinates: F64, period_s: float) -> Mask:
        """What the filter may estimate along its own states: all but the inductance of a winding that settles between
        two samples. Of that little more than the colour of the innovations is left, and a wrong share of the noise
        between sensor and voltage colours them, too (L 26 % off at 11 σ, and 37 % at 23)."""
        if self._winding is None:
            return self.free
        R, L = (math.exp(coordinates[k]) for k in self._winding)
        return self._without_L if settles_between(R, L, period_s) else self.free

    def values(self, coordinates: F64) -> dict[str, float]:
        """Values by name in natural units."""
        return natural_values(self.parameters, coordinates)


def make_masks(plan: SignalPlan, settings: TrackerSettings, in_regression: tuple[str, ...]) -> ParameterMasks:
    """Masks of a plan that has a plant."""
    assert plan.plant is not None
    names = plan.plant.parameter_names
    published = np.array([n in plan.free for n in names])
    biases = np.array([n in plan.biases for n in names])
    return ParameterMasks(
        parameters=plan.plant.parameters,
        published=published,
        biases=biases,
        covered=np.array([n in in_regression for n in names]) & (published | biases),
        claimable=np.array([n not in plan.unclaimed for n in names]),
        logarithmic=np.array([p.transform == "log" for p in plan.plant.parameters]),
        drift=np.array([settings.drift_of(n, offset=n in plan.biases) for n in names]),
    )
