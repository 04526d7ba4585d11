"""A model fitted to the full data: in one run with noise that enters the motor, or in free runs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from functools import cached_property

import numpy as np

from servo_daemon.diagnosis.trial.data import Data, begun
from servo_daemon.diagnosis.trial.trial import MOST_SAMPLES, Trial
from servo_daemon.errors import BadInputError, NumericalError
from servo_daemon.identification.output_error import FitOptions, OutputErrorFit, fit_output_error
from servo_daemon.identification.output_error.precision.disjoint import spread_std
from servo_daemon.identification.output_error.precision.information import wider
from servo_daemon.identification.output_error.precision.parameters import FittedParameter
from servo_daemon.identification.output_error.problem.linearisation import without_derivatives
from servo_daemon.identification.output_error.refine import Refined
from servo_daemon.identification.output_error.solver.solver import Point
from servo_daemon.identification.prediction_error import predicted_fit
from servo_daemon.identification.short_runs import by_short_runs

#: How exact a parameter can be said to be, however long the data: what dry friction or a brush drop does within a
#: sample, noise that goes through it, edges of the encoder. Measured on hidden effects: errors of 0.1 to 0.7 % where
#: the fit's own standard deviation put them at 4 to 14 σ.
_EXACT = 2.5e-3
#: Angles that differ by less are one, rad (below any encoder's step).
_ONE_PLACE = 1e-9


class FullDataFits:
    """Keeps fits of `fit_whole` to the same data: search, belief and predictions ask for the same models, and one takes
    seconds."""

    def __init__(self, data: Data) -> None:
        self._data = data
        self._known: dict[object, OutputErrorFit | None] = {}

    def of(
        self, trial: Trial, values: Mapping[str, float] | None = None, below: float = math.inf
    ) -> OutputErrorFit | None:
        """The fit of `fit_whole`, made the first time that it is asked for."""
        begin = values or trial.values
        asked = _asked(trial, begin, below)
        if asked not in self._known:
            self._known[asked] = fit_whole(self._data, trial, begin, below)
        return self._known[asked]

    def white(self, trial: Trial, start: Mapping[str, float] | None) -> OutputErrorFit | None:
        """The fit of `from_either` if the data are white with it, else None: what is not white over the first samples
        is not over all.

        Args:
            start: see `from_either`.
        """
        if self._begun is not None and not self._is_known(trial):
            with suppress(BadInputError):  # too little in these
                begun = self._begun.from_either(trial, start)
                if begun is not None and not begun.white:
                    return None
        fit = self.from_either(trial, start)
        return fit if fit is not None and fit.white else None

    def _is_known(self, trial: Trial) -> bool:
        return _asked(trial, trial.values, math.inf) in self._known

    @cached_property
    def _begun(self) -> FullDataFits | None:
        """The same over the first samples; None: there are no more."""
        first = begun(self._data.recordings, MOST_SAMPLES)
        return None if first is self._data.recordings else FullDataFits(replace(self._data, recordings=first))

    def from_either(
        self, trial: Trial, start: Mapping[str, float] | None, below: float = math.inf
    ) -> OutputErrorFit | None:
        """From where the search has come to; if the data are not white with that, from where screening put it, if they
        are then: free runs that follow a drift may have biased a spring to follow it, too.

        Args:
            start: of screening, natural values; None: there is none.
        """
        fit = self.of(trial, below=below)
        if start is None or (fit is not None and fit.white):
            return fit
        other = self.of(trial, start, below)
        return other if other is not None and other.white else fit


def _without_derivatives(fit: OutputErrorFit) -> OutputErrorFit:
    """The same in a fraction of the memory: derivatives by every sample are taken anew if they are asked for again."""

    def point(of: Point) -> Point:
        return replace(of, linearisation=without_derivatives(of.linearisation))

    def refined(of: Refined | None) -> Refined | None:
        return None if of is None else replace(of, point=point(of.point), whitened=point(of.whitened))

    return replace(
        fit,
        solution=replace(fit.solution, point=point(fit.solution.point)),
        plain=replace(fit.plain, point=point(fit.plain.point)),
        refined=refined(fit.refined),
        unsettled=refined(fit.unsettled),
    )


def _asked(trial: Trial, begin: Mapping[str, float], below: float) -> object:
    return trial.effects, tuple(sorted(trial.held.items())), tuple(sorted(begin.items())), below


def fit_full_data(
    data: Data, trial: Trial, full_fits: FullDataFits | None, start: Mapping[str, float] | None = None
) -> OutputErrorFit:
    """A trial's model fitted to all parts, with standard deviations: in one run if that explains the data to their
    noise (then noise that enters the motor is told from what the sensors add), else in the free runs of the search.

    Args:
        full_fits: over the same recordings; None: no noise that enters the motor is looked for, and the fit cannot be
            found white.
        start: where screening put it, natural values.
    """
    whole = None if full_fits is None else full_fits.white(trial, start)
    return whole or fit_runs(data, trial, trial.values, data.split.segment_s)


def fit_whole(
    data: Data, trial: Trial, values: Mapping[str, float] | None = None, below: float = math.inf
) -> OutputErrorFit | None:
    """A trial's model fitted to the full data in one run, with noise that enters the motor; None where that fails.

    Args:
        values: from these instead of the trial's.
        below: without that noise where the deviance will not come below this.
    """
    with suppress(NumericalError):
        return fit_runs(data, trial, values or trial.values, None, below)
    return None


def fit_runs(
    data: Data, trial: Trial, values: Mapping[str, float], runs_s: float | None, below: float = math.inf
) -> OutputErrorFit:
    """A trial's model fitted to the full data.

    Args:
        values: from these.
        runs_s: in free runs of this length; None: in one, with noise that enters the motor.
        below: see `fit_whole`.

    Raises:
        NumericalError: it fails.
    """
    options = FitOptions(nominal=values, fixed={**data.fixed, **trial.held}, thorough=False, deviance_below=below)
    if runs_s is not None:
        options = replace(options, segment_s=runs_s, noise_model="none")
    return _without_derivatives(honest(fit_output_error(data.recordings, trial.effects, options)))


def by_predictions(data: Data, fit: OutputErrorFit) -> OutputErrorFit:
    """The fit, or, where dry friction may hold the shaft and whole recordings are not explained to their noise, the
    same model as each sample is predicted best from those before it: noise of the voltage decides when the shaft lets
    go, and biases what is fitted to free runs."""
    in_pieces = len(fit.problem.segments) > len(data.recordings)
    if (fit.white and not in_pieces) or not fit.problem.plant.may_stick:
        return fit
    better = predicted_fit(fit, data.recordings)
    return fit if better is None else honest(better)


def over_a_gap(data: Data, fit: OutputErrorFit, begin: Mapping[str, float]) -> OutputErrorFit:
    """The fit, or, where free runs cross a gap and do not explain the data to their noise, the same model as short runs
    have it. Where these do not tell: with standard deviations that hold how far parts of the data disagree, as the sum
    of squares is rough there, and its slopes know nothing of it.

    Args:
        begin: natural values that short runs begin with.
    """
    if fit.white or "gap" not in fit.problem.free:
        return fit
    short = by_short_runs(fit, data.recordings, begin)
    if short is not None:
        return honest(short)
    spread = spread_std(fit.problem, fit.solution.point)
    if spread is None:
        return fit
    columns = {k: float(s) for k, s in enumerate(spread) if not fit.after.undetermined[k]}
    parameters = dict(fit.parameters)
    for k, s in columns.items():
        p = parameters[fit.problem.free[k]]
        if p.std is not None and p.value is not None:
            unit = abs(p.value) if fit.problem.logarithmic[k] else 1.0
            parameters[fit.problem.free[k]] = replace(p, std=max(p.std, unit * s))
    return replace(fit, after=wider(fit.after, columns), parameters=parameters)


def honest(fit: OutputErrorFit) -> OutputErrorFit:
    """With standard deviations that hold what no length of data makes smaller: a simulation from sample to sample is
    exact to a share of a parameter, and to as much of a radian of a phase; where within a count the encoder's zero
    lies is not known."""
    zero = _encoder_zero(fit)
    parameters = {
        name: p
        if p.std is None or p.value is None
        else replace(p, std=math.hypot(p.std, exactness(name, p), zero.get(name, 0.0)))
        for name, p in fit.parameters.items()
    }
    return replace(fit, parameters=parameters)


def exactness(name: str, p: FittedParameter) -> float:
    """1 σ that no length of data makes smaller, in the parameter's unit."""
    return _EXACT * (1.0 if p.unit == "rad" and name != "gap" else abs(p.value or 0.0))


def _encoder_zero(fit: OutputErrorFit) -> dict[str, float]:
    """Standard deviation of each phase over the turn for an encoder's zero that is anywhere within a count, rad."""
    channels, segments = fit.problem.channels, fit.problem.segments
    if "position_rad" not in channels:
        return {}
    column = channels.index("position_rad")
    moved = np.abs(np.concatenate([np.diff(s.measured[s.valid[:, column], column]) for s in segments]))
    step = float(np.min(moved[moved > _ONE_PLACE], initial=np.inf))
    if not math.isfinite(step):
        return {}
    phases = [name for name in fit.parameters if name.startswith("phi_") and not name.startswith("phi_per")]
    order = {name: fit.parameters.get("n" + name.removeprefix("phi")) for name in phases}
    return {
        name: (1.0 if n is None or n.value is None else n.value) * step / math.sqrt(12.0) for name, n in order.items()
    }
