"""What the effects that a search came to gain, on free runs that neither fit nor choice has seen.

Both models are fitted to all other runs and scored on these. Where a capture is too short for a part of its own to
measure with, it is the part that decides, and the gain says so.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servo_daemon.diagnosis.search.pruning import without_effect
from servo_daemon.diagnosis.search.select import Selection
from servo_daemon.diagnosis.trial.compare import error_removed, share_of_removable
from servo_daemon.diagnosis.trial.noise_floor import noise_floor
from servo_daemon.diagnosis.trial.scored import Scored
from servo_daemon.diagnosis.trial.split import HELD_OUT, Split
from servo_daemon.diagnosis.trial.trial import Trial, fit_trial
from servo_daemon.diagnosis.verdict.adequacy import Believed
from servo_daemon.diagnosis.verdict.result import HeldOut, MeasuredOn, NamedEffect


@dataclass(frozen=True, slots=True)
class Gain:
    """Scores of baseline and extended model on the part that measures; fields as in `Diagnosis`."""

    effects: tuple[NamedEffect, ...]
    baseline_score: HeldOut
    extended_score: HeldOut | None = None
    floor: float | None = None
    removed: float | None = None
    ci95: tuple[float, float] | None = None


def measured_on(split: Split) -> MeasuredOn:
    """What the gain is measured on."""
    return "unseen" if split.measuring == HELD_OUT else "choosing"


def gain(belief: Believed) -> Gain:
    """Both models fitted to all but the part that measures, and scored there."""
    selection = belief.selection
    data, chosen, parts = selection.data, selection.chosen, selection.data.split.before_measuring
    base = fit_trial(data, selection.base.effects, selection.base.values, parts=parts) or selection.base
    if belief.levels is None:
        return Gain((), held_out(base))
    final = fit_trial(data, chosen.effects, chosen.values, parts=parts) or chosen
    floor = noise_floor(belief.levels, final, data.split.measuring)
    removed, ci95 = error_removed(base.held_out, final.held_out, floor)
    effects = tuple(
        NamedEffect(name, _own(selection, name, (base, final), floor, removed), selection.equivalent.get(name, ()))
        for name in selection.added
    )
    return Gain(effects, held_out(base), held_out(final), floor.nrmse, removed, ci95)


def _own(
    selection: Selection, name: str, trials: tuple[Trial, Trial], floor: Scored, removed: float | None
) -> float | None:
    """Share of the removable error that comes back without this effect; None: it cannot be told."""
    base, final = trials
    if len(selection.added) == 1:
        return removed
    without = without_effect(selection.data, final, name, parts=selection.data.split.before_measuring)
    if without is None:
        return removed
    return share_of_removable(base.held_out, without.held_out, final.held_out, floor)[0]


def held_out(trial: Trial) -> HeldOut:
    """Errors of the part that measures."""
    scored = trial.held_out
    rmse = {name: float(np.sqrt(v)) for name, v in zip(trial.problem.channels, scored.mse, strict=True)}
    if scored.speed_rmse is not None:
        rmse["velocity_rad_s"] = scored.speed_rmse
    return HeldOut(rmse, scored.nrmse)
