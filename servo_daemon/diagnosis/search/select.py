"""The search for what is missing: candidates screened, fitted, chosen forward, pruned backward.

An effect is taken only if everything speaks for it: it predicts free runs that were not fitted, with a margin that
resampling them does not undo, and its parameters are worth their place (BIC, with correlated residuals counted as the
fewer samples they are). Each alone is fooled by encoders and converters.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from servo_daemon.diagnosis.missing.missing import Missing
from servo_daemon.diagnosis.screening.screen import screen
from servo_daemon.diagnosis.search.candidates import (
    WORTH_A_PAIR,
    Proposal,
    pairs,
    proposals,
)
from servo_daemon.diagnosis.search.effort import Effort
from servo_daemon.diagnosis.search.evidence import at_odds, noticeable, speaks_against_screening, worth_a_name
from servo_daemon.diagnosis.search.fitting import (
    Candidate,
    best_of,
    closer,
    fitted,
    not_alone,
    seen_enough,
    ties,
)
from servo_daemon.diagnosis.search.pruning import one_offset, pruned
from servo_daemon.diagnosis.search.unscreened import PROMISING, Asked, promised_by, unscreened, whatever
from servo_daemon.diagnosis.trial.compare import advantage
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.likelihood import Whole, needs_no_effect, white_without
from servo_daemon.diagnosis.trial.model_discrepancy import leaves, leaves_less, seen_missing
from servo_daemon.diagnosis.trial.split import shorter_s
from servo_daemon.diagnosis.trial.trial import Trial, fit_trial
from servo_daemon.errors import NumericalError
from servo_daemon.identification.short_runs import has_found_states

#: At most so many effects are taken (chosen; not tried).
_MOST_EFFECTS = 4
#: … of these: with them a motor may stand where it cannot stay.
_UNSTABLE = ("cogging_torque", "gravity_load")
#: … and so much of what it promised (chosen; not tried).
_MUCH = 0.7
#: V by which a model fitted again must be better to count as another (chosen; not tried).
_BETTER_CHANCE = 2.0
#: Told how far it is, 0 .. 1, and what is being done.
Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class Selection:
    """The search's result.

    Attributes:
        data: as it was divided in the end.
        base: the model it began with.
        chosen: the model it ended with; `base` if nothing was taken.
        added: names of the effects taken, in that order.
        rounds: the candidates of each round, best first.
        equivalent: for each added effect, names that did as well in its place.
    """

    data: Data
    base: Trial
    chosen: Trial
    added: tuple[str, ...]
    rounds: tuple[tuple[Candidate, ...], ...]
    equivalent: Mapping[str, tuple[str, ...]]


def select(data: Data, base: Trial, progress: Progress, whole: Whole, effort: Effort) -> Selection:
    """Forward selection of effects from a fitted baseline, then backward pruning.

    Args:
        progress: told what is being done.
        whole: fits to all the data: a first effect that these do not need is not searched beside.
        effort: what it may cost. Where that is not enough the result is the best so far.

    Raises:
        NumericalError: the baseline's unmodelled torque cannot be computed.
    """
    search = _Search(data, base)
    while len(search.added) < _MOST_EFFECTS:
        share = 1.0 - 0.6 ** len(search.rounds)  # how many rounds there will be is not known
        current = search.current
        progress(share, f"what is missing beside {' + '.join(current.effects) or 'the linear motor'}")
        try:
            missing = seen_missing(search.data, current)
        except NumericalError:
            if search.added:
                break  # the model before could be looked at, this one cannot: it is the last
            raise
        search, candidates, best = _round(search, missing, _after(progress, share), whole, effort)
        if best is not None and not search.added:
            search.noise_is_left = white_without(search.base, best.trial, whole) is not None
            best = None if needs_no_effect(search.base, best.trial, whole) else best
        search.rounds.append(tuple(replace(c, taken=c is best) for c in candidates))
        if best is None:
            break
        names = [e for e in best.trial.effects if e not in search.current.effects]
        # Of two at once neither has been tried against others in its place.
        search.equivalent |= {name: ties(best, candidates) if len(names) == 1 else () for name in names}
        search.added = [*(a for a in search.added if a in best.trial.effects), *names]
        # Before anything is searched beside a load that passes for two offsets.
        search.current, search.added = one_offset(search.data, closer(search.data, best.trial), search.added)
    chosen, added = pruned(search.data, search.current, search.added)
    return Selection(search.data, search.base, chosen, tuple(added), tuple(search.rounds), search.equivalent)


@dataclass
class _Search:
    """How far a search for effects has come."""

    data: Data
    base: Trial
    current: Trial = field(init=False)
    added: list[str] = field(default_factory=list)
    rounds: list[tuple[Candidate, ...]] = field(default_factory=list)
    equivalent: dict[str, tuple[str, ...]] = field(default_factory=dict)
    noise_is_left: bool = False  # so say the data even without an effect

    def __post_init__(self) -> None:
        self.current = self.base


#: A round's result: the search, maybe over other runs or from a better model; all candidates, best first; the best.
_Found = tuple[_Search, tuple[Candidate, ...], Candidate | None]


def _round(search: _Search, missing: Missing, progress: Progress, whole: Whole, effort: Effort) -> _Found:
    """What is tried beside the present model: one effect, over shorter runs where the motor may be unstable, two."""
    current = search.current
    screened = screen(current, missing)
    proposed = proposals(current, screened, missing, given=search.data.fixed)
    progress(0.1, "fitting " + ", ".join(p.name for p in proposed))
    worthy = _worthy(search, missing, proposed, effort)
    found = _against_the_best_chance(search, seen_enough(worthy, screened) if search.added else worthy)
    if has_found_states(current.fitted):  # what is left is how the load went on within the runs
        return found
    asked = Asked(search.data, current, missing, first=not search.added, noise_is_left=search.noise_is_left)
    if found[2] is None and (rest := unscreened(asked, screened, proposed, whole)):
        more = tuple(c for c in _worthy(search, missing, rest, effort) if speaks_against_screening(c.against))
        found = _against_the_best_chance(search, (*more, *found[1]))
    promised = promised_by(s for s in screened if s.effect in _UNSTABLE)
    broken = promised > PROMISING and not _kept_promise(found, missing, promised)
    if broken or (found[2] is None and any(c.name.startswith(_UNSTABLE) and at_odds(c.against) for c in found[1])):
        progress(0.2, "once more with shorter free runs")
        found = _with_shorter_runs(found, [p for p in proposed if p.name.startswith(_UNSTABLE)], effort)
    search, candidates, best = found
    first = not_alone(candidates, best, screened)
    if first is not None:
        progress(0.3, f"{first.name} and another")
        beside = _beside(search, first, candidates, effort)
        if beside[2] is not None:
            return beside
    if best is not None or promised_by(screened) <= PROMISING:
        return found
    progress(0.3, "two causes at once")
    proposed = pairs(proposals(search.current, screened, missing, WORTH_A_PAIR), missing.augmented.channels)
    two = fitted(search.data, search.current, proposed, effort)
    two = tuple(c for c in two if worth_a_name(c.trial, search.current, search.base))
    return search, (*two, *candidates), best_of(two)


def _beside(search: _Search, first: Candidate, candidates: tuple[Candidate, ...], effort: Effort) -> _Found:
    """Two causes of which one alone takes much and yet runs away in some of the runs that decide (a weight that no
    friction holds): each of the others beside it, judged against the model without either."""
    current = first.trial
    try:
        missing = seen_missing(search.data, current)
    except NumericalError:
        return search, candidates, None
    proposed = whatever(current, screen(current, missing), missing, search.data.fixed, worth=-math.inf)
    two = tuple(
        replace(c, name=f"{first.name} + {c.name}", against=advantage(search.current, c.trial))
        for c in fitted(search.data, current, proposed, effort)
        if noticeable(c.name, c.trial, missing) and worth_a_name(c.trial, current, search.base)
    )
    return search, (*two, *candidates), best_of(tuple(sorted(two, key=lambda c: -c.against.gain)))


def _worthy(search: _Search, missing: Missing, proposed: Sequence[Proposal], effort: Effort) -> tuple[Candidate, ...]:
    """The proposals fitted, less what is too small to have a name or takes too little."""
    unseen = {p.name for p in proposed if p.unseen}
    return tuple(
        c
        for c in fitted(search.data, search.current, proposed, effort)
        if noticeable(c.name, c.trial, missing)
        and (c.name not in unseen or speaks_against_screening(c.against))
        and (worth_a_name(c.trial, search.current, search.base) or at_odds(c.against))
    )


def _after(progress: Progress, share: float) -> Progress:
    """As told by what begins there."""
    return lambda done, step: progress(share + done, step)


def _against_the_best_chance(search: _Search, candidates: tuple[Candidate, ...]) -> _Found:
    """The best candidate, after the model without it has been fitted again from where it has come to.

    A richer model may only have found the way out of a valley in which the simpler one was left.
    """
    best = best_of(candidates)
    if best is None:
        return search, candidates, None
    current = search.current
    again = fit_trial(search.data, current.effects, _own_values(current, best.trial), like=best.trial, careful=True)
    if again is None or again.solution.point.value > current.solution.point.value - _BETTER_CHANCE:
        return search, candidates, best
    if search.base is current:
        search.base = again
    search.current = again
    judged = [replace(c, against=advantage(again, c.trial)) for c in candidates]
    candidates = tuple(sorted(judged, key=lambda c: -c.against.gain))
    return search, candidates, best_of(candidates)


def _own_values(current: Trial, other: Trial) -> dict[str, float]:
    return {name: other.values.get(name, value) for name, value in current.values.items()}


def _kept_promise(found: _Found, before: Missing, promised: float) -> bool:
    """Whether the best model takes of the unmodelled torque and voltage about what screening said could be taken. Where
    free runs diverge (a rotor between two detents) a fit to them follows the divergence and not the motor: the
    balances, which run nowhere, tell.

    Args:
        before: what was missing without it.
        promised: share of that, on data held out.
    """
    search, _, best = found
    return best is not None and leaves(search.data, best.trial, before) < 1.0 - _MUCH * promised


def _with_shorter_runs(had: _Found, proposed: Sequence[Proposal], effort: Effort) -> _Found:
    """The same candidates over shorter free runs, where that lets one of them convince, and, if one did before, leaves
    less missing; else what was had over the runs as they are."""
    search, _, before = had
    segment_s = shorter_s(search.data.recordings, search.data.split.segment_s)
    if segment_s is None:
        return had
    data = search.data.cut(search.base.effects, segment_s)
    base = fit_trial(data, search.base.effects, search.base.values)
    current = fit_trial(data, search.current.effects, search.current.values) if search.added else base
    if base is None or current is None:
        return had
    again = fitted(data, current, proposed, effort)
    best = best_of(again)
    if best is None or (before is not None and not leaves_less(data, best.trial, search.data, before.trial)):
        return had
    found = replace(search, data=data, base=base)
    found.current = current
    return found, again, best
