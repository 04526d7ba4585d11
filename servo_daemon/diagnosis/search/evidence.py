"""What counts as evidence for an effect: the thresholds of the search, and the tests that use them.

An effect must predict free runs that were not fitted, its parameters must be worth their place, and it must be larger
than what encoders and converters feign.

A threshold without a reason beside it was set by hand. The matrix of hidden effects (docs/benchmarks.md) is what judges
them all together; `make calibrate` prints for each what it is compared with where there is something and where not.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from servo_daemon.diagnosis.missing.missing import Missing
from servo_daemon.diagnosis.trial.compare import Advantage, advantage, bootstrapped
from servo_daemon.diagnosis.trial.scored import Scored
from servo_daemon.diagnosis.trial.trial import Trial
from servo_daemon.identification.output_error import OutputErrorFit
from servo_daemon.plant.effects import effects_by_name

#: Least gain of a new effect: error of the free runs (log of its RMS; the 98 % interval must be above 0), and BIC
#: (chosen; not tried).
LEAST_GAIN, LEAST_BIC = 0.03, -20.0
#: Share of the gain that is none: where the motor moves in few of the runs that decide, some resamples hold none of
#: these and neither gain nor lose (chosen; not tried).
_NOTHING = 0.01
#: Least torque or voltage of an effect that has one, as a share of what the motor works with (as
#: `screening.dependence.LEAST_SIZE`).
LEAST_SHARE = 2e-3
#: Least share of the removable error that one effect takes of what the others leave, and that all take together
#: (chosen; not tried).
LEAST_OWN, LEAST_TOGETHER = 0.5, 0.75
#: BIC of an effect that screening thought little of: some twenty, of which one gains a little by chance (chosen; not
#: tried).
_UNSEEN_BIC = -100.0
#: Least part of the squared error that the search began with: without it a torque ripple of 0.06 % got a name.
_LEAST_OF_ALL = 1e-4
#: Least inertia behind a spring or a gap, as a share of the motor's: one of nothing fits anything (a drive's lag did;
#: chosen; not tried).
_LEAST_INERTIA = 0.02
#: Candidates whose gain is within this of the best, and that resampling cannot tell from it, are equivalent (chosen;
#: not tried).
_TIE = 0.02
#: What a simpler model may lose at the end of a search (chosen; not tried).
_LITTLE_LOST = 0.01
#: A nested effect with more parameters must gain this much over the smaller one (chosen; not tried).
NESTED_GAIN = 0.02
#: BIC that no wrong model earns by chance or by an integrator's error (record 73 of docs/decisions.md: clean captures
#: leave a thousandth of it), and the gain that must come with it.
OVERWHELMING_BIC, _CLEARLY = -1000.0, 0.1
#: Lower end of a gain that needs no other evidence (chosen; not tried).
PLAINLY = 0.2
#: What is late is so by this share of a sample, at least: L takes what is less (chosen; not tried).
_LEAST_LATE = 0.1
_SERIES = {"N·m": "torque", "V": "voltage"}


def convinces(a: Advantage) -> bool:
    """Whether an effect's advantage is more than chance."""
    return overwhelming(a) or (a.gain > LEAST_GAIN and a.low > -_NOTHING * a.gain and a.delta_bic < LEAST_BIC)


def half_convinces(a: Advantage) -> bool:
    """Much better in the mean and where it was fitted, and not in every part that decides."""
    return a.gain > _CLEARLY and a.delta_bic < LEAST_BIC


def speaks_against_screening(a: Advantage) -> bool:
    """Whether the advantage of a candidate is one although screening saw nothing of it. There are twenty such, and one
    of them will gain a little by chance."""
    return at_odds(a) or a.delta_bic < _UNSEEN_BIC


def needless(lost: Advantage) -> bool:
    """Whether the simpler model does as well: what it loses is nothing, or neither the runs that decide (resampled) nor
    those that were fitted say that it loses anything."""
    return not convinces(lost) and (lost.gain < _LITTLE_LOST or (lost.low < 0.0 and lost.delta_bic > 0.0))


def no_worse(trial: Trial, best: Trial) -> bool:
    """Whether resampling cannot tell them apart and what it gains less is nothing."""
    difference = advantage(trial, best)
    return difference.gain < _TIE and difference.low < 0.0 and difference.delta_bic > OVERWHELMING_BIC


def likelier(trial: Trial, other: Trial) -> bool:
    """Whether the fitted part speaks for one of two models of as many parameters that the runs that decide cannot tell
    apart: those drift with the drive's noise, which may hide what a fit sees."""
    difference = advantage(other, trial)
    return trial.free == other.free and difference.high > 0.0 and difference.delta_bic < LEAST_BIC


def ties_with(scored: Scored, best: Scored) -> bool:
    """Whether two models tie by their errors alone."""
    gain, low, _ = bootstrapped(scored, best)
    return gain < _TIE and low < 0.0


def overwhelming(a: Advantage) -> bool:
    """Better where it decides, and far better where it was fitted, though a few free runs may be none the better for
    it: of a motor with a gap those that begin within it. Or better by so much where it decides that the fitted part,
    whose residuals may be one slow drift and count as a handful of samples, need not say so, too."""
    return (a.gain > _CLEARLY and a.delta_bic < OVERWHELMING_BIC) or a.low > PLAINLY


def at_odds(a: Advantage) -> bool:
    """Far better where it was fitted, and not where it decides: a simulation that runs away from what it was fitted to
    within a free run says nothing about the model."""
    return a.delta_bic < OVERWHELMING_BIC and not convinces(a)


def noticeable(name: str, trial: Trial | OutputErrorFit, missing: Missing) -> bool:
    """Whether an effect's torques and voltages are a noticeable share of what the motor works with, and its load's
    inertia of the motor's: encoders feign less. Of a friction the level at speed counts, not that of the first step out
    of rest."""
    effect, values = effects_by_name()[name], trial.values
    if "J_l" in (p.name for p in effect.parameters):
        return values["J_l"] > _LEAST_INERTIA * values["J"]
    shares = working_shares((name,), trial, missing)
    shares |= {p: abs(values[p]) / (values[over] if over else 1.0) for p, over in effect.share_of.items()}
    shares.pop("Ts", None)
    if effect.late and values[effect.late] < _LEAST_LATE * trial.problem.sample_period_s:
        return False
    return (not shares or max(shares.values()) > LEAST_SHARE) and effect.possible(values)


def are_what_they_are_called(names: Iterable[str], values: Mapping[str, float]) -> bool:
    """Whether effects with these values are what their names say."""
    return all(effects_by_name()[name].true_to_name(values) for name in names)


def worth_a_name(trial: Trial, current: Trial, base: Trial) -> bool:
    """Whether a model takes enough of the error of the one that the search began with: beside an effect that takes
    nearly all of it the next one may describe how far the simulation of the first is exact."""
    return current.choice.nrmse**2 - trial.choice.nrmse**2 > _LEAST_OF_ALL * base.choice.nrmse**2


def working_shares(names: Iterable[str], trial: Trial | OutputErrorFit, missing: Missing) -> dict[str, float]:
    """The effects' torques and voltages, by parameter, as shares of what the motor works with."""
    known = effects_by_name()
    return {
        p.name: abs(trial.values[p.name]) / missing.size[_SERIES[p.unit]]
        for name in names
        for p in known[name].parameters
        if _SERIES.get(p.unit) in missing.size
    }
