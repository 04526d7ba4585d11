"""The motor's current from sensors that show something else: its modulus, or what the supply delivers.

A sensor on the supply side shows |i| (one direction only), or, behind the bridge's capacitor, the mean over the
switching period, duty × i. The armature's balance L di/dt = v − R i − K ω says which sign a modulus has: signs and the
three parameters are found in turn, the signs by dynamic programming over all samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from servo_daemon.captures.meaning.windows import Windows, left, window_length
from servo_daemon.errors import BadInputError
from servo_daemon.samples import F64

Shows = Literal["magnitude", "supply"]
SHOWS: tuple[Shows, ...] = ("magnitude", "supply")

#: Rounds of signs and parameters; from every start it has settled in fewer or it does not.
_ROUNDS = 15
#: With the right signs the balance leaves no more of the voltage than this: what brushes, dead time and a coarse
#: encoder may take.
_CLOSES = 0.25
#: Below this share of the supply the motor's current is too small a part of what the supply shows: not known there.
_LEAST_DUTY = 0.1


@dataclass(frozen=True, slots=True)
class Shown:
    """What the column of the current shows; `supply_V` is needed for the supply's current."""

    shows: Shows
    supply_V: float | None = None


def restored_current(
    shown: Shown, time_s: F64, voltage: F64, current: F64, travel: F64 | None
) -> tuple[F64, NDArray[np.bool_] | None]:
    """The motor's current, A, shape (n,), and where it is known, shape (n,) (None: everywhere).

    Args:
        time_s, voltage, current: shape (n,); the voltage is held from each sample to the next.
        travel: Δθ of every interval, shape (n − 1,); None: no motion was measured, as of a blocked rotor.

    Raises:
        BadInputError: the balance does not close with any signs.
    """
    if shown.shows == "supply":
        assert shown.supply_V is not None
        return from_supply(voltage, current, shown.supply_V)
    turned = np.zeros(len(voltage) - 1) if travel is None else travel
    signs, share = signs_of(time_s, voltage, np.abs(current), turned)
    if share > _CLOSES:
        what = f"{100 * share:.0f} % of the voltage stays unexplained with the best signs of the current's modulus"
        asked = (
            "is it one, and are voltage and motion right?" if travel is not None else "if the shaft turns, measure that"
        )
        raise BadInputError(f"{what}: {asked}")
    return np.asarray(signs * np.abs(current)), None


def from_supply(voltage: F64, current: F64, supply_V: float) -> tuple[F64, NDArray[np.bool_]]:
    """i = i_supply × supply / v where the duty is large enough, and where that is; between, straight lines."""
    clear = np.abs(voltage) >= _LEAST_DUTY * supply_V
    if np.count_nonzero(clear) < 2:
        raise BadInputError(f"the voltage never reaches {100 * _LEAST_DUTY:g} % of supply_V = {supply_V:g}")
    at = np.flatnonzero(clear)
    return np.interp(np.arange(len(voltage)), at, current[at] * supply_V / voltage[at]), clear


def signs_of(time_s: F64, voltage: F64, modulus: F64, travel: F64) -> tuple[F64, float]:
    """Signs ±1, shape (n,), and the share of the voltage that the balance leaves with them."""
    h = np.diff(time_s)
    windows = Windows.of(time_s, voltage, travel)
    speed = _smoothed(travel / h, window_length(time_s))
    drive = np.concatenate([voltage[:1], voltage[:-1]])  # what made the current at a sample
    gained = np.gradient(np.append(speed, speed[-1]))
    best = (np.ones_like(modulus), np.inf)
    for start in (drive, gained, drive - _back_emf(voltage, speed)):
        signs, share = _settled(time_s, h, voltage[:-1], modulus, speed, windows, np.where(start < 0.0, -1.0, 1.0))
        if share < best[1]:
            best = (signs, share)
    return best


def _back_emf(voltage: F64, speed: F64) -> F64:
    """The part of the voltage that goes with the speed, as far as a straight line shows it."""
    size = float(speed @ speed)
    slope = float(voltage[:-1] @ speed) / size if size > 0.0 else 0.0
    return slope * np.append(speed, speed[-1])


def _settled(
    time_s: F64, h: F64, held: F64, modulus: F64, speed: F64, windows: Windows, signs: F64
) -> tuple[F64, float]:
    share = np.inf
    for _ in range(_ROUNDS):
        p, now = left(windows.columns(time_s, signs * modulus), windows.voltage)
        if now >= share * (1.0 - 1e-9):
            break
        best, share = signs, now
        R, L, K = max(float(p[0]), 0.0), max(float(p[1]), 0.0), float(p[2])
        signs = _cheapest(held - K * speed, R / 2 + L / h, R / 2 - L / h, modulus)
    return best, share


def _cheapest(level: F64, ahead: F64, behind: F64, modulus: F64) -> F64:
    """The signs that leave least of  level_k = ahead_k s_{k+1} m_{k+1} + behind_k s_k m_k  (dynamic programming).

    Turning all signs and the level round leaves the same, so two of the four pairs of signs are told by the others.
    """
    a, b = ahead * modulus[1:], behind * modulus[:-1]
    pp, pm = ((level - a - b) ** 2).tolist(), ((level - a + b) ** 2).tolist()  # from +, from − to +
    mp, mm = ((level + a - b) ** 2).tolist(), ((level + a + b) ** 2).tolist()  # from +, from − to −
    n = len(pp)
    plus = minus = 0.0
    from_plus_to_plus, from_plus_to_minus = [True] * n, [True] * n
    for k in range(n):
        x, y = plus + pp[k], minus + pm[k]
        u, w = plus + mp[k], minus + mm[k]
        from_plus_to_plus[k], from_plus_to_minus[k] = x <= y, u <= w
        plus, minus = (x if x <= y else y), (u if u <= w else w)
    out = np.empty(n + 1)
    now = plus <= minus
    out[n] = 1.0 if now else -1.0
    for k in range(n - 1, -1, -1):
        now = from_plus_to_plus[k] if now else from_plus_to_minus[k]
        out[k] = 1.0 if now else -1.0
    return out


def _smoothed(values: F64, m: int) -> F64:
    """Mean over about m neighbours, shape as given."""
    m |= 1
    padded = np.pad(values, m // 2, mode="edge")
    total = np.concatenate([[0.0], np.cumsum(padded)])
    return np.asarray((total[m:] - total[:-m]) / m)
