"""Features of a window of operation: the same function live, in `compare` and in training.

Everything is computed on whole arrays; a window that lacks a signal (no current) has NaN for the features that need it.
"""

from __future__ import annotations

import numpy as np

from servo_daemon.learning.features import catalogue
from servo_daemon.learning.features.balance_features import balance_features, regression, regression_features
from servo_daemon.learning.features.signal_features import motion_features, spectrum_features, statistics_features
from servo_daemon.learning.features.window import Window, prepare
from servo_daemon.samples import F64, SampleBlock

#: No feature is larger: what overflows is no number.
_LARGEST = 1e30
_POSITIVE = np.array([f.scale == "log" for f in catalogue.FEATURES])


def compute_features(block: SampleBlock) -> F64:
    """All features of a window, shape (len(catalogue.FEATURES),), in their units; NaN where one cannot be had.

    Args:
        block: 2 to 10 s of samples.

    Raises:
        BadInputError: the window is too short, too long, mostly unusable, or no motion is measured.
    """
    return features_of(prepare(block))


def features_of(w: Window) -> F64:
    """The same, of a window that is prepared already."""
    rms = np.sqrt(np.mean(np.square(w.even), axis=1))
    found = regression(w) if w.stretch.voltage is not None and w.stretch.current is not None else None
    values = regression_features(found, float(rms[0]), float(rms[1]))
    values |= balance_features(w, values, rms)
    values |= spectrum_features(w)
    values |= statistics_features(w, rms)
    values |= motion_features(w, rms)
    out = np.array([values.get(name, np.nan) for name in catalogue.NAMES])
    out[~(np.abs(out) < _LARGEST)] = np.nan
    return out


def transformed(features: F64) -> F64:
    """As they are learned: logarithms of the positive ones; NaN where one is not positive. Shape (…, features)."""
    out = np.array(features, dtype=np.float64)
    logs = out[..., _POSITIVE]
    with np.errstate(invalid="ignore", divide="ignore"):
        logs = np.where(logs > 0.0, np.log(np.maximum(logs, 1e-12)), np.nan)
    out[..., _POSITIVE] = logs
    return out
