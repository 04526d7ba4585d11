"""The effect that only predictions show, where free runs name none.

Noise that enters the motor adds up along a free run, until after half a second it is more than a lag of the drive or a
winding that warms up makes. A fit that knows of such noise predicts each sample from those before it, and there
nothing adds up: on clean captures the deviances (−2 log p) with and without an effect differ as chance has it, by −2 to
4, with one that is there by 100 to 2,000. An effect is named if the data are white with it and far likelier than
without, if it predicts the times that decide better where neither fit has seen them, and if its parameters are known or
it removes plainly much (a lag of the drive is known to 85 % beside an inductance that may be a part of it, and removes
94 %). The gain is that of the times held out, of which none of this has seen anything.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from functools import partial

import numpy as np

from servo_daemon.diagnosis.search.candidates import CONTAINED, NESTED
from servo_daemon.diagnosis.search.evidence import PLAINLY
from servo_daemon.diagnosis.search.fitting import Candidate
from servo_daemon.diagnosis.search.select import Selection
from servo_daemon.diagnosis.trial.compare import advantage, error_removed
from servo_daemon.diagnosis.trial.data import Data, begun
from servo_daemon.diagnosis.trial.equivalent_models import BY_CHANCE, told_from_equivalent
from servo_daemon.diagnosis.trial.full_data_fit import FullDataFits
from servo_daemon.diagnosis.trial.likelihood import far_below, far_likelier
from servo_daemon.diagnosis.trial.model_discrepancy import longest_missing
from servo_daemon.diagnosis.trial.scored import Scored
from servo_daemon.diagnosis.trial.trial import Trial, fit_trial, model_exists
from servo_daemon.diagnosis.verdict.determined import is_determined
from servo_daemon.diagnosis.verdict.predicted import predictions_of_both
from servo_daemon.diagnosis.verdict.result import CandidateScore, Finding, HeldOut, NamedEffect
from servo_daemon.identification.output_error import OutputErrorFit
from servo_daemon.plant.effects import effects_by_name

#: So many of the candidates of the first round, those that fit best, are fitted to the full data (chosen; not tried).
_TRIED = 5
#: Where the baseline is not white these are tried, too, whatever screening thinks of them.
_OVERLOOKED = ("drive_lag", "winding_heating")
#: Samples, of all recordings together, that a decision needs at most (chosen; not tried).
_MOST_SAMPLES = 60_000


def found_by_predictions(
    data: Data, selection: Selection, candidates: Sequence[CandidateScore], full_fits: FullDataFits
) -> Finding | None:
    """The effect of the search's first round that the data need; None: there is none, or it cannot be told.

    Args:
        data: uncut.
        candidates: as they were scored.
        full_fits: over `data`.

    Raises:
        NumericalError: predictions left the range of numbers.
    """
    base = selection.base
    if base.problem.plant.drive != "voltage":
        return None
    few = _begun(data, base.effects)
    fits = full_fits if few is data else FullDataFits(few)
    whole = fits.of(base)
    if whole is None or whole.deviance_at_best is None:  # nothing can be told to be far likelier
        return None
    likely = _likely(fits, selection, whole)
    if not likely:
        return None
    best, extended = _simplest(likely)
    full = extended if few is data else _fitted(full_fits, best)
    if full is None or not full.white:
        return None
    both = predictions_of_both(few, (base, whole), (best.trial, extended))
    if both is None:
        return None
    published = _fitted(FullDataFits(data.full), best) or full
    before, after = both
    removed, ci95 = error_removed(before.errors, after.errors, after.expected)
    known = (ci95 is not None and ci95[0] > PLAINLY) or is_determined(best.name, published)
    richer = (best.name, *CONTAINED.get(best.name, ()))
    ties = tuple(c.name for c, fit in likely if c.name not in richer and _as_likely(fit, extended))
    finding = Finding(
        judged_by="predictions",
        effects=(NamedEffect(best.name, removed, ties),),
        extended=published,
        baseline_score=_score(before.errors, whole.problem.channels),
        extended_score=_score(after.errors, whole.problem.channels),
        noise_floor=after.expected.nrmse,
        error_removed=removed,
        ci95=ci95,
        candidates=_marked(candidates, best, base),
        after=longest_missing(data.full, published),
        deviance_gain=(whole.deviance_at_best or 0.0) - (extended.deviance or 0.0),
    )
    return finding if known else None


def _marked(candidates: Sequence[CandidateScore], best: Candidate, base: Trial) -> tuple[CandidateScore, ...]:
    """What was tried, with the best as the one that was taken."""
    own = CandidateScore(best.name, base.effects, best.trial.choice.nrmse, best.against.delta_bic, taken=True)
    others = [c for c in candidates if (c.name, c.beside) != (best.name, base.effects)]
    return (own, *others)


def _begun(data: Data, effects: tuple[str, ...]) -> Data:
    """The first samples of each recording, where there are more than a decision needs: several models are fitted."""
    first = begun(data.recordings, _MOST_SAMPLES)
    return data if first is data.recordings else Data.of(first, data.fixed, effects, data.split.segment_s)


def _likely(
    full_fits: FullDataFits, selection: Selection, base: OutputErrorFit
) -> list[tuple[Candidate, OutputErrorFit]]:
    """Candidates with which the data are white and far likelier than without, the likeliest first."""
    single = [c for c in selection.rounds[0] if len(c.trial.effects) == len(selection.base.effects) + 1]
    tried = sorted({c.name: c for c in reversed(single)}.values(), key=lambda c: c.against.delta_bic)[:_TRIED]
    if not base.white:
        tried += _unscreened(selection, {c.name for c in tried})
    fits = [(c, _fitted(full_fits, c, far_below(base, len(c.trial.problem.free)))) for c in tried]
    likely = [(c, fit) for c, fit in fits if fit is not None and fit.white and far_likelier(fit, base)]
    return sorted(likely, key=lambda f: f[1].deviance or math.inf)


def _unscreened(selection: Selection, tried: Collection[str]) -> list[Candidate]:
    """What screening may see nothing of: it looks for what follows the motion, and a lag makes little of that."""
    base, known, out = selection.base, effects_by_name(), []
    for name in _OVERLOOKED:
        effects = (*base.effects, name)
        if name in tried or name in base.effects or not model_exists(effects):
            continue
        start = {**base.values, **{p.name: p.nominal for p in known[name].parameters}}
        trial = fit_trial(selection.data, effects, start, like=base)
        if trial is not None and np.isfinite(trial.choice.squares).all():
            out.append(Candidate(name, trial, advantage(base, trial)))
    return out


def _fitted(full_fits: FullDataFits, c: Candidate, below: float = math.inf) -> OutputErrorFit | None:
    """To everything, as far as the deviance may come below this; of two lags in a row in the order that the data
    prefer."""
    fit = full_fits.from_either(c.trial, c.start, below)
    return None if fit is None else told_from_equivalent(fit, partial(full_fits.of, c.trial, below=below))


def _simplest(likely: Sequence[tuple[Candidate, OutputErrorFit]]) -> tuple[Candidate, OutputErrorFit]:
    """The likeliest, or one that it contains where it is not far likelier than that."""
    best, fit = likely[0]
    for simpler, other in likely[1:]:
        if best.name in NESTED.get(simpler.name, ()) and not far_likelier(fit, other):
            best, fit = simpler, other
    return best, fit


def _as_likely(other: OutputErrorFit, best: OutputErrorFit) -> bool:
    """Whether chance may make the data as much less likely under another cause; they are white under both."""
    assert other.deviance is not None and best.deviance is not None
    return other.deviance < best.deviance + BY_CHANCE


def _score(errors: Scored, channels: Sequence[str]) -> HeldOut:
    return HeldOut({c: float(np.sqrt(v)) for c, v in zip(channels, errors.mse, strict=True)}, errors.nrmse)
