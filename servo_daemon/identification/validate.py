"""Scores on captures that the fit has not seen, as they come and after friction and offsets have settled."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from servo_daemon.captures import Capture
from servo_daemon.errors import BadInputError
from servo_daemon.estimators.output_error import FitOptions, OutputErrorFit, Recording, fit_output_error
from servo_daemon.estimators.output_error.score import Score, score
from servo_daemon.estimators.output_error.setup import FEWEST_SAMPLES, OFFSETS, choose_signals
from servo_daemon.plant.parameters import Parameter
from servo_daemon.samples import F64

#: What changes from day to day: friction by temperature and grease, offsets of sensors and load.
SETTLING = ("B", "B_neg", "Tc", "Tc_neg", "Ts", "mu", "c2", *OFFSETS)


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
    per_recording = np.array([fit.coordinates(k) for k in range(fit.problem.recordings)])
    mean = per_recording.mean(axis=0)
    return {p.name: _natural(p, float(c)) for p, c in zip(fit.problem.plant.parameters, mean, strict=True)}


def _natural(p: Parameter, coordinate: float) -> float:
    return float(np.exp(coordinate)) if p.transform == "log" else coordinate


def _mean_coordinates(fit: OutputErrorFit) -> F64:
    return np.asarray(np.mean([fit.coordinates(k) for k in range(fit.problem.recordings)], axis=0))


def scored(capture: Capture, fit: OutputErrorFit) -> Score:
    """The fitted model's free runs over a capture.

    Raises:
        BadInputError: the capture lacks the model's input or response.
    """
    _same_input(capture, fit)
    return score(capture.block(), fit.problem.plant, _mean_coordinates(fit))


def validated(
    capture: Capture, baseline: OutputErrorFit, extended: OutputErrorFit | None, adapt: float | None
) -> Validation:
    """All scores of one capture.

    Args:
        adapt: share of the capture, from its beginning, on which friction and offsets may settle; the rest is scored.

    Raises:
        BadInputError: see `scored`; or the capture is too short for that.
    """
    best = extended or baseline
    after, settled = (None, {}) if adapt is None else adapted_share(capture, best, adapt)
    return Validation(
        capture,
        scored(capture, baseline),
        None if extended is None else scored(capture, extended),
        after,
        settled,
    )


def adapted_share(capture: Capture, fit: OutputErrorFit, share: float) -> tuple[Score, dict[str, float]]:
    """The score on the rest of a capture after friction and offsets have settled on its first share, and what they
    settled at, natural units.

    Raises:
        BadInputError: either part has too few samples.
    """
    _same_input(capture, fit)
    block, cut = capture.block(), round(share * len(capture))
    if min(cut, len(block) - cut) < FEWEST_SAMPLES:
        raise BadInputError(f"{capture.path}: {len(block)} samples are too few to adapt on {share:g} of them")
    values = natural_values(fit)
    held = {name: v for name, v in values.items() if name not in SETTLING}
    free = [name for name in values if name in SETTLING]
    if not free:
        return score(block.slice(cut, len(block)), fit.problem.plant, _mean_coordinates(fit)), {}
    found = fit_output_error(
        [Recording(str(capture.path), block.slice(0, cut))],
        fit.problem.plant.effects,
        FitOptions(nominal=values, fixed=held),
    )
    settled = natural_values(found)
    rest = score(block.slice(cut, len(block)), found.problem.plant, _mean_coordinates(found))
    return rest, {name: settled[name] for name in free}


def _same_input(capture: Capture, fit: OutputErrorFit) -> None:
    drive, _ = choose_signals(capture.channels)
    wanted = fit.problem.plant.drive
    if drive != wanted:
        have = ", ".join(capture.channels)
        raise BadInputError(f"{capture.path}: the fitted model is driven by {wanted}; this capture has {have}")
