"""Whether the names that a search came to can be believed.

A search always finds something that fits a little better. A name is believed if its effect takes most of the error that
is not noise, if all of them together do, and if what they leave is small beside what they explain: a friction that is
not quite Coulomb's leaves a fifth of itself. All this is judged on the parts that fit and decide. The held-out part is
seen by what is published, and a name of which the published values are open is taken away.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from servo_daemon.diagnosis.missing.missing import Missing
from servo_daemon.diagnosis.missing.noise_levels import NoiseLevels
from servo_daemon.diagnosis.screening.dependence import Dependence, dependences
from servo_daemon.diagnosis.search.evidence import (
    LEAST_OWN,
    LEAST_TOGETHER,
    are_what_they_are_called,
    noticeable,
)
from servo_daemon.diagnosis.search.pruning import are_a_load, offsets_alike, pruned, without_effect
from servo_daemon.diagnosis.search.select import Selection
from servo_daemon.diagnosis.trial.cuts import mean_over_cuts
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.equivalent_models import told_from_equivalent
from servo_daemon.diagnosis.trial.full_data_fit import (
    FullDataFits,
    by_predictions,
    exactness,
    fit_full_data,
    fit_runs,
    over_a_gap,
)
from servo_daemon.diagnosis.trial.likelihood import as_likely, plainly_worse
from servo_daemon.diagnosis.trial.model_discrepancy import longest_missing
from servo_daemon.diagnosis.trial.noise_floor import measured_levels, noise_floor
from servo_daemon.diagnosis.trial.split import CHOICE, shorter_s
from servo_daemon.diagnosis.trial.trial import Trial, fit_trial
from servo_daemon.diagnosis.verdict.determined import is_determined, is_its_simpler
from servo_daemon.diagnosis.verdict.other_captures import helps_no_other
from servo_daemon.diagnosis.verdict.remains import leaves_much, removed_of_missing
from servo_daemon.errors import NumericalError
from servo_daemon.identification.output_error import OutputErrorFit
from servo_daemon.identification.output_error.precision.parameters import FittedParameter
from servo_daemon.plant.effects import effects_by_name

#: Standard deviations by which two estimates differ that cannot both be right (Gaussian: once in 370 times).
_DIFFERENT = 3.0


@dataclass(frozen=True)
class Believed:
    """Effects of a search that can be believed, with the fit that holds them.

    Attributes:
        selection: with the effects that are believed; none: the model it began with.
        extended: fitted to the full data; None: no effect is believed.
        missing: what it lacks, of the longest capture.
        depends_on: what that follows.
        levels: of the noise, as the samples show it that decided; None: no effect is believed.
    """

    selection: Selection
    extended: OutputErrorFit | None
    missing: Missing | None
    depends_on: tuple[Dependence, ...]
    levels: NoiseLevels | None


def believed(selection: Selection, full_fits: FullDataFits) -> Believed:
    """Drop the names that cannot be believed, the weakest first."""
    data = selection.data
    before = longest_missing(data, selection.base) if selection.added else None
    while selection.added:
        assert before is not None
        extended = fit_full_data(data, selection.chosen, full_fits, _screened_start(selection))
        missing = longest_missing(data, extended)
        levels = measured_levels(missing)
        floor = noise_floor(levels, selection.chosen, CHOICE).nrmse
        fewer = _weakest(selection, floor) or _without_the_unneeded(selection, extended, full_fits)
        if fewer is not None:
            selection = fewer
            continue
        if not are_what_they_are_called(selection.added, selection.chosen.values):
            break
        removed = removed_share(selection.base.choice.nrmse, selection.chosen.choice.nrmse, floor)
        # A motor with a gap runs freely nowhere for long: the balances, which run nowhere, may speak for it.
        if max(removed, removed_of_missing(before, missing)) < LEAST_TOGETHER:
            break
        straight = _straight(data, selection.chosen, extended)
        if straight is not extended:
            extended, missing = straight, longest_missing(data, straight)
        if not extended.white and leaves_much(selection, before, extended, missing):
            break
        if unhelpful := helps_no_other(selection):
            if set(unhelpful) == set(selection.added):
                break
            selection = _without(selection, unhelpful[0])
            continue
        found = _published(selection, (extended, missing), levels)
        assert found.extended is not None
        # Of what is published: the only thing that everything has a say in, and only to take a name away.
        shown = found.extended
        if are_a_load(selection.added, shown.values):
            break
        known = [n for n in selection.added if noticeable(n, shown, missing) and is_determined(n, shown)]
        if vague := [name for name in selection.added if name not in known]:
            if len(vague) == len(selection.added):
                break
            selection = _without(selection, vague[0])
            continue
        if richer := next((name for name in selection.added if is_its_simpler(name, shown)), None):
            selection = _simpler(selection, richer)
            continue
        return found
    return Believed(replace(selection, chosen=selection.base, added=(), equivalent={}), None, None, (), None)


def _without(selection: Selection, name: str) -> Selection:
    """The search's result less one of its effects, fitted anew."""
    others = tuple(a for a in selection.added if a != name)
    without = without_effect(selection.data, selection.chosen, name)
    if without is None or not others:
        return replace(selection, chosen=selection.base, added=(), equivalent={})
    # What had its place beside it may have none now.
    chosen, kept = pruned(selection.data, without, others)
    return replace(selection, chosen=chosen, added=tuple(kept))


def _simpler(selection: Selection, name: str) -> Selection:
    """The search's result with what an effect contains in its place, fitted anew."""
    (instead,) = effects_by_name()[name].simpler[0]
    other = without_effect(selection.data, selection.chosen, name, instead=(instead,))
    if other is None:
        return _without(selection, name)
    added = tuple(instead if a == name else a for a in selection.added)
    equivalent = {n: tuple(e for e in ties if e not in added) for n, ties in selection.equivalent.items() if n != name}
    return replace(selection, chosen=other, added=added, equivalent=equivalent)


def _published(selection: Selection, decided: tuple[OutputErrorFit, Missing], levels: NoiseLevels) -> Believed:
    """What was decided on the parts for fitting and choosing, fitted to all the data.

    Args:
        decided: the fit to those parts, and what it lacks: all is white only where they are, and as noisy.
    """
    data, trial = selection.data.full, selection.chosen
    full_fits = FullDataFits(data) if decided[0].white else None
    near = full_fits.of(trial, decided[0].values) if full_fits is not None else None
    if near is None or not near.white:
        near = fit_full_data(data, trial, full_fits, _screened_start(selection))
    extended = _straight(data, trial, near)
    missing = longest_missing(data, extended, decided[1].levels)
    depends = () if extended.white else dependences(extended, missing)
    better = by_predictions(data, extended)
    if better is not extended:
        extended, missing, depends = better, longest_missing(data, better), ()
    alike = offsets_alike(selection.data, trial, selection.added)
    selection = replace(selection, equivalent={**selection.equivalent, **alike})
    return Believed(selection, over_a_gap(data, extended, trial.values), missing, depends, levels)


def _screened_start(selection: Selection) -> Mapping[str, float] | None:
    """Where screening put the model, where it is what a single round has taken; natural values."""
    taken = [c for candidates in selection.rounds for c in candidates if c.taken]
    alone = len(taken) == 1 and taken[0].trial.effects == selection.chosen.effects
    return taken[0].start if alone else None


def _straight(data: Data, trial: Trial, fit: OutputErrorFit) -> OutputErrorFit:
    """The fit, less what free runs of one length do to it."""
    straight = _unbiased(data, trial, fit)
    straight = _told_from_equivalent(data, trial, straight, short=straight is not fit)
    return mean_over_cuts(data, trial, straight)


def _unbiased(data: Data, trial: Trial, fit: OutputErrorFit) -> OutputErrorFit:
    """The fit, or one over shorter free runs if that contradicts it.

    If the model and noise of the sensors were all there is, both would be right, and the longer runs tell more. Noise
    that enters the motor adds up along a run, at a reversal with dry friction or beside a detent without bound, and
    biases what is fitted to it: where the two differ the shorter runs are to be believed. Of a given torque or current
    nothing adds up: see `cuts`.
    """
    shorter = shorter_s(data.recordings, data.split.segment_s)
    if fit.white or shorter is None or fit.problem.plant.drive != "voltage":
        return fit
    begun = fit_trial(data.cut(trial.effects, shorter), trial.effects, trial.values) or trial
    with suppress(NumericalError):
        short = fit_runs(data, begun, begun.values, shorter)
        if contradicts(fit.parameters, short.parameters):
            return short
    return fit


def _told_from_equivalent(data: Data, trial: Trial, fit: OutputErrorFit, *, short: bool) -> OutputErrorFit:
    """The fit or its equivalent over the same runs, whichever is better (`told_from_equivalent`).

    Args:
        short: the fit is that of `_unbiased` over shorter ones.
    """
    runs_s = shorter_s(data.recordings, data.split.segment_s) if short else data.split.segment_s

    def again(values: Mapping[str, float]) -> OutputErrorFit | None:
        with suppress(NumericalError):
            return fit_runs(data, trial, values, None if fit.white else runs_s)
        return None

    return told_from_equivalent(fit, again)


def contradicts(fit: Mapping[str, FittedParameter], other: Mapping[str, FittedParameter]) -> bool:
    """Whether two estimates from the same data, of which the first should be the more exact, differ too much: the
    variance of their difference is then that of their variances (Hausman, *Econometrica* 46, 1978)."""
    for name, p in fit.items():
        q = other[name]
        if p.value is None or q.value is None or not p.std or not q.std:
            continue
        spread = math.hypot(math.sqrt(max(q.std**2 - p.std**2, 0.0)), exactness(name, p))
        if abs(p.value - q.value) > _DIFFERENT * spread:
            return True
    return False


def removed_share(before: float, after: float, floor: float) -> float:
    """(b² − e²)/(b² − n²) of normalised errors; 0 where there is nothing to remove."""
    room = before**2 - min(floor, after) ** 2
    return 0.0 if room <= 0 else (before**2 - after**2) / room


def _weakest(selection: Selection, floor: float) -> Selection | None:
    """Without the effect that takes least of what the others leave, if that is too little; None: all take enough."""
    if len(selection.added) < 2:
        return None
    own: list[tuple[float, str, Trial]] = []
    for name in selection.added:
        without = without_effect(selection.data, selection.chosen, name)
        if without is not None and np.isfinite(without.choice.squares).all():
            share = removed_share(without.choice.nrmse, selection.chosen.choice.nrmse, floor)
            own.append((share, name, without))
    share, name, without = min(own, key=lambda o: o[0], default=(1.0, "", selection.chosen))
    if share >= LEAST_OWN:
        return None
    return replace(selection, chosen=without, added=tuple(a for a in selection.added if a != name))


def _without_the_unneeded(selection: Selection, extended: OutputErrorFit, full_fits: FullDataFits) -> Selection | None:
    """The search's result less an effect without which the data are as likely, or with what it contains in its place;
    None: all are needed, or it cannot be told.

    Args:
        extended: fitted to the full data, with noise that enters the motor.
    """
    if not extended.white:
        return None
    richer = ((name, instead) for name in selection.added for instead in effects_by_name()[name].simpler)
    for name, instead in (*((name, ()) for name in selection.added), *richer):
        others = tuple(o for a in selection.added for o in (instead if a == name else (a,)))
        data, chosen = selection.data, selection.chosen
        without = without_effect(data, chosen, name, instead=instead) if others else selection.base
        if without is None or plainly_worse(without, selection.chosen):
            continue
        if as_likely(without, extended, full_fits.of):
            return replace(selection, chosen=without, added=others)
    return None
