"""At the end of a search: effects that are needless, and models less one effect."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servo_daemon.diagnosis.search.evidence import needless
from servo_daemon.diagnosis.trial.compare import advantage
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.split import TRAIN
from servo_daemon.diagnosis.trial.trial import Trial, fit_trial, model_exists
from servo_daemon.plant.effects import effects_by_name


def pruned(data: Data, current: Trial, added: Sequence[str]) -> tuple[Trial, list[str]]:
    """Effects that a later one has made needless go, and what is richer than needed becomes what it contains."""
    kept = list(added)
    for name in list(added):
        for instead in ((),) * (len(added) > 1) + effects_by_name()[name].simpler:
            without = without_effect(data, current, name, instead=instead)
            if without is None or not np.isfinite(without.choice.squares).all():
                continue
            if needless(advantage(without, current)):
                kept = [k for present in kept for k in (instead if present == name else (present,))]
                current = without
                break
    return current, kept


def without_effect(
    data: Data, trial: Trial, name: str, *, instead: tuple[str, ...] = (), parts: Sequence[int] = (TRAIN,)
) -> Trial | None:
    """The model less one effect, or with simpler ones in its place, fitted anew; None: there is no such model."""
    effects = tuple(e for present in trial.effects for e in (instead if present == name else (present,)))
    if len(set(effects)) < len(effects):
        return None
    nearest = effects_by_name()[name].as_simpler(trial.values, instead)
    if nearest is None or not model_exists(effects):
        return None
    values = {**trial.values, **nearest}
    for p in (p for e in effects for p in effects_by_name()[e].parameters):
        values.setdefault(p.name, p.nominal)
    return fit_trial(data, effects, values, parts=parts, like=trial)
