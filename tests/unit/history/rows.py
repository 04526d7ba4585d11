"""Rows with everything in them: noise, gaps, a parameter that is not known at first."""

from __future__ import annotations

import numpy as np

from servo_daemon.published.buckets import STATUSES, Buckets

T0 = 1_795_262_400.0


def make_rows(
    seconds: float = 60.0, begin_s: float = 0.0, names: tuple[str, ...] = ("R", "K", "current_A"), seed: int = 1
) -> Buckets:
    """Ten a second from T0 + begin_s on."""
    rng = np.random.default_rng(seed)
    n = round(10 * seconds)
    kinds = [not name.endswith("_A") for name in names]
    value = 0.5 + 0.01 * rng.normal(size=(n, len(names)))
    value[rng.random(value.shape) < 0.05] = np.nan
    std = np.where(kinds, 0.01 * rng.uniform(0.5, 2.0, value.shape), np.nan)
    code = np.where(kinds, STATUSES.index("tracking") + 1, 0) * np.ones((n, 1), int)
    code[: n // 4, 0] = STATUSES.index("estimating") + 1
    time_s = T0 + begin_s + np.arange(n) / 10.0
    return Buckets.of_rows(time_s, names, ["Ω"] * len(names), kinds, value, std, code.astype(np.int8))
