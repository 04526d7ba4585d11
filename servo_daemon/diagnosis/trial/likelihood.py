"""Whether data that a model explains to their noise need an effect at all.

Free runs add up what the recorded voltage does not show: over half a second a light motor drifts off by a dozen encoder
steps, and an effect with a memory of its own (a winding that warms up within a second) can be fitted to follow the very
drift that came up, on runs that were held out too where these lie between the others. A fit that takes this noise for
what it is needs no such help. Where both models, with noise that enters the motor, are white over the whole recording,
their likelihoods can be compared (Schwarz 1978): twice the logarithm of their ratio was −2 to 4 for a winding's heat on
five clean captures, as chance has it, and 104 on one where it was hidden.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from servo_daemon.diagnosis.trial.trial import Trial
from servo_daemon.identification.output_error import OutputErrorFit

#: Beyond what its parameters cost an effect makes the data likelier by this, twice the logarithm.
_LIKELIER = 30.0
#: An effect without which the free runs that decide are so many times worse is needed in any case.
_PLAINLY = 2.0


#: Fits a trial's model to the full data from these values, with noise that enters the motor; None where that fails.
Whole = Callable[[Trial, Mapping[str, float]], OutputErrorFit | None]


def needs_no_effect(without: Trial, rich: Trial, whole: Whole) -> bool:
    """Whether the data are white and as likely under a model as under a richer one that free runs prefer.

    Args:
        whole: fits to all the data.
    """
    simple = white_without(without, rich, whole)
    extended = None if simple is None else whole(rich, rich.values)
    if simple is None or extended is None:
        return False
    return extended.white and not far_likelier(extended, simple)


def white_without(without: Trial, rich: Trial, whole: Whole) -> OutputErrorFit | None:
    """The fit of a model to all the data, if they are white with it; None: not, or it is not asked, because free runs
    are plainly better under a richer one.

    Args:
        whole: see `needs_no_effect`.
    """
    simple = None if plainly_worse(without, rich) else whole(without, without.values)
    return simple if simple is not None and simple.white else None


def plainly_worse(without: Trial, rich: Trial) -> bool:
    """Whether the free runs that decide are so many times worse as no drift of theirs makes them: then a fit to
    everything, which takes its time, need not be asked."""
    return without.choice.nrmse > _PLAINLY * rich.choice.nrmse


def as_likely(without: Trial, extended: OutputErrorFit, whole: Whole) -> bool:
    """Whether the data are white and as likely without; fitted from where it is, and, as the richer model may only have
    found the way out of a valley, from where that came to."""
    came_to = {name: value for name, value in extended.values.items() if name in without.values}
    for values in (without.values, {**without.values, **came_to}):
        fit = whole(without, values)
        if fit is not None and fit.white and not far_likelier(extended, fit):
            return True
    return False


def far_likelier(rich: OutputErrorFit, simple: OutputErrorFit) -> bool:
    """Whether the data are likelier under the richer model by much more than its parameters cost (Schwarz 1978); not
    where either deviance is not known. That of the simpler one counts as the best that it may be."""
    if rich.deviance is None:
        return False
    return rich.deviance <= far_below(simple, len(rich.problem.free))


def far_below(simple: OutputErrorFit, free: int) -> float:
    """The deviance that a model with so many free parameters must not exceed to be far likelier; none is low enough
    where the simpler one's is not known."""
    if simple.deviance_at_best is None:
        return -math.inf
    cost = (free - len(simple.problem.free)) * math.log(max(float(simple.problem.counts.sum()), 2.0))
    return simple.deviance_at_best - cost - _LIKELIER
