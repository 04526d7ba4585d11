"""Whether a free run was biased by what adds up over time.

An angle integrates a speed, and a speed a torque: what the model lacks, a constant load of a percent or a friction that
differs by direction, makes a long free run drift away by more than anything that happens within a second. The fit then
finds the motor that drifts least, which may be far from the one that moved (EMPS with Coulomb friction alone: 200 kg of
a 95 kg axis). Free runs of a second, each from its own initial state, know nothing of the drift. Where the two
disagree, the long one is not to be believed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from servo_daemon.errors import ServoDaemonError
from servo_daemon.identification.output_error import FitOptions, OutputErrorFit, Recording, fit_output_error
from servo_daemon.identification.output_error.problem.rollout import TIME
from servo_daemon.numerics import least_squares
from servo_daemon.samples import F64, SampleBlock

#: Length of the short free runs, s, and how many of them a recording must hold for both to mean something.
SEGMENT_S, _FEWEST = 1.0, 5
#: Longest stretch that short runs are fitted to, s, all recordings together: each second has unknowns of its own.
_LONGEST_S = 30.0
#: Drift is most of what a free run leaves where a straight line over each second takes all but this share of its RMS.
_WITHIN = 0.5
#: A parameter is biased where the two differ by this share, and by more standard deviations of the short runs than
#: that.
_BENT, _SIGMA = 0.1, 4.0


@dataclass(frozen=True, slots=True)
class Drift:
    """What a fit over free runs of `SEGMENT_S` says instead.

    Attributes:
        share: of the long run's residual (RMS) that is drift, of the channel that drifts most.
        channel: that channel.
        biased: by name, natural units: values over the long run (None: not determined) and over short ones.
    """

    share: float
    channel: str
    biased: Mapping[str, tuple[float | None, float]]


def drift_of(fit: OutputErrorFit, recordings: Sequence[Recording], options: FitOptions) -> Drift | None:
    """None where the data are explained, do not drift, or short free runs give the same motor.

    Args:
        fit: of these recordings with these options.
    """
    if fit.white or options.segment_s is not None:
        return None
    channel, share = max(_drifting(fit).items(), key=lambda item: item[1])
    if 1.0 - share**2 > _WITHIN**2:
        return None
    try:
        few = [Recording(r.name, _first(r, _LONGEST_S / len(recordings))) for r in recordings]
        short = fit_output_error(
            few, fit.problem.plant.effects, replace(options, segment_s=SEGMENT_S, noise_model="none", misfit=False)
        )
    except ServoDaemonError:  # too little in a second
        return None
    biased = _biased(fit, short)
    return Drift(share, channel, biased) if biased else None


def _first(recording: Recording, seconds: float) -> SampleBlock:
    time = recording.block.time_s
    return recording.block.slice(0, int(np.searchsorted(time, time[0] + seconds, side="right")))


def _biased(long: OutputErrorFit, short: OutputErrorFit) -> dict[str, tuple[float | None, float]]:
    out = {}
    for name, there in short.parameters.items():
        here = long.parameters[name]
        if there.value is None or not there.std or there.std > _BENT * abs(there.value):
            continue  # a second does not show it
        seen = here.value if here.status == "estimated" else None
        apart = np.inf if seen is None else abs(seen - there.value)
        if apart > max(_BENT * abs(there.value), _SIGMA * there.std):
            out[name] = (seen, there.value)
    return out


def _drifting(fit: OutputErrorFit) -> dict[str, float]:
    """By channel, the share of the residual's RMS that straight lines over each second take."""
    out = {}
    residuals = fit.plain.point.linearisation.residuals
    for c, name in enumerate(fit.problem.channels):
        whole = left = 0.0
        for segment, r in zip(fit.problem.segments, residuals, strict=True):
            time = segment.rows[:, TIME]
            pieces = int((time[-1] - time[0]) / SEGMENT_S)
            if pieces >= _FEWEST:
                whole += float(r[:, c] @ r[:, c])
                left += _without_lines(time, r[:, c], pieces)
        out[name] = float(np.sqrt(1.0 - left / whole)) if whole > 0 else 0.0
    return out


def _without_lines(time: F64, residual: F64, pieces: int) -> float:
    """Sum of squares after a straight line has been taken off each piece."""
    left = 0.0
    for begin, end in pairwise(np.linspace(0, len(time), pieces + 1).astype(int).tolist()):
        A = np.column_stack([np.ones(end - begin), time[begin:end] - time[begin]])
        line, _ = least_squares(A, residual[begin:end])
        left += float(np.sum((residual[begin:end] - A @ line) ** 2))
    return left
