"""Scores on captures that the fit has not seen, as they come and after friction and offsets have settled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from servo_daemon.captures import Capture
from servo_daemon.errors import BadInputError
from servo_daemon.identification.output_error import (
    OutputErrorFit,
    Recording,
)
from servo_daemon.identification.output_error.problem.score import Score, score
from servo_daemon.identification.output_error.problem.setup import FEWEST_SAMPLES, choose_signals
from servo_daemon.identification.procedure.bands import bands_of
from servo_daemon.identification.procedure.settle import moved, settled_coordinates
from servo_daemon.kalman.gaussian import natural_values as values_of
from servo_daemon.plant.core import Drive
from servo_daemon.samples import F64, SampleBlock

#: Of a model that does not explain its own data the errors are so many times larger where something has changed:
#: between the halves of one capture of the EMPS axis 1.1 to 1.8, and with 2.8 % more friction 2.3 to 3.6.
_ANOTHER_DAY = 2.0
#: So many unknowns may settle on what may be the same day.
_MOST_OF_ONE_DAY = 1


@dataclass(frozen=True, slots=True)
class Validation:
    """Of one capture: the model without the chosen effects, with them (None: there are none), and that one after
    friction and offsets have settled on its first part (None: not asked for)."""

    capture: Capture
    baseline: Score
    extended: Score | None
    adapted: Score | None
    settled: Mapping[str, float]


def natural_values(fit: OutputErrorFit) -> dict[str, float]:
    """The values that the fit's simulation runs with, also of what the data leave open; natural units. Offsets that
    every recording has for itself: their mean."""
    return values_of(fit.problem.plant.parameters, _mean_coordinates(fit))


def _mean_coordinates(fit: OutputErrorFit) -> F64:
    return fit.problem.mean_coordinates(fit.solution.point.unknowns)


def scored(capture: Capture, fit: OutputErrorFit) -> Score:
    """The fitted model's free runs over a capture.

    Raises:
        BadInputError: the capture lacks the model's input or response.
    """
    check_input(capture, fit.problem.plant.drive)
    return score(_comparable(capture, fit), fit.problem.plant, _mean_coordinates(fit))


def _scored_with_bands(capture: Capture, fit: OutputErrorFit, fitted: Sequence[Recording]) -> Score:
    check_input(capture, fit.problem.plant.drive)
    return _with_intervals(_comparable(capture, fit), fit, _mean_coordinates(fit), fitted, another_day=True)


def _with_intervals(
    block: SampleBlock, fit: OutputErrorFit, q: F64, fitted: Sequence[Recording], *, another_day: bool
) -> Score:
    bands = bands_of(block, fit, q, fitted, another_day=another_day)
    found = score(block, fit.problem.plant, q)
    return found if bands is None else replace(found, intervals=bands.intervals())


def _comparable(capture: Capture, fit: OutputErrorFit) -> SampleBlock:
    """Its samples, without a current that the fit can say nothing of: the motion alone determines three of R, L, K, J
    and B, and with R or K the current stays open, unless what was told settles them."""
    block, problem = capture.block(), fit.problem
    known = all(p.value is not None for name, p in fit.parameters.items() if name in ("R", "K"))
    is_given = problem.plant.drive != "voltage" or "current_A" in problem.channels  # as the input, or to fit
    return block if known or is_given else replace(block, current_A=None)


def validated(
    capture: Capture,
    baseline: OutputErrorFit,
    extended: OutputErrorFit | None,
    fitted: Sequence[Recording],
    adapt: float | None,
) -> Validation:
    """All scores of one capture.

    Args:
        fitted: the recordings of both fits.
        adapt: share of the capture, from its beginning, on which friction and offsets may settle; the rest is scored.

    Raises:
        BadInputError: see `scored`; or the capture is too short for that.
    """
    best = extended or baseline
    after, settled = (None, {}) if adapt is None else adapted_share(capture, best, fitted, adapt)
    return Validation(
        capture,
        _scored_with_bands(capture, baseline, fitted),
        None if extended is None else _scored_with_bands(capture, extended, fitted),
        after,
        settled,
    )


def adapted_share(
    capture: Capture, fit: OutputErrorFit, fitted: Sequence[Recording], share: float
) -> tuple[Score, dict[str, float]]:
    """The score on the rest of a capture after friction and offsets have settled on its first share, and what they
    settled at, natural units; nothing settles where the first share is predicted as well as what was fitted, or does
    not tell.

    Args:
        fitted: the recordings of the fit.

    Raises:
        BadInputError: either part has too few samples.
    """
    check_input(capture, fit.problem.plant.drive)
    check_share(capture, share)
    block, cut = _comparable(capture, fit), round(share * len(capture))
    first, rest = block.slice(0, cut), block.slice(cut, len(block))
    plant = fit.problem.plant
    # Friction of which the model knows no better varies from motion to motion: there one scale is all that may settle,
    # unless the first part is clearly not predicted as well as what was fitted.
    most = len(plant.parameters) if fit.white or _is_another_day(first, fit, fitted) else _MOST_OF_ONE_DAY
    candidate, q = settled_coordinates(first, plant, _mean_coordinates(fit), most)
    settled = _with_intervals(rest, fit, q, fitted, another_day=not candidate.by.size)
    return settled, dict(moved(plant, candidate, q))


def _is_another_day(first: SampleBlock, fit: OutputErrorFit, fitted: Sequence[Recording]) -> bool:
    """Whether runs of 1 s over these samples are off by much more than over those that were fitted."""
    there = [score(r.block, fit.problem.plant, fit.coordinates(k)).rmse_1s for k, r in enumerate(fitted)]
    here = score(first, fit.problem.plant, _mean_coordinates(fit)).rmse_1s
    # An angle adds up what a speed is off by: what it comes to hangs on where the runs begin.
    channels = [c for c in here if c in there[0] and c != "position_rad"] or list(here)
    sizes = [len(r.block) for r in fitted]
    return any(
        here[c] > _ANOTHER_DAY * np.sqrt(np.average([np.square(t[c]) for t in there], weights=sizes)) for c in channels
    )


def check_input(capture: Capture, wanted: Drive) -> None:
    """That a capture drives a model by the same signal as those that it was fitted to.

    Raises:
        BadInputError: it does not.
    """
    drive, _ = choose_signals(capture.channels)
    if drive != wanted:
        have = ", ".join(capture.channels)
        raise BadInputError(f"{capture.path}: the fitted model is driven by {wanted}; this capture has {have}")


def check_share(capture: Capture, share: float) -> None:
    """That both parts of a capture have samples enough, the one that adapts and the rest that is scored.

    Raises:
        BadInputError: one has not.
    """
    n = len(capture)
    if min(cut := round(share * n), n - cut) < FEWEST_SAMPLES:
        raise BadInputError(f"{capture.path}: {n} samples are too few to adapt on {share:g} of them")
