"""One round's candidates: fitted together with the motor, and which of them is the best."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, partial

import casadi as ca
import numpy as np

from servo_daemon.diagnosis.screening.screen import ScreenedCandidate
from servo_daemon.diagnosis.search.candidates import CONTAINED, NESTED, Proposal, has_no_current
from servo_daemon.diagnosis.search.effort import Effort, model_key
from servo_daemon.diagnosis.search.evidence import (
    LEAST_BIC,
    NESTED_GAIN,
    convinces,
    half_convinces,
    likelier,
    no_worse,
    overwhelming,
    speaks_against_screening,
)
from servo_daemon.diagnosis.trial.compare import Advantage, advantage
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.equivalent_models import equivalent_lags
from servo_daemon.diagnosis.trial.split import shorter_s
from servo_daemon.diagnosis.trial.trial import FIRST_ITERATIONS, Trial, fit_trial
from servo_daemon.identification.output_error.starts import by_sizes
from servo_daemon.identification.short_runs import begun_short_runs, has_found_states, with_all_inertia
from servo_daemon.plant.contribution import contribution
from servo_daemon.plant.effects import effects_by_name

#: The share of the best one's gain that earns a candidate more than its first iterations (chosen; not tried).
_KEPT = 0.3
#: … unless it has gained less than this in V per value: a quarter of what `LEAST_GAIN` asks for.
_HOPELESS = 0.01
#: Where fewer of what a fit leaves are independent samples, it may be caught among the initial states that it has from
#: the model before (a shaft that stuck in that one): it is begun again from the measured ones.
COLOURED = 0.5
#: Where free runs err by more than this share of the signal little is known of the motor yet (a pendulum called a
#: linear motor: 0.28 to 0.39; one with a dead zone and a late speed: 0.1; with dry friction alone: 0.002).
_MUCH = 0.05
#: Share of what is left that a further effect explains in the balances, on data held out: the ripple that a fit put
#: beside dry friction on means of 500 Hz, three times as large as the balance had it, explained 0.02.
_LITTLE_SEEN = 0.05
#: Share of what is missing that one cause is, if it is most of it (a half, by what the word says).
_MOSTLY = 0.5


@dataclass(frozen=True, slots=True)
class Candidate:
    """An effect fitted together with the motor.

    Attributes:
        name: of the effect.
        trial: the model of that round with it.
        against: its advantage over the model of that round.
        taken: whether it was.
        start: where screening put it, natural values; None: not screened.
    """

    name: str
    trial: Trial
    against: Advantage
    taken: bool = False
    start: Mapping[str, float] | None = None


def seen_enough(candidates: Sequence[Candidate], screened: Sequence[ScreenedCandidate]) -> tuple[Candidate, ...]:
    """Of candidates beside an effect that was taken, without the waves of which the balances show next to nothing, if
    they are not far too good for chance: what is left of free runs is their drift, and of many numbers of periods a
    turn there is one that follows it."""
    share = {s.effect: s.heldout_share for s in screened}
    known = effects_by_name()

    def seen(c: Candidate) -> bool:
        effect = known.get(c.name)
        if effect is None or not any(p.name.startswith("n_") for p in effect.parameters):
            return True
        return share.get(effect.further or c.name, 1.0) > _LITTLE_SEEN or speaks_against_screening(c.against)

    return tuple(c for c in candidates if seen(c))


def not_alone(
    candidates: Sequence[Candidate], best: Candidate | None, screened: Sequence[ScreenedCandidate]
) -> Candidate | None:
    """The cause beside which others are tried: it takes much and yet does not convince. Where none is better in free
    runs, the one that is most of what is missing in the balances: a load beside dry friction runs away as the linear
    motor does, and until it is there the friction is not seen."""
    first = candidates[0] if candidates and candidates[0] is not best else None
    if first is not None and half_convinces(first.against) and not convinces(first.against):
        return first
    share = {s.effect: s.heldout_share for s in screened}
    most = max(candidates, key=lambda c: share.get(c.name, 0.0), default=None)
    if best is not None or most is None or share.get(most.name, 0.0) < _MOSTLY or most.against.delta_bic > LEAST_BIC:
        return None
    return most


def fitted(data: Data, current: Trial, proposed: Sequence[Proposal], effort: Effort) -> tuple[Candidate, ...]:
    """Fitted together with the motor, best first. All get a few iterations; those that then have some of what the best
    one has gained go on to their end; beside a motor of which nothing is known yet, those too that are still worse than
    the model that they contain. What there is no time for is missing; what an earlier search has fitted to the end goes
    on from there."""
    fits = _Fits(data, current, effort)
    with ThreadPoolExecutor(effort.workers) as pool:
        begun = [(p, t) for p, t in zip(proposed, pool.map(fits.begin, proposed), strict=True) if t is not None]
        most = max((fits.gained(t) for _, t in begun), default=0.0)
        loads = max((fits.gained(t) for p, t in begun if "J_l" in p.start), default=0.0)
        found = [c for c in pool.map(partial(fits.end, most=most, loads=loads), begun) if c is not None]
    return tuple(sorted(found, key=lambda c: -c.against.gain))


@dataclass(frozen=True)
class _Fits:
    """Fits of one round's candidates.

    Attributes:
        data: all are fitted to these.
        current: the model that they extend.
        effort: what they may cost.
    """

    data: Data
    current: Trial
    effort: Effort

    @cached_property
    def _biased(self) -> bool:
        """Without a current R and K may have any values, and a motor that lacks much ends far from the real one."""
        current = self.current
        return has_no_current(current) and current.independent < COLOURED and current.choice.nrmse > _MUCH

    @cached_property
    def _smooth(self) -> bool:
        return is_smooth(self.current)

    def gained(self, trial: Trial) -> float:
        return self.current.solution.point.value - trial.solution.point.value

    def begin(self, p: Proposal) -> Trial | None:
        """A few iterations; None where there is no time for it."""
        known = self.effort.journal.values(self._key(p))
        if known is not None:
            return self._begun(p, known)
        if not self.effort.allows(p.name):
            return None
        best = None
        for start in (p.start, p.other):
            best = _better(best, self._begun(p, start))
            # Worse than the model that it contains: it began in the wrong place.
            if best is not None and self.gained(best) > 0.0 and not p.far:
                break
        for start in _by_sizes(self.data, p) if self._biased else ():
            best = _better(best, fit_trial(self.data, p.effects, start, max_iterations=FIRST_ITERATIONS))
        return best

    def end(self, begun: tuple[Proposal, Trial], most: float, loads: float) -> Candidate | None:
        """A candidate; None where its free runs leave the range of numbers.

        Args:
            begun: as it has begun.
            most: that any of the round has gained so far.
            loads: the same of those that bring an inertia.
        """
        (p, trial), journal = begun, self.effort.journal
        if journal.values(self._key(p)) is None and self.effort.allows(p.name):
            trial = self._finished(p, trial, most, loads)
            journal.keep(self._key(p), trial.values)
        if not np.isfinite(trial.choice.squares).all():
            return None
        return Candidate(p.name, trial, advantage(self.current, trial), start=p.start)

    def _finished(self, p: Proposal, trial: Trial, most: float, loads: float) -> Trial:
        little = _HOPELESS * float(trial.fitted.counts.sum())
        over = _over_the_gap(self.data, self.current, p, trial) if loads >= little else None
        if over is not None:
            return over
        if (self._biased and self.gained(trial) < 0.0) or self.gained(trial) >= max(_KEPT * most, little):
            return self._refined(p, trial, most)
        return trial

    def _refined(self, p: Proposal, trial: Trial, most: float) -> Trial:
        trial = fit_trial(self.data, p.effects, trial.values, like=trial) or trial
        if not trial.solution.converged and self.gained(trial) >= _KEPT * most:
            trial = fit_trial(self.data, p.effects, trial.values, like=trial, careful=True) or trial
        coloured = trial.independent < COLOURED and self.gained(trial) >= _KEPT * most
        if coloured and not (self._smooth and is_smooth(trial)):
            trial = _better(trial, fit_trial(self.data, p.effects, trial.values, rival=trial)) or trial
        equivalent = equivalent_lags(trial.values)
        if equivalent is not None:
            trial = _better(trial, fit_trial(self.data, p.effects, equivalent, rival=trial)) or trial
        return trial

    def _begun(self, p: Proposal, start: Mapping[str, float]) -> Trial | None:
        return fit_trial(self.data, p.effects, start, like=self.current, max_iterations=FIRST_ITERATIONS)

    def _key(self, p: Proposal) -> str:
        return model_key(self.current.effects, p.effects, self.data.split.segment_s)


def _by_sizes(data: Data, p: Proposal) -> Iterator[Mapping[str, float]]:
    """Where the model begins by the sizes of the signals: natural values, one for each mechanical time constant."""
    known = effects_by_name()
    held = {q.name: p.start[q.name] for e in p.effects for q in known[e].parameters if q.held == "always"}
    held = {**held, **data.fixed}
    for begun in by_sizes(data.recordings, data.problem(p.effects, held), held):
        yield {**begun, **held}


def _over_the_gap(data: Data, current: Trial, p: Proposal, trial: Trial) -> Trial | None:
    """A model with a gap that the current one does not have, fitted from where short runs put it, whatever the free
    runs say to that: with the load in the wrong place they prefer another motor. None: it is none, or short runs do not
    tell.

    Args:
        trial: as it has begun.
    """
    if "gap" not in trial.problem.free or "gap" in current.values:
        return None
    begin = begun_short_runs(trial.fitted, p.start, with_all_inertia(current.values))
    return None if begin is None else fit_trial(data, trial.effects, begin)


def closer(data: Data, trial: Trial) -> Trial:
    """The model fitted once more from where shorter free runs put it, if what it leaves is not noise and that helps.

    A run with dry friction is no smooth function of the parameters: a shaft that stops a little earlier sticks. Over
    short runs there are few such edges for a fit to be caught at. (Behind a gap there is one at every run's begin; see
    `_over_the_gap`.)
    """
    shorter = shorter_s(data.recordings, data.split.segment_s)
    if shorter is None or trial.independent >= COLOURED or has_found_states(trial.fitted) or is_smooth(trial):
        return trial
    short = fit_trial(data.cut(trial.effects, shorter), trial.effects, trial.values)
    again = None if short is None else fit_trial(data, trial.effects, short.values, rival=trial)
    return _better(trial, again) or trial


def is_smooth(trial: Trial) -> bool:
    """Whether a free run is a smooth function of the parameters: nothing in it sticks, blocks, swings or is turned to
    one side or the other by where it stands. What its fit leaves is coloured by noise that enters the motor, then."""
    added = [contribution(name) for name in trial.effects]
    return not trial.problem.plant.may_stick and not any(
        c.terms.shaft is not None
        or c.effect.exact_zero
        or not ca.SX(c.terms.dry_drop).is_zero()
        or c.follows(c.signals.theta)
        for c in added
    )


def _better(one: Trial | None, other: Trial | None) -> Trial | None:
    if one is None or other is None:
        return one or other
    return min(one, other, key=lambda t: t.solution.point.value)


def best_of(candidates: Sequence[Candidate]) -> Candidate | None:
    """The candidate that gains most, or one of as many parameters that is likelier and as good; a smaller one that it
    contains, unless it earns its parameters."""
    convincing = [c for c in candidates if convinces(c.against)]
    if not convincing:
        return None
    best = convincing[0]
    alike = [c for c in convincing if c is best or no_worse(c.trial, best.trial)]
    # The smallest; of several, what every machine has; then the better one, which is the first.
    best = min(alike, key=lambda c: (c.trial.free, c.name != "coulomb_friction"))
    for rival in convincing:
        if rival is not best and likelier(rival.trial, best.trial):
            best = rival
    for smaller in convincing:
        if best.name in NESTED.get(smaller.name, ()):
            more = advantage(smaller.trial, best.trial)
            if not overwhelming(more) and (more.low < NESTED_GAIN or more.delta_bic > LEAST_BIC):
                return smaller
    return best


def ties(best: Candidate, candidates: Sequence[Candidate]) -> tuple[str, ...]:
    """Names that do as well as the best in its place: tested, not assumed."""
    out = []
    for c in candidates:
        if c.name == best.name or not convinces(c.against) or c.name in CONTAINED.get(best.name, ()):
            continue
        if no_worse(c.trial, best.trial):
            out.append(c.name)
    return tuple(out)
