"""The paper's third method on one recording: a model trained around this drive, and what it says of the windows."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from servo_daemon.errors import BadInputError, ServoDaemonError
from servo_daemon.identification.inverse_dynamics.estimate import Estimate
from servo_daemon.learning.examples.drawing import CORE, TrainingSpec
from servo_daemon.learning.examples.drive import rounded_rate, trainable
from servo_daemon.learning.examples.targets import baseline
from servo_daemon.learning.examples.training import TARGETS, cut_windows
from servo_daemon.learning.features.features import compute_features
from servo_daemon.learning.model.model import LearnedModel
from servo_daemon.numerics import sample_period
from servo_daemon.parameters import LINEAR
from servo_daemon.samples import F64, SampleBlock

#: Length of a window, s (chosen; not tried).
_LONGEST_S, _SHORTEST_S = 5.0, 2.0
#: Without a datasheet: around this recording's own regression, rounded so that captures of one motor share a model.
_OWN_SPREAD, _ROUND = 2.0, 0.2
_NEEDED = ("voltage_V", "current_A")

#: A trained model for what is to be simulated, and a remark on it for the reader.
ModelFor = Callable[[TrainingSpec], tuple[LearnedModel, str]]


def learned_method(
    block: SampleBlock,
    *,
    effects: tuple[str, ...],
    nominal: Mapping[str, float],
    counts_per_rev: float | None,
    model_for: ModelFor,
) -> tuple[dict[str, Estimate], tuple[str, ...]]:
    """R, L, K, J, B (and Tc, where the model has dry friction) of a recording.

    Args:
        nominal: the datasheet; without all five the model is trained around the recording's own regression.
        model_for: trains, or finds a trained model.

    Raises:
        ServoDaemonError: the recording lacks a signal, is too short, or every window is declined; says why.
    """
    missing = [n for n in _NEEDED if getattr(block, n) is None]
    if missing:
        raise ServoDaemonError(f"no {', '.join(missing)}: the features of this method need it")
    seconds = float(block.time_s[-1] - block.time_s[0])
    if seconds < _SHORTEST_S:
        raise ServoDaemonError(f"windows of {_SHORTEST_S:g} s are needed, there are {seconds:.2g} s to learn from")
    window_s = min(_LONGEST_S, math.floor(seconds))
    features = _features(block, window_s)
    known = all(n in nominal for n in CORE)
    centre = {n: nominal[n] for n in nominal} if known else _own_centre(features)
    rate = 1.0 / sample_period(block.time_s)
    spec = TrainingSpec(
        centre,
        effects,
        spread=3.0 if known else _OWN_SPREAD,
        rate_hz=rounded_rate(rate),
        window_s=window_s,
        counts_per_rev=counts_per_rev,
        channels=trainable(block.channels),
    )
    model, remark = model_for(spec)
    found, note = _combined(model, features)
    notes = [remark, note]
    if not known:
        notes.append("no datasheet (--config): trained around this capture's own regression")
    return _estimates(found, effects), tuple(n for n in notes if n)


def _features(block: SampleBlock, window_s: float) -> F64:
    rows, why = [], ""
    for window in cut_windows(block, window_s):
        try:
            rows.append(compute_features(window))
        except BadInputError as error:
            why = str(error)
    if not rows:
        raise ServoDaemonError(why or "no window has usable samples")
    return np.array(rows)


def _own_centre(features: F64) -> dict[str, float]:
    """R, L, K, J, B by the windows' regressions, on a coarse logarithmic grid."""
    base = baseline(features, dict.fromkeys(CORE, 1.0), 1e30)
    if not base.known.any():
        raise ServoDaemonError(
            "the motion determines no regression, and there is no datasheet (--config) to begin with"
        )
    centre = np.median(base.centre[base.known], axis=0)[: len(CORE)]
    return {n: float(f"{np.exp(_ROUND * round(c / _ROUND)):.6g}") for n, c in zip(CORE, centre, strict=True)}


def _combined(model: LearnedModel, features: F64) -> tuple[tuple[F64, F64], str]:
    """Value and std over the windows that are accepted: their errors have causes in common, so that more windows make
    the median steadier and not the std smaller."""
    p = model.predict(features)
    if not p.accepted.any():
        raise ServoDaemonError(f"declined: {next(r for r in p.declined if r)}")
    n, total = int(p.accepted.sum()), len(p.accepted)
    note = "" if n == total else f"{total - n} of {total} windows declined: {next(r for r in p.declined if r)}"
    return (np.median(p.value[p.accepted], axis=0), np.median(p.std[p.accepted], axis=0)), note


def _estimates(found: tuple[F64, F64], effects: tuple[str, ...]) -> dict[str, Estimate]:
    units = {p.name: p.unit for p in LINEAR} | {"Tc": "N·m"}
    wanted = [n for n in TARGETS if n != "Tc" or "coulomb_friction" in effects]
    value, std = (dict(zip(TARGETS, x.tolist(), strict=True)) for x in found)
    return {n: Estimate(value[n], std[n], units[n]) for n in wanted}
