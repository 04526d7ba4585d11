"""The search for what is missing: candidates screened, fitted, chosen forward, pruned backward.

An effect is taken only if everything speaks for it: it predicts free runs that neither fit nor choice has seen, with a
margin that resampling them does not undo; its parameters are worth their place (BIC, with correlated residuals counted
as the fewer samples they are); and it is not smaller than what encoders and converters feign. Each alone is fooled.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servo_daemon.diagnosis.compare import Advantage, advantage
from servo_daemon.diagnosis.missing import Missing, missing_inputs
from servo_daemon.diagnosis.screen import ScreenedCandidate, screen
from servo_daemon.diagnosis.split import held_out, segment_length_s
from servo_daemon.diagnosis.trial import Trial, fit_trial, model_exists
from servo_daemon.estimators.output_error import FitOptions, OutputErrorFit, Recording, fit_output_error
from servo_daemon.estimators.output_error.setup import make_problem
from servo_daemon.plant.effects import effects_by_name

#: Of the screened candidates so many are fitted in each round, and at most so many effects are taken.
_FITTED, _MOST_EFFECTS = 6, 4
#: Least gain of a new effect: held-out error (log of its RMS, lower end of the 98 % interval), and BIC.
LEAST_GAIN, LEAST_BIC = 0.01, -20.0
#: Candidates whose gain is within this of the best, and that resampling cannot tell from it, are equivalent.
_TIE = 0.02
#: A nested effect with more parameters must gain this much over the smaller one.
_NESTED_GAIN = 0.01
#: simpler → what contains it.
NESTED: Mapping[str, tuple[str, ...]] = {
    "coulomb_friction": ("stribeck_friction", "asymmetric_friction", "load_dependent_friction"),
}

Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Candidate:
    """One effect that was fitted.

    Attributes:
        name: of the effect.
        trial: the model of that round with it.
        against: its advantage over the model of that round.
        screened: what the screening said.
    """

    name: str
    trial: Trial
    against: Advantage
    screened: ScreenedCandidate


@dataclass(frozen=True)
class Selection:
    """The search's result.

    Attributes:
        base: the model it began with.
        chosen: the model it ended with; `base` if nothing was taken.
        effects: what was added, in the order of their worth.
        rounds: the candidates of each round, best first.
        equivalent: for each added effect, names that did as well in its place.
        mask, segment_s: the split.
    """

    base: Trial
    chosen: Trial
    effects: tuple[str, ...]
    rounds: tuple[tuple[Candidate, ...], ...]
    equivalent: Mapping[str, tuple[str, ...]]
    mask: NDArray[np.bool_]
    segment_s: float


def select(
    recordings: Sequence[Recording],
    baseline: tuple[str, ...],
    start: Mapping[str, float],
    fixed: Mapping[str, float],
    progress: Progress,
) -> Selection:
    """Search from a fitted baseline.

    Args:
        start: values of the baseline's parameters, natural units.
        fixed: held in every model.
        progress: told what is being done.

    Raises:
        NumericalError: the baseline cannot be simulated.
    """
    segment_s = segment_length_s(recordings)
    mask = held_out(len(make_problem(recordings, baseline, dict(fixed), segment_s=segment_s).segments))
    base = fit_trial(recordings, baseline, start, fixed, segment_s, mask)
    assert base is not None  # these values have been simulated before
    current, added, rounds = base, list[str](), list[tuple[Candidate, ...]]()
    equivalent: dict[str, tuple[str, ...]] = {}
    while len(added) < _MOST_EFFECTS:
        progress(f"round {len(added) + 1}: what is missing beside {' + '.join(current.effects) or 'the linear motor'}")
        candidates = _round(recordings, current, fixed, segment_s, mask, progress)
        rounds.append(candidates)
        best = _best(candidates)
        if best is None:
            break
        equivalent[best.name] = _ties(best, candidates)
        current, added = best.trial, [*added, best.name]
    current, added = _pruned(recordings, current, added, fixed, segment_s, mask)
    return Selection(base, current, tuple(added), tuple(rounds), equivalent, mask, segment_s)


def refit(recordings: Sequence[Recording], trial: Trial, fixed: Mapping[str, float]) -> OutputErrorFit:
    """The model of a trial fitted to everything, with standard deviations."""
    return fit_output_error(recordings, trial.effects, FitOptions(nominal=trial.values, fixed=fixed))


def _screened(
    recordings: Sequence[Recording], current: Trial, fixed: Mapping[str, float]
) -> tuple[tuple[ScreenedCandidate, ...], Missing]:
    """Of the longest recording."""
    number = int(np.argmax([len(r.block) for r in recordings]))
    fit = refit([recordings[number]], current, fixed)
    missing = missing_inputs(fit, recordings[number].block)
    return screen(fit, missing), missing


def _round(
    recordings: Sequence[Recording],
    current: Trial,
    fixed: Mapping[str, float],
    segment_s: float,
    mask: NDArray[np.bool_],
    progress: Progress,
) -> tuple[Candidate, ...]:
    """The most promising effects, each fitted together with the motor; best first."""
    screened, _ = _screened(recordings, current, fixed)
    known = effects_by_name()
    fitted = list[Candidate]()
    for s in screened:
        effects = (*current.effects, s.effect)
        if s.effect not in known or not model_exists(effects) or len(fitted) >= _FITTED:
            continue
        progress(f"fitting {s.effect}")
        start = {**current.values, **{k: v for k, v in s.start.items() if isinstance(v, int | float)}}
        start |= {p.name: p.nominal for p in known[s.effect].parameters if p.name not in start}
        trial = fit_trial(recordings, effects, start, fixed, segment_s, mask)
        if trial is not None and np.isfinite(trial.squares).all():
            fitted.append(Candidate(s.effect, trial, advantage(current, trial), s))
    return tuple(sorted(fitted, key=lambda c: -c.against.gain))


def _convinces(c: Candidate) -> bool:
    return c.against.low > LEAST_GAIN and c.against.delta_bic < LEAST_BIC


def _best(candidates: Sequence[Candidate]) -> Candidate | None:
    """The candidate that gains most; a smaller one that it contains, unless it earns its parameters."""
    convincing = [c for c in candidates if _convinces(c)]
    if not convincing:
        return None
    best = convincing[0]
    for smaller in convincing[1:]:
        if best.name in NESTED.get(smaller.name, ()):
            more = advantage(smaller.trial, best.trial)
            if more.low < _NESTED_GAIN or more.delta_bic > LEAST_BIC:
                return smaller
    return best


def _ties(best: Candidate, candidates: Sequence[Candidate]) -> tuple[str, ...]:
    """Names that do as well as the best in its place: tested, not assumed."""
    out = []
    for c in candidates:
        if c.name == best.name or not _convinces(c):
            continue
        difference = advantage(c.trial, best.trial)
        if difference.gain < _TIE and difference.low < 0.0:
            out.append(c.name)
    return tuple(out)


def _pruned(
    recordings: Sequence[Recording],
    current: Trial,
    added: Sequence[str],
    fixed: Mapping[str, float],
    segment_s: float,
    mask: NDArray[np.bool_],
) -> tuple[Trial, list[str]]:
    """Effects that a later one has made needless go."""
    kept = list(added)
    for name in list(added) if len(added) > 1 else []:
        effects = tuple(e for e in current.effects if e != name)
        if not model_exists(effects):
            continue
        without = fit_trial(recordings, effects, current.values, fixed, segment_s, mask)
        if without is None or not np.isfinite(without.squares).all():
            continue
        worth = advantage(without, current)
        if worth.low < LEAST_GAIN or worth.delta_bic > LEAST_BIC:
            current, kept = without, [k for k in kept if k != name]
    return current, kept
