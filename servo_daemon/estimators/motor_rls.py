"""The motor's parameters by recursive least squares on modulated balances: starts the EKF, and watches it.

Two regressions, because two balances. With voltage, current and motion both are used (K comes from the armature, J
and B from the shaft with that K); with less, what is missing must be given (`known`), or nothing is said.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from servo_daemon.estimators.modulating import Windows, make_windows
from servo_daemon.estimators.rls import DirectionalRls
from servo_daemon.plant.build import PlantModel
from servo_daemon.samples import F64

#: Windows, s: the armature reacts within L/R (a millisecond or so), the shaft within J/B and J R/K² (tens of them).
_ARMATURE_WINDOW_S, _SHAFT_WINDOW_S = 0.02, 0.1
#: Fewest samples in a window: below, the trapezoidal rule is no good.
_FEWEST_SAMPLES = 12
#: Excited directions forget with this time constant, s.
_MEMORY_S = 20.0
#: After the first updates (a tick each) so many are worked off together: fewer calls on longer arrays.
_EAGER_UPDATES, _BATCH = 50, 5
#: Windows overlap by half, so neighbouring rows share half their noise: their covariance is that much too small.
_OVERLAP_INFLATION = 2.0

#: Effects whose torque is linear in what they add to the shaft's regression, with the parameters they give.
_ARMATURE = ("R", "L", "K")
_SHAFT_EFFECTS: Mapping[str, tuple[str, ...]] = {
    "coulomb_friction": ("Tc",),
    "constant_load_torque": ("TL",),
    "gravity_load": ("Tg_cos", "Tg_sin"),
}


@dataclass(frozen=True, slots=True)
class RegressionEstimate:
    """Parameters in natural units: value shape (n,), covariance shape (n, n). Values may come out impossible."""

    names: tuple[str, ...]
    value: F64
    covariance: F64

    @property
    def std(self) -> F64:
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))


@dataclass(frozen=True, slots=True)
class Stretch:
    """Consecutive samples handed to the regressions: time since some start, and the signals there are."""

    time_s: F64
    usable: NDArray[np.bool_]
    voltage: F64 | None
    current: F64 | None
    torque: F64 | None
    position: F64 | None
    velocity: F64 | None


def _motion(w: Windows, s: Stretch) -> tuple[F64, F64]:
    """∫φ ω and ∫φ dω/dt, from the position if there is one."""
    if s.position is not None:
        centred = s.position - s.position[0]
        return -w.integral(centred, 1), w.integral(centred, 2)
    assert s.velocity is not None
    return w.integral(s.velocity), -w.integral(s.velocity, 1)


def _speed_sign(s: Stretch) -> F64:
    """Direction of motion per sample, 0 where the speed is within the noise of its own difference."""
    if s.velocity is not None:
        return np.asarray(np.sign(s.velocity))
    assert s.position is not None
    reach = min(5, len(s.position) // 2)
    ahead = np.concatenate([s.position[reach:], np.full(reach, s.position[-1])])
    behind = np.concatenate([np.full(reach, s.position[0]), s.position[:-reach]])
    return np.asarray(np.sign(ahead - behind))


class MotorRls:
    """Armature and shaft regression over a growing recording, a tick at a time.

    Args:
        plant: the model; effects it cannot express linearly keep their nominal values.
        known: parameters that are given, in natural units (needed where a signal is missing).
    """

    def __init__(self, plant: PlantModel, known: Mapping[str, float]) -> None:
        self._plant, self._known = plant, dict(known)
        self._shaft_names = ["J", "B"] + [n for e in plant.effects for n in _SHAFT_EFFECTS.get(e, ())]
        self._armature: DirectionalRls | None = None
        self._shaft: DirectionalRls | None = None
        self._tail: Stretch | None = None
        self._estimate: RegressionEstimate | None = None
        self._updates = 0
        self._next = {"armature": 0.0, "shaft": 0.0}

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters these regressions can give, if the motion shows them."""
        gravity = {"Tg_cos": "Tg", "Tg_sin": "phi_g"}
        shaft = [gravity.get(n, n) for n in self._shaft_names]
        both = self._plant.drive == "voltage" and not self._known
        return (*(_ARMATURE if both else ()), *shaft)

    def reset(self) -> None:
        self._armature = self._shaft = self._tail = None
        self._estimate, self._updates = None, 0
        self._next = {"armature": 0.0, "shaft": 0.0}

    def update(self, new: Stretch) -> None:
        """Take the samples of one tick; windows reach back into earlier ones.

        The first ticks are worked off at once (the filter waits to start), later ones `_BATCH` at a time.
        """
        self._updates += 1
        stretch = new if self._tail is None else _joined(self._tail, new)
        if self._updates > _EAGER_UPDATES and self._updates % _BATCH:
            self._tail = stretch
            return
        if len(stretch.time_s) >= _FEWEST_SAMPLES:
            period = float(np.median(np.diff(stretch.time_s)))
            if stretch.voltage is not None and stretch.current is not None:
                self._armature_rows(stretch, period)
            self._shaft_rows(stretch, period)
            keep = max(_FEWEST_SAMPLES, round(_SHAFT_WINDOW_S / period)) + 2
            stretch = _last(stretch, keep)
        self._tail = stretch
        self._estimate = self._compute()

    def _windows(self, s: Stretch, span_s: float, period: float, which: str) -> Windows | None:
        """Windows that have not been used yet, half overlapping, none across unusable samples."""
        length = max(_FEWEST_SAMPLES, round(span_s / period)) + 1
        hop = max(1, length // 2)
        begin = int(np.searchsorted(s.time_s, self._next[which] - 0.25 * period))
        first = np.arange(begin, len(s.time_s) - length + 1, hop, dtype=np.intp)
        if len(first) == 0:
            return None
        self._next[which] = float(s.time_s[first[-1] + hop])
        bad = np.concatenate([[0], np.cumsum(~s.usable)])
        # A gap before a window's first sample does no harm, one inside does.
        first = first[bad[first + length] - bad[first + 1] == 0]
        return make_windows(s.time_s, first, length) if len(first) else None

    def _armature_rows(self, s: Stretch, period: float) -> None:
        w = self._windows(s, _ARMATURE_WINDOW_S, period, "armature")
        if w is None or s.voltage is None or s.current is None:
            return
        if self._armature is None:
            rows_per_s = 2.0 / max(_ARMATURE_WINDOW_S, _FEWEST_SAMPLES * period)
            self._armature = DirectionalRls(3, _MEMORY_S * rows_per_s)
        speed, _ = _motion(w, s)
        Phi = np.column_stack([w.integral(s.current), -w.integral(s.current, 1), speed])
        self._armature.update(Phi, w.held(s.voltage))

    def _shaft_rows(self, s: Stretch, period: float) -> None:
        w = self._windows(s, _SHAFT_WINDOW_S, period, "shaft")
        if w is None:
            return
        if self._shaft is None:
            rows_per_s = 2.0 / max(_SHAFT_WINDOW_S, _FEWEST_SAMPLES * period)
            self._shaft = DirectionalRls(len(self._shaft_names), _MEMORY_S * rows_per_s)
        speed, acceleration = _motion(w, s)
        columns = [acceleration, speed]
        for effect in self._plant.effects:
            columns += self._effect_columns(effect, w, s)
        y = self._driving_torque(w, s, speed)
        if y is not None:
            self._shaft.update(np.column_stack(columns), y)

    def _effect_columns(self, effect: str, w: Windows, s: Stretch) -> list[F64]:
        if effect == "coulomb_friction":
            return [w.integral(_speed_sign(s))]
        if effect == "constant_load_torque":
            return [w.integral(np.ones_like(s.time_s))]
        if effect == "gravity_load":
            angle = s.position if s.position is not None else np.zeros_like(s.time_s)
            return [w.integral(np.sin(angle)), w.integral(np.cos(angle))]
        return []

    def _driving_torque(self, w: Windows, s: Stretch, speed: F64) -> F64 | None:
        """∫φ of motor torque, divided by K where K is to come from the armature; None if it cannot be had."""
        if s.torque is not None:
            return w.integral(s.torque)
        if s.current is not None:
            factor = 1.0 if s.voltage is not None else self._known.get("K")
            return None if factor is None else factor * w.integral(s.current)
        if s.voltage is not None and "R" in self._known and "K" in self._known:
            K, R = self._known["K"], self._known["R"]
            return (w.held(s.voltage) - K * speed) * (K / R)
        return None

    def estimate(self) -> RegressionEstimate | None:
        """What the regressions say, in natural units; None before they can say anything. It changes slowly and is
        asked for often: computed anew with each of the first updates, later with every batch."""
        return self._estimate

    def _compute(self) -> RegressionEstimate | None:
        armature = self._armature.estimate() if self._armature is not None else None
        shaft = self._shaft.estimate() if self._shaft is not None else None
        if armature is None and (shaft is None or self._armature is not None):
            return None  # without K the shaft's coefficients are quotients only
        blocks = [e for e in (armature, shaft) if e is not None]
        value = np.concatenate([e.value for e in blocks])
        covariance = block_diag(*[e.covariance for e in blocks]) * _OVERLAP_INFLATION
        names = [*(_ARMATURE if armature is not None else []), *(self._shaft_names if shaft is not None else [])]
        if armature is not None and shaft is not None:
            value, covariance = _times_torque_constant(value, covariance)
        if "Tg_cos" in names:
            value, covariance = _amplitude_and_phase(value, covariance, names.index("Tg_cos"))
            names[names.index("Tg_cos") : names.index("Tg_sin") + 1] = ["Tg", "phi_g"]
        return RegressionEstimate(tuple(names), value, covariance)


def _times_torque_constant(value: F64, covariance: F64) -> tuple[F64, F64]:
    """Shaft coefficients were found per unit of K (the third value): multiply, errors included to first order."""
    K = value[2]
    by = np.eye(len(value))
    by[3:, 3:] *= K
    by[3:, 2] = value[3:]
    return np.concatenate([value[:3], K * value[3:]]), by @ covariance @ by.T


def _amplitude_and_phase(value: F64, covariance: F64, k: int) -> tuple[F64, F64]:
    """(Tg cos φ, Tg sin φ) at k, k+1 as (Tg, φ): Tg sin(θ + φ) = (Tg cos φ) sin θ + (Tg sin φ) cos θ."""
    c, s = value[k], value[k + 1]
    size = max(float(np.hypot(c, s)), 1e-300)
    by = np.eye(len(value))
    by[k : k + 2, k : k + 2] = [[c / size, s / size], [-s / size**2, c / size**2]]
    out = value.copy()
    out[k], out[k + 1] = size, np.arctan2(s, c)
    return out, by @ covariance @ by.T


def _joined(a: Stretch, b: Stretch) -> Stretch:
    def both(x: F64 | None, y: F64 | None) -> F64 | None:
        return None if x is None or y is None else np.concatenate([x, y])

    return Stretch(
        np.concatenate([a.time_s, b.time_s]),
        np.concatenate([a.usable, b.usable]),
        both(a.voltage, b.voltage),
        both(a.current, b.current),
        both(a.torque, b.torque),
        both(a.position, b.position),
        both(a.velocity, b.velocity),
    )


def _last(s: Stretch, n: int) -> Stretch:
    def cut(x: F64 | None) -> F64 | None:
        return None if x is None else x[-n:]

    return Stretch(
        s.time_s[-n:],
        s.usable[-n:],
        cut(s.voltage),
        cut(s.current),
        cut(s.torque),
        cut(s.position),
        cut(s.velocity),
    )
