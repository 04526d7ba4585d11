"""Model discrepancy: the unmodelled torque and voltage of a fitted model over its longest recording."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from servo_daemon.diagnosis.missing.balance import balanced_missing_inputs
from servo_daemon.diagnosis.missing.missing import Fitted, Missing, missing_inputs
from servo_daemon.diagnosis.missing.noise_levels import NoiseLevels
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.trial import Trial
from servo_daemon.errors import NumericalError

#: For screening the unmodelled torque and voltage walk at least by this share of the working ones in this time, s. A
#: cause that changes fast (a ripple over the turn) may look most like white noise of the voltage; taken for that,
#: nothing of it is left to screen (decision 66).
_LEAST_WALK, _WITHIN_S = 1e-3, 0.01
#: … and white noise of the input is at most this share of the working input: converters are better, and friction that
#: sticks and slides passes for noise of the voltage as large as the voltage itself (decision 66).
_MOST_INPUT = 0.05


def longest_missing(data: Data, fit: Fitted, levels: NoiseLevels | None = None) -> Missing:
    """Unmodelled torque and voltage of the longest recording under a fitted model, at parameters that leave little of
    it.

    Args:
        levels: of the noise and of the walks, where they are known; None: by maximum likelihood.

    Raises:
        NumericalError: see `balanced_missing_inputs`.
    """
    number = data.longest
    longest = data.recordings[number]
    return balanced_missing_inputs(fit, longest.block, recording=number, seen=longest.seen, levels=levels)


def if_noise(data: Data, fit: Fitted, missing: Missing) -> Missing:
    """What is missing where the likelihood may call all of it noise: for whether a model explains its data.

    Args:
        missing: of `longest_missing`; it is the answer where the passes with so much noise leave the range of numbers.
    """
    number = data.longest
    longest = data.recordings[number]
    try:
        return missing_inputs(
            fit,
            longest.block,
            recording=number,
            coordinates=missing.coordinates,
            seen=longest.seen,
            noise_first=True,
        )
    except NumericalError:
        return missing


def seen_missing(data: Data, trial: Trial) -> Missing:
    """As `longest_missing`, for screening: never all of it taken for noise.

    Raises:
        NumericalError: see `balanced_missing_inputs`.
    """
    number, missing = data.longest, longest_missing(data, trial)
    least = {name: (_LEAST_WALK * size) ** 2 / _WITHIN_S for name, size in missing.size.items()}
    most = most_input_var(missing)
    levels = missing.levels
    if levels.input_var > most or any(walk < least[name] for name, walk in levels.walk.items()):
        missing = missing_inputs(
            trial,
            data.recordings[number].block,
            recording=number,
            coordinates=missing.coordinates,
            levels=replace(levels, input_var=min(levels.input_var, most)),
            least_walk=least,
            seen=data.recordings[number].seen,
        )
    return missing


def most_input_var(missing: Missing) -> float:
    """The most that white noise of the input can be, squared; infinite where there is no input."""
    return _MOST_INPUT**2 * float(np.mean(np.square(missing.input))) or math.inf


def leaves(data: Data, trial: Trial, before: Missing) -> float:
    """Mean square of what a model leaves missing over what was missing before (of `seen_missing`); infinite where it
    cannot be computed."""
    try:
        return _size(seen_missing(data, trial)) / max(_size(before), 1e-300)
    except NumericalError:
        return math.inf


def leaves_less(data: Data, trial: Trial, other_data: Data, other: Trial) -> bool:
    """Whether one model has a smaller discrepancy than another."""
    try:
        return _size(longest_missing(data, trial)) < _size(longest_missing(other_data, other))
    except NumericalError:
        return False


def _size(missing: Missing) -> float:
    """Mean square of torque and voltage together."""
    return sum(missing.mean_square.values())
