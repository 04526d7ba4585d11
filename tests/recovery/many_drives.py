"""Captures of drives of one type: each motor drawn around one, with few seconds of operation each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.recovery.generator import RE40, EffectValues, Motor, Scenario, generate

#: Standard deviations of the logarithms between drives: windings and magnets within some per cent (as their makers'
#: tolerances are), friction by much more.
SPREAD: Mapping[str, float] = {"R": 0.05, "L": 0.08, "K": 0.03, "J": 0.02, "B": 0.2}


def draw(number: int, seed: int = 0, motor: Motor = RE40) -> Motor:
    """One drive of the type."""
    rng = np.random.default_rng([seed, number])
    return replace(motor, **{k: getattr(motor, k) * float(np.exp(rng.normal() * s)) for k, s in SPREAD.items()})


def record(
    path: Path,
    motor: Motor,
    *,
    seconds: float = 2.0,
    motion: str = "multisine",
    seed: int = 0,
    effects: Mapping[str, EffectValues] | None = None,
) -> None:
    """One capture of a drive, as CSV."""
    path.parent.mkdir(parents=True, exist_ok=True)
    generate(motor, Scenario(motion, seconds=seconds, seed=seed, effects=effects or {})).write_csv(path)
