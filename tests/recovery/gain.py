"""What the named causes remove of an error, against what fitting the true ones removes."""

from __future__ import annotations

from collections.abc import Mapping

from threadpoolctl import threadpool_limits

from servo_daemon.captures import Capture
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.split import CHOICE, TRAIN, segment_length_s, shorter_s
from servo_daemon.diagnosis.trial.trial import Trial, fit_trial
from servo_daemon.diagnosis.verdict.result import Diagnosis
from servo_daemon.identification.output_error import Recording
from servo_daemon.plant.build import build_plant
from tests.recovery.generator import EffectValues, Motor

#: The true causes remove at least this share of the error, or there is nothing to compare.
_REMOVED = 0.02


def of_true_structure(
    capture: Capture, diagnosis: Diagnosis, motor: Motor, effects: Mapping[str, EffectValues]
) -> float | None:
    """(b² − e²)/(b² − t²): normalised errors of held-out free runs of the linear model, of the named causes and of the
    true ones, each fitted to all other runs: the named from what the diagnosis publishes, the true from the truth.

    Runs of the diagnosis's length are compared; where a motor goes its own way within them, even with the true causes,
    shorter ones. None: nothing named, something not known to the library, or no free runs that tell.
    """
    named = tuple(e.name for e in diagnosis.effects)
    truth: dict[str, float | str] = {n: getattr(motor, n) for n in ("R", "L", "K", "J", "B")}
    truth |= {n: v for values in effects.values() for n, v in values.items()}
    found = {n: p.value for n, p in diagnosis.final.parameters.items() if p.value is not None}
    recordings = [Recording(str(capture.path), capture.block())]
    usual = segment_length_s(recordings)
    with threadpool_limits(limits=1):
        for segment_s in (usual, shorter_s(recordings, usual)):
            if not named or segment_s is None:
                break
            data = Data.of(recordings, {}, (), segment_s)
            fits = [_fitted(data, *m) for m in (((), truth), (named, found), (tuple(effects), truth))]
            if None in fits:
                continue
            b, e, t = (f.held_out.nrmse**2 for f in fits if f is not None)
            if b - t > _REMOVED * b:
                return (b - e) / (b - t)
    return None


def _fitted(data: Data, effects: tuple[str, ...], start: Mapping[str, float | str]) -> Trial | None:
    values = {}
    for p in build_plant(effects).parameters:
        value = start.get(p.name)
        if value is None:
            return None
        values[p.name] = float(p.choices.index(value)) if isinstance(value, str) else value
    return fit_trial(data, effects, values, parts=(TRAIN, CHOICE))
