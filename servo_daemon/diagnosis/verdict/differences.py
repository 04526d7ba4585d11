"""What differs between captures that one model is fitted to: friction 3 % higher on the second day."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.stats import chi2

from servo_daemon.diagnosis.verdict.result import OwnModel, Spread
from servo_daemon.identification.output_error import FitOptions, OutputErrorFit, Recording, fit_output_error
from servo_daemon.identification.output_error.problem.score import score
from servo_daemon.identification.procedure.validate import natural_values

#: Differences that chance makes this rarely, and that are no smaller than this share of the value (chosen; not tried).
_CHANCE, _LEAST = 1e-4, 0.005


def differences(
    recordings: Sequence[Recording], fit: OutputErrorFit, held: Mapping[str, float], segment_s: float
) -> tuple[tuple[Spread, ...], tuple[OwnModel, ...]]:
    """Parameters that differ, and every capture's free run with the shared and with its own parameters.

    Args:
        fit: to all recordings together.
        held: parameters that no fit may move, natural units.
        segment_s: length of the free runs that are fitted.
    """
    if len(recordings) < 2:
        return (), ()
    options = FitOptions(nominal=natural_values(fit), fixed=held, segment_s=segment_s, thorough=False)
    own = [fit_output_error([r], fit.problem.plant.effects, options) for r in recordings]
    spreads = tuple(s for name in fit.problem.free if (s := _spread(name, own)) is not None)
    models = []
    for number, (recording, alone) in enumerate(zip(recordings, own, strict=True)):
        shared = score(recording.block, fit.problem.plant, fit.coordinates(number))
        mine = score(recording.block, alone.problem.plant, alone.coordinates())
        models.append(OwnModel(recording.name, dict(shared.rmse), dict(mine.rmse)))
    return spreads, tuple(models)


def _spread(name: str, fits: Sequence[OutputErrorFit]) -> Spread | None:
    """The parameter's values if they differ by more than chance explains (weighted mean, χ² about it)."""
    found = [f.parameters[name] for f in fits]
    values = [p.value for p in found]
    stds = [p.std for p in found]
    if any(v is None for v in values) or any(not s for s in stds):
        return None
    value, std = np.array(values, dtype=float), np.array(stds, dtype=float)
    mean = float(np.sum(value / std**2) / np.sum(std**-2.0))
    distance = float(np.sum(((value - mean) / std) ** 2))
    large = float(np.ptp(value)) > _LEAST * abs(mean)
    if not large or chi2.sf(distance, len(fits) - 1) > _CHANCE:
        return None
    return Spread(name, tuple(value.tolist()), tuple(std.tolist()))
