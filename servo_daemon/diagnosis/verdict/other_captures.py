"""Leave-captures-out validation: whether what is named predicts captures that took no part, where there are several.

Free runs that decide lie between those that were fitted. What one capture alone wants (its own temperature, a load
that was hung on) fits its neighbours too; a cause that is the motor's is in the next capture as well.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from servo_daemon.diagnosis.search.pruning import without_effect
from servo_daemon.diagnosis.search.select import Selection
from servo_daemon.diagnosis.trial.compare import bootstrapped
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.scored import Scored
from servo_daemon.diagnosis.trial.split import CHOICE, HELD_OUT, TRAIN
from servo_daemon.diagnosis.trial.trial import Trial, fit_trial

#: Captures are left out in at most so many groups: each is a fit of every model (chosen; not tried).
_GROUPS = 3
#: What is left has at least this share of the free runs: a model fitted to a handful of them is no judge of the rest.
_LEAST_LEFT = 0.4


def helps_no_other(selection: Selection) -> tuple[str, ...]:
    """Names without which the captures that were left out are predicted as well or better; all names where the whole
    model predicts them no better than the one that the search began with. Empty with a single capture."""
    base, chosen = selection.base, selection.chosen
    names = selection.added if len(selection.added) > 1 else ()
    before: list[Scored] = []
    after: list[Scored] = []
    less: dict[str, list[Scored]] = {name: [] for name in names}
    for data in _left_out(selection.data, base):
        simple = fit_trial(data, base.effects, base.values)
        rich = fit_trial(data, chosen.effects, chosen.values)
        without = {name: without_effect(data, chosen, name) for name in names}
        if simple is None or rich is None or any(t is None for t in without.values()):
            continue
        before.append(simple.choice)
        after.append(rich.choice)
        for name, trial in without.items():
            if trial is not None:
                less[name].append(trial.choice)
    if not before:
        return ()
    if not _better(before, after):
        return selection.added
    return tuple(name for name in names if not _better(less[name], after))


def _left_out(data: Data, base: Trial) -> Iterator[Data]:
    """The search's data with whole captures as the part that decides and all others to fit."""
    recording = np.array([s.recording for s in base.problem.segments])
    measuring = data.split.part == HELD_OUT
    groups = min(len(data.recordings), _GROUPS)
    for group in range(groups if groups > 1 else 0):
        out = recording % groups == group
        if np.mean(~out) >= _LEAST_LEFT:
            part = np.where(measuring, HELD_OUT, np.where(out, CHOICE, TRAIN))
            yield replace(data, split=replace(data.split, part=part))


def _better(before: list[Scored], after: list[Scored]) -> bool:
    gain, _, _ = bootstrapped(_together(before), _together(after))
    return bool(gain > 0.0)


def _together(parts: list[Scored]) -> Scored:
    squares, counts = (np.concatenate([getattr(p, name) for p in parts]) for name in ("squares", "counts"))
    return Scored(squares, counts, parts[0].spread)
