"""What effects add to the shaft's regression: columns, the signals they are integrals of, the parameters they give."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from servo_daemon.estimators.stretch import Stretch, speed_sign
from servo_daemon.estimators.stretch import speed as speed_of
from servo_daemon.samples import F64

#: Effects whose torque is linear in what they add to the shaft's regression: its columns, and what they give.
SHAFT_COLUMNS: Mapping[str, tuple[str, ...]] = {
    "coulomb_friction": ("Tc",),
    "asymmetric_friction": ("Tc", "Tc_neg", "B_neg"),
    "load_dependent_friction": ("mu",),
    "quadratic_drag": ("c2",),
    "constant_load_torque": ("one",),
    "gravity_load": ("sin", "cos"),
}
#: Effects that hold at rest with any torque up to their level.
DRY = frozenset({"coulomb_friction", "asymmetric_friction", "stribeck_friction", "load_dependent_friction"})
#: Columns that are named by their signal, and the parameter they give.
GIVES: Mapping[str, str] = {"one": "TL", "sin": "Tg", "cos": "phi_g"}


def _asymmetric(s: Stretch) -> list[F64]:
    sign = speed_sign(s)
    return [np.maximum(sign, 0.0), np.minimum(sign, 0.0), np.minimum(speed_of(s), 0.0)]


def _carried(s: Stretch) -> list[F64]:
    torque = s.current if s.torque is None else s.torque
    return [np.zeros_like(s.time_s) if torque is None else speed_sign(s) * np.abs(torque)]


def _angle_waves(s: Stretch) -> list[F64]:
    angle = s.position if s.position is not None else np.zeros_like(s.time_s)
    return [np.sin(angle), np.cos(angle)]


#: What the columns of `SHAFT_COLUMNS` are the modulated integrals of.
EFFECT_SIGNALS: Mapping[str, Callable[[Stretch], list[F64]]] = {
    "coulomb_friction": lambda s: [speed_sign(s)],
    "asymmetric_friction": _asymmetric,
    "load_dependent_friction": _carried,
    "quadratic_drag": lambda s: [speed_of(s) * np.abs(speed_of(s))],
    "constant_load_torque": lambda s: [np.ones_like(s.time_s)],
    "gravity_load": _angle_waves,
}
