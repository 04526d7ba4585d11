"""Motors to calibrate with, drawn from what datasheets of four classes offer; none is one of the generator's own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tests.recovery.generator import Motor

#: Seeds of everything here; the matrix draws its own from others, and what a test names is smaller.
SEEDS = range(2**42, 2**43)


@dataclass(frozen=True, slots=True)
class _Class:
    """Ranges, each drawn evenly in its logarithm; supply and encoder as such drives have them.

    Attributes:
        R, L, K: Ω, H, N·m/A.
        time_constant_s: mechanical, with the load: J follows from it.
        viscous: B over K²/R, how much of the braking at constant voltage is friction.
        rated_share: rated current over supply/R, the current at standstill.
    """

    R: tuple[float, float]
    L: tuple[float, float]
    K: tuple[float, float]
    time_constant_s: tuple[float, float]
    viscous: tuple[float, float]
    rated_share: tuple[float, float]
    supply_V: tuple[float, ...]
    counts_per_rev: tuple[float, ...]


#: Ranges as in manufacturers' catalogues for such motors, rounded; loads and friction are ours.
CLASSES: Mapping[str, _Class] = {
    "coreless": _Class(  # 10 to 30 W, 16 to 25 mm
        (2.5, 12.0), (0.1e-3, 0.9e-3), (9e-3, 40e-3), (0.012, 0.05), (0.005, 0.06), (0.10, 0.2), (12.0, 18.0), (2000.0,)
    ),
    "brushed": _Class(  # 100 to 400 W, 57 to 83 mm
        (0.3, 1.6), (0.6e-3, 3e-3), (45e-3, 140e-3), (0.02, 0.08), (0.005, 0.05), (0.10, 0.2), (36.0, 60.0), (8000.0,)
    ),
    "geared": _Class(  # behind a planetary gear, seen at its output
        (0.8, 3.5),
        (0.4e-3, 2.5e-3),
        (0.45, 1.0),
        (0.015, 0.06),
        (0.02, 0.12),
        (0.12, 0.22),
        (24.0,),
        (12000.0, 24000.0),
    ),
    "direct": _Class(  # a torque motor without a gear
        (1.2, 6.0), (3e-3, 12e-3), (1.6, 4.5), (0.02, 0.06), (0.005, 0.04), (0.12, 0.25), (48.0, 80.0), (40000.0,)
    ),
}


def motor(number: int) -> Motor:
    """The classes in turn, each time another one; the same number is the same motor."""
    name = list(CLASSES)[number % len(CLASSES)]
    ranges, rng = CLASSES[name], np.random.default_rng([SEEDS.start, number])

    def draw(span: tuple[float, float]) -> float:
        return float(np.exp(rng.uniform(*np.log(span))))

    R, L, K = draw(ranges.R), draw(ranges.L), draw(ranges.K)
    B = draw(ranges.viscous) * K**2 / R
    supply = float(rng.choice(ranges.supply_V))
    rated = draw(ranges.rated_share) * supply / R
    return Motor(
        name=f"{name}-{number}",
        R=R,
        L=L,
        K=K,
        J=draw(ranges.time_constant_s) * (R * B + K**2) / R,
        B=B,
        supply_V=supply,
        rated_current_A=rated,
        current_limit_A=2.8 * rated,
        counts_per_rev=float(rng.choice(ranges.counts_per_rev)),
        source="drawn from the ranges of its class",
    )
