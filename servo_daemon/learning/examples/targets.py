"""What is learned of a window: the parameters themselves, or what the window's own regression gets wrong.

Two targets. "value" is the paper's: log(P / P_nominal). "correction" is log(P / P_regression) in units of what the
regression says of its own error: windows in which it is poor and windows in which it is good are then alike, and no few
poor ones rule the fit. Dry friction may be nothing, so it is learned as a share of the torque at
the current's RMS, not as a logarithm.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from servo_daemon.learning.examples.training import TARGETS
from servo_daemon.learning.features import catalogue
from servo_daemon.samples import F64

Target = Literal["value", "correction"]
TARGET_KINDS: tuple[Target, ...] = get_args(Target)
_LOGS = len(TARGETS) - 1  # all but Tc
#: A correction beyond so many of its units says only that the regression is useless there. (Two make fits of squares
#: 2 % better, but then motors with a friction that their filter lacks get none that is large enough.)
_MOST_CORRECTION = 5.0
#: The regression's std counts within these limits, and friction's share is known to about so much.
_LEAST_STD, _MOST_STD, _SHARE_STD = 3e-3, 0.3, 0.02
#: P_regression counts as far as this factor beyond nominal · or / spread.
_BEYOND = 3.0
#: Where in the features stand what the regression found, and its std.
_FOUND, _STD = ([catalogue.NAMES.index(f"reg_{n}{end}") for n in TARGETS[:_LOGS]] for end in ("", "_std"))
_TC_SHARE, _RMS_I = catalogue.NAMES.index("reg_Tc_share"), catalogue.NAMES.index("rms_i")
#: No parameter's logarithm is larger: the ends of an interval that says nothing stay numbers.
_LARGEST_LOG = 200.0


@dataclass(frozen=True)
class Baseline:
    """What a window says without any learning.

    Attributes:
        centre: shape (n, m): log P_regression, and friction's share; NaN where there is no regression.
        scale: shape (n, m): units of a correction.
        torque: shape (n,), N·m: K of the regression times the current's RMS, of which friction is a share.
    """

    centre: F64
    scale: F64
    torque: F64

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which windows have one, shape (n,)."""
        return np.asarray(np.isfinite(self.centre).all(axis=1) & np.isfinite(self.scale).all(axis=1))

    def only(self, which: NDArray[np.bool_]) -> Baseline:
        """Of some of the windows."""
        return Baseline(self.centre[which], self.scale[which], self.torque[which])


def baseline(features: F64, nominal: Mapping[str, float], spread: float) -> Baseline:
    """Of windows' features, shape (n, features), in their units."""
    found, std = features[:, _FOUND], features[:, _STD]
    limit, usual = np.log(spread * _BEYOND), _log_nominal(nominal)
    centre, scale = np.empty((len(features), len(TARGETS))), np.empty((len(features), len(TARGETS)))
    with np.errstate(invalid="ignore", divide="ignore"):
        away = np.where(found > 0.0, np.log(found), np.nan) - usual
    centre[:, :_LOGS] = usual + np.minimum(np.maximum(away, -limit), limit)
    centre[:, _LOGS] = features[:, _TC_SHARE]
    scale[:, :_LOGS] = np.minimum(np.maximum(std, _LEAST_STD), _MOST_STD)
    scale[:, _LOGS] = _SHARE_STD
    return Baseline(centre, scale, features[:, _FOUND[TARGETS.index("K")]] * features[:, _RMS_I])


def encode(kind: Target, truth: F64, base: Baseline, nominal: Mapping[str, float]) -> F64:
    """Targets, shape (n, m), from the true parameters, shape (n, m)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        share = truth[:, -1] / base.torque
        wanted = np.column_stack([np.log(truth[:, :_LOGS]), share])
    if kind == "correction":
        return np.asarray((wanted - base.centre) / base.scale)
    wanted[:, :_LOGS] -= _log_nominal(nominal)
    return wanted


def bounded(kind: Target, y: F64) -> F64:
    """Targets as they are fitted: none so large that it would rule the others."""
    if kind == "correction":
        return np.asarray(np.clip(y, -_MOST_CORRECTION, _MOST_CORRECTION))
    return np.column_stack([y[:, :_LOGS], np.clip(y[:, -1], -1.0, 1.0)])


def decode(kind: Target, y: F64, base: Baseline, nominal: Mapping[str, float]) -> F64:
    """Coordinates from targets: logarithms of the parameters, and friction's share; shape (n, m)."""
    if kind == "correction":
        return np.asarray(base.centre + y * base.scale)
    out = y.copy()
    out[:, :_LOGS] += _log_nominal(nominal)
    return out


def coordinate_scale(kind: Target, base: Baseline) -> F64:
    """Of coordinates per unit of target, shape (n, m)."""
    return base.scale if kind == "correction" else np.ones_like(base.scale)


def natural(coordinates: F64, torque: F64) -> F64:
    """Parameters in SI units from coordinates, shape (n, m); friction is not negative."""
    logs = np.clip(coordinates[:, :_LOGS], -_LARGEST_LOG, _LARGEST_LOG)
    return np.column_stack([np.exp(logs), np.maximum(coordinates[:, -1], 0.0) * torque])


def _log_nominal(nominal: Mapping[str, float]) -> F64:
    return np.log([nominal[name] for name in TARGETS[:_LOGS]])
