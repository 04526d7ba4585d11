"""At the end of a search: effects that are needless, and models less one effect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from servo_daemon.diagnosis.search.evidence import needless, no_worse
from servo_daemon.diagnosis.trial.compare import advantage
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.split import TRAIN
from servo_daemon.diagnosis.trial.trial import Trial, fit_trial, model_exists
from servo_daemon.plant.effects import effects_by_name

#: Of the three any two make the third: a constant torque is i0 = TL/K and v0 = R TL/K, which an offset of the current
#: alone does not explain, so that a search that begins with it takes the voltage's next.
_OFFSETS = ("constant_load_torque", "current_sensor_offset", "voltage_sensor_offset")

#: Of the voltage's offset; two of any sizes and signs come so near in one of ten captures.
_BY_CHANCE = 0.2


def pruned(data: Data, current: Trial, added: Sequence[str]) -> tuple[Trial, list[str]]:
    """Effects that a later one has made needless go, two offsets become the third where it explains as much, and what
    is richer than needed becomes what it contains."""
    current, kept = one_offset(data, current, list(added))
    added = list(kept)
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


def one_offset(data: Data, current: Trial, kept: list[str]) -> tuple[Trial, list[str]]:
    """One offset for two, where that explains as much."""
    two = [name for name in kept if name in _OFFSETS]
    if len(two) < 2:
        return current, kept
    others = tuple(e for e in current.effects if e not in two)
    # The currents that the runs begin with are others, and start as measured.
    values = {"TL": 0.0, "i0": 0.0, "v0": 0.0, **current.values}
    each = {name: fit_trial(data, (*others, name), values) for name in _OFFSETS}
    enough = {
        name: trial
        for name, trial in each.items()
        if trial is not None and np.isfinite(trial.choice.squares).all() and needless(advantage(trial, current))
    }
    if enough:
        one = min(enough, key=lambda name: enough[name].choice.nrmse)
        return enough[one], [one if name == two[0] else name for name in kept if name not in two[1:]]
    return current, kept


def are_a_load(added: Sequence[str], values: Mapping[str, float]) -> bool:
    """Whether offsets of current and voltage are nearly those of a load, v0 = R i0, which sensors have by chance only:
    then they stand for one and for something beside it, as friction that differs by direction."""
    if not set(_OFFSETS[1:]) <= set(added):
        return False
    return abs(values["v0"] - values["R"] * values["i0"]) < _BY_CHANCE * abs(values["v0"])


def offsets_alike(data: Data, chosen: Trial, added: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Where two offsets are needed: by each name the third one, if it does as well in its place."""
    two = [name for name in added if name in _OFFSETS]
    rest = [name for name in _OFFSETS if name not in chosen.effects]
    if len(two) != 2 or len(rest) != 1:
        return {}
    out, third = dict[str, tuple[str, ...]](), rest[0]
    for name in two:
        nothing = {p.name: p.nominal for p in effects_by_name()[third].parameters}
        effects = tuple(third if e == name else e for e in chosen.effects)
        other = fit_trial(data, effects, {**nothing, **chosen.values})
        if other is not None and no_worse(other, chosen):
            out[name] = (third,)
    return out


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
