"""Rows of a model's two balances: modulated integrals over windows of new samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from servo_daemon.numerics import runs_of
from servo_daemon.plant.build import PlantModel
from servo_daemon.regression.columns.of_model import ModelColumns
from servo_daemon.regression.columns.terms import columns_of, shaft_signals
from servo_daemon.regression.modulating import Windows, make_windows
from servo_daemon.regression.sampling import FEWEST_SAMPLES, SPAN_S, WINDOW_S, is_slow
from servo_daemon.regression.stretch import Stretch, motion
from servo_daemon.samples import F64

#: A current has a direction beyond so many standard deviations of its noise (a Gaussian is beyond three once in 370
#: times).
DIRECTED_STDS = 3.0
#: A shaft that is slower than this share of its usual speed (rms) for so long, s, creeps: longer than a reversal takes
#: and a fifth of the shaft's windows.
CREEP, CREEP_S = 0.01, 0.02


@dataclass(frozen=True, slots=True)
class ModelRows:
    """Columns, shape (m, n), what they make, shape (m,), over which windows, of which samples; of a shaft whose model
    has no dry friction what that would add per N·m, shape (m,); of one that has it in which windows the shaft all but
    stood for a while (None: in none)."""

    Phi: F64
    y: F64
    windows: Windows
    samples: Stretch
    dry: F64 | None = None
    creeping: NDArray[np.bool_] | None = None


class RowMaker:
    """Makes each window's row once.

    Args:
        known: parameters that are given where a signal is missing.
        taken_at: what orders, frequencies and the like are held at, and what is not linear is taken at.
    """

    def __init__(
        self, plant: PlantModel, columns: ModelColumns, known: Mapping[str, float], taken_at: Mapping[str, float]
    ) -> None:
        self._plant, self._columns, self._known, self._taken_at = plant, columns, known, taken_at
        self._next = {"armature": 0.0, "shaft": 0.0}
        self._speed_square = 0.0

    def _windows(self, s: Stretch, period_s: float, which: str) -> Windows | None:
        """Windows that have not been used yet, half overlapping, none across unusable samples; of the armature, whose
        voltage is not known in a gap, none across a gap either."""
        length = max(FEWEST_SAMPLES, round(SPAN_S[which] / period_s)) + 1
        bad = ~s.usable
        broken = which == "armature" and s.gap is not None and bool(s.gap.any())
        if broken:
            assert s.gap is not None
            bad = bad | s.gap
        hop = max(1, length // 2)
        begin = int(np.searchsorted(s.time_s, self._next[which] - 0.25 * period_s))
        first = np.arange(begin, len(s.time_s) - length + 1, 1 if broken else hop, dtype=np.intp)
        if len(first) == 0:
            return None
        self._next[which] = float(s.time_s[first[-1] + (1 if broken else hop)])
        if np.count_nonzero(bad):
            before = np.concatenate([[0], np.cumsum(bad)])
            # A gap before a window's first sample does no harm, one inside does.
            first = first[before[first + length] - before[first + 1] == 0]
        if broken:
            first = _apart(first, hop)
        exact = which == "shaft" or is_slow(period_s)
        return make_windows(s.time_s, first, length, exact=exact) if len(first) else None

    def armature(self, s: Stretch, period_s: float, current_var: float, sag: float) -> ModelRows | None:
        """Rows of the armature's balance, V; None where there are none.

        Args:
            current_var: noise of the current, A².
            sag: what the current does between two samples, A·s²/rad (`MotorRls`).
        """
        direction = None
        brushes = "Vb" in self._columns.armature
        if (brushes or any(d.by_current_direction for d in self._columns.derived)) and s.current is not None:
            direction = _direction(s.current, current_var)
            s = replace(s, usable=s.usable & (direction != 0.0))
        w = self._windows(s, period_s, "armature")
        if w is None or s.voltage is None or s.current is None:
            return None
        speed, acceleration = motion(w, s)
        current, current_rate = w.integrals(s.current, 0, 1)
        columns = [current + sag * acceleration, -current_rate, speed]
        if "one" in self._columns.armature:
            columns.append(w.of_one)
        if direction is not None and brushes:
            columns.append(w.integral(direction))
        if "rip_sin" in self._columns.armature:
            columns += self._rippled_speed(w, s)
        columns += [w.integral(x) for d in self._columns.derived for x in d.signals("armature", s, self._taken_at)]
        return ModelRows(_in_columns(columns), w.held(s.voltage), w, s)

    def shaft(self, s: Stretch, period_s: float, sag: float) -> ModelRows | None:
        """Rows of the shaft's balance, N·m or that over K; None where there are none."""
        if self._plant.may_stick:
            s = replace(s, usable=s.usable & (s.sliding != 0.0))
        w = self._windows(s, period_s, "shaft")
        if w is None:
            return None
        speed, acceleration = motion(w, s)
        columns = [acceleration, speed]
        if "B_neg" in self._columns.shaft:  # B is that of positive motion alone
            columns[1] = speed - w.integral(np.minimum(s.speed, 0.0))
        for effect in self._columns.shaft_effects:
            columns += self._effect_columns(effect, w, s)
        y = self._driving_torque(w, s, speed, acceleration, sag)
        if y is None:
            return None
        dry = None if self._plant.may_stick else w.integral(s.sliding)
        creeping = w.touching(self._creeping(s, period_s)) if self._plant.may_stick else None
        return ModelRows(_in_columns(columns), y, w, s, dry, creeping)

    def _creeping(self, s: Stretch, period_s: float) -> NDArray[np.bool_]:
        """Where the shaft all but stands for a while: dry friction is then anything up to its level."""
        size = np.abs(s.speed)
        share = min(1.0, len(size) * period_s / WINDOW_S)
        self._speed_square += share * (float(np.mean(np.square(size))) - self._speed_square)
        return lasting(size < CREEP * self._speed_square**0.5, max(2, round(CREEP_S / period_s)))

    def _effect_columns(self, effect: str, w: Windows, s: Stretch) -> list[F64]:
        if not columns_of(effect, self._columns.shaft_effects):
            return []
        return [w.integral(signal) for signal in shaft_signals(effect, s, self._taken_at)]

    def _rippled_speed(self, w: Windows, s: Stretch) -> list[F64]:
        """∫φ ω sin(n θ) and ∫φ ω cos(n θ), by parts."""
        n = self._taken_at["n_rip"]
        assert s.position is not None
        sine, cosine = w.integral(np.sin(n * s.position), 1), w.integral(np.cos(n * s.position), 1)
        return [cosine / n, -sine / n]

    def _driving_torque(self, w: Windows, s: Stretch, speed: F64, acceleration: F64, sag: float) -> F64 | None:
        """∫φ of motor torque, divided by K where K is to come from the armature; None if it cannot be had."""
        if s.torque is not None:
            return w.integral(s.torque)
        if s.current is not None:
            factor = 1.0 if s.voltage is not None else self._known.get("K")
            return None if factor is None else factor * (w.integral(s.current) + sag * acceleration)
        if s.voltage is not None and "R" in self._known and "K" in self._known:
            K, R = self._known["K"], self._known["R"]
            return (w.held(s.voltage) - K * speed) * (K / R)
        return None


def _direction(current: F64, var: float) -> F64:
    """Sign of the current per sample, 0 where its noise may have made it."""
    return np.where(np.abs(current) > DIRECTED_STDS * var**0.5, np.sign(current), 0.0)


def lasting(flags: NDArray[np.bool_], least: int) -> NDArray[np.bool_]:
    """Those of the flags, shape (n,), that stand in a row of at least so many; a row at an end may be longer than is
    seen."""
    if not np.count_nonzero(flags):
        return flags
    out = flags.copy()
    for a, b in runs_of(flags):
        out[a:b] = b - a >= least or a == 0 or b == len(flags)
    return out


def _apart(first: NDArray[np.intp], hop: int) -> NDArray[np.intp]:
    """Of increasing indices those that are at least `hop` after the last one taken."""
    taken: list[int] = []
    for k in first.tolist():
        if not taken or k - taken[-1] >= hop:
            taken.append(k)
    return np.array(taken, dtype=np.intp)


def _in_columns(columns: Sequence[F64]) -> F64:
    """Arrays of shape (m,) as the columns of one, shape (m, n)."""
    out = np.empty((len(columns[0]), len(columns)))
    for k, column in enumerate(columns):
        out[:, k] = column
    return out
