"""One motion of one motor, integrated here and nowhere else, and ways to write it down as people's loggers do."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from servo_daemon.samples import F64

PERIOD_S = 2e-3
COUNTS_PER_REV = 2400
#: R (Ω), L (H), K (N·m/A), J (kg·m²), B (N·m·s/rad) of the motor.
MOTOR = {"R": 2.0, "L": 2e-3, "K": 0.05, "J": 5e-5, "B": 2e-5}


@dataclass(frozen=True)
class Motion:
    """Shape (n,) each, SI units."""

    t: F64
    v: F64
    i: F64
    x: F64
    w: F64

    @property
    def counts(self) -> F64:
        """Of the encoder."""
        return np.rint(self.x / (2 * math.pi) * COUNTS_PER_REV)


@cache
def motion(n: int = 600, seed: int = 4) -> Motion:
    """Voltage steps every 80 ms, Euler steps of a twentieth of the period."""
    rng, step = np.random.default_rng(seed), PERIOD_S / 20
    R, L, K, J, B = MOTOR.values()
    i = w = x = v = 0.0
    rows = []
    for k in range(n):
        if k % 40 == 0:
            v = float(rng.choice([-12, -8, -4, 0, 4, 8, 12]))
        rows.append((k * PERIOD_S, v, i, x, w))
        for _ in range(20):
            di, dw = (v - R * i - K * w) / L, (K * i - B * w) / J
            i, w, x = i + di * step, w + dw * step, x + w * step
    return Motion(*np.array(rows).T)


def table(
    columns: Iterable[Sequence[str] | F64],
    header: str | None,
    separator: str = ",",
    *,
    decimal: str = ".",
    end: str = "\n",
    digits: str = ".6f",
    tail: str = "",
) -> str:
    """A text table: numbers are formatted, texts are taken as they are."""
    lines = [] if header is None else [header]
    for row in zip(*columns, strict=True):
        cells = [cell if isinstance(cell, str) else format(cell, digits) for cell in row]
        lines.append(separator.join(c.replace(".", decimal) for c in cells) + tail)
    return end.join(lines) + end
