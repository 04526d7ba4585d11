"""Lives of a drive's parameter, day by day, with the truth; they know nothing of `servo_daemon.trend`.

A life's wear goes from 0 to `limit` (both relative to the new value) as its kind says. What is seen of it has the
season's temperature in it, noise from day to day, excursions of days to weeks, wrong days and days without data.
Calibration draws even seeds, reports odd ones (`calibration_seed`, `report_seed`), so that no figure comes from a life
that a constant was chosen by.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

F64 = NDArray[np.float64]

YEAR_D = 365.25
#: Kinds, and how many of 500 lives are of each.
KINDS = {"linear": 110, "exponential": 110, "stepwise": 110, "season": 60, "none": 60, "run-in": 20, "exchange": 30}
#: Kinds whose wear never comes to the limit.
STEADY = ("season", "none", "run-in")
#: Of copper at 25 °C, 1/K: 1 / (234.5 + 25) (IEC 60034-1: copper's resistance is zero at -234.5 °C).
COPPER_1_K = 1.0 / 259.5
_HORIZON_D = 60 * YEAR_D


@dataclass(frozen=True)
class Life:
    """One life.

    Attributes:
        kind: of `KINDS`.
        time_d: days with data, shape (n,), increasing.
        value: seen, relative to the new value, shape (n,).
        std: what the estimator claims, shape (n,); its own noise, nothing of the excursions.
        temperature_C: of the winding, shape (n,); None: not recorded.
        limit: of the value; 1 + something.
        crosses_d: day at which the wear reaches the limit; inf: never.
        exchange_d: day of the exchange; None: there was none.
        wear: at `time_d`, shape (n,).
    """

    kind: str
    time_d: F64
    value: F64
    std: F64
    temperature_C: F64 | None
    limit: float
    crosses_d: float
    exchange_d: float | None
    wear: F64

    def until(self, day: float) -> Life:
        """What was known of it on that day."""
        n = int(np.searchsorted(self.time_d, day, side="right"))
        warm = None if self.temperature_C is None else self.temperature_C[:n]
        known = None if self.exchange_d is None or self.exchange_d > day else self.exchange_d
        return Life(
            self.kind, self.time_d[:n], self.value[:n], self.std[:n], warm, self.limit, self.crosses_d, known,
            self.wear[:n],
        )  # fmt: skip


def calibration_seed(number: int) -> int:
    return 2 * number


def report_seed(number: int) -> int:
    return 2 * number + 1


def kinds(count: int) -> list[str]:
    """Kinds of `count` lives, in the shares of `KINDS`, mixed in a fixed order."""
    shares = np.array(list(KINDS.values())) / sum(KINDS.values())
    every = [name for name, n in zip(KINDS, np.round(shares * count).astype(int), strict=True) for _ in range(n)]
    every = (every + list(KINDS))[:count]
    return [every[k] for k in np.random.default_rng(0).permutation(count)]


def make_life(kind: str, seed: int) -> Life:
    """A life of 1 to 5 years, or until its wear reaches the limit."""
    rng = np.random.default_rng(seed)
    margin = rng.uniform(0.2, 0.5)
    wear, exchange_d, crosses_d = _wear(kind, margin, rng)
    length = min(rng.uniform(1.0, 5.0) * YEAR_D, crosses_d)
    if exchange_d is not None and length < exchange_d:
        length = exchange_d + 200.0
    day = np.arange(int(length)) + 0.5
    day = day[_on(day, rng)]
    is_told = rng.random() < 0.5
    mean_C = rng.uniform(25.0, 60.0) if is_told else 25.0  # where nobody knows it, the value when new is a warm one
    warm = mean_C + _temperature(day, rng, swing_K=rng.uniform(6.0, 15.0) if _warms(kind, rng) else 0.0)
    noise, std = _noise(day, rng)
    worn = np.array(wear(day))
    value = (1.0 + worn) * (1.0 + COPPER_1_K * (warm - 25.0)) * (1.0 + noise)
    told = warm + rng.normal(0.0, 0.5, len(day)) if is_told else None
    return Life(kind, day, value, std, told, 1.0 + margin, crosses_d, exchange_d, worn)


def _warms(kind: str, rng: np.random.Generator) -> bool:
    return kind == "season" or (kind != "none" and rng.random() < 0.5)


Wear = Callable[[F64], F64]


def _wear(kind: str, margin: float, rng: np.random.Generator) -> tuple[Wear, float | None, float]:
    """Wear as a function of the day, the day of an exchange, and the day at which the limit is reached."""
    life_d = YEAR_D * float(np.exp(rng.uniform(np.log(1.5), np.log(15.0))))
    if kind in ("season", "none"):
        return np.zeros_like, None, np.inf
    if kind == "run-in":
        size, tau = rng.uniform(0.03, 0.08), rng.uniform(20.0, 100.0)
        return lambda d: size * (1.0 - np.exp(-d / tau)), None, np.inf
    if kind == "exponential":
        rate = rng.uniform(0.2, 1.2) / YEAR_D
        return lambda d: margin * np.expm1(rate * d) / np.expm1(rate * life_d), None, life_d
    if kind == "stepwise":
        return _stepwise(margin, life_d, rng)
    if kind == "exchange":  # worn, then a new one that wears at another rate
        at = rng.uniform(0.8, 2.5) * YEAR_D
        before = margin * rng.uniform(0.4, 0.9) / at
        return lambda d: np.where(d < at, before * d, margin * (d - at) / life_d), at, at + life_d
    return lambda d: margin * d / life_d, None, life_d


def _stepwise(margin: float, life_d: float, rng: np.random.Generator) -> tuple[Wear, None, float]:
    per_day = rng.uniform(1.0, 5.0) / YEAR_D
    mean = margin / (life_d * per_day)
    at = np.cumsum(rng.exponential(1.0 / per_day, int(6 + 4 * _HORIZON_D * per_day)))
    level = np.concatenate([[0.0], np.cumsum(rng.gamma(2.0, mean / 2.0, len(at)))])
    return lambda d: level[np.searchsorted(at, d, side="right")], None, float(at[np.argmax(level[1:] >= margin)])


def _on(day: F64, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Days with data: some are missing at random, some lives have weekends off or a pause of weeks."""
    on = rng.random(len(day)) > rng.choice([0.0, 0.05, 0.3])
    if rng.random() < 0.3:
        on &= np.floor(day) % 7 < 5
    if rng.random() < 0.3:
        start = rng.uniform(0.0, day[-1])
        on &= (day < start) | (day > start + rng.uniform(14.0, 60.0))
    return on


def _temperature(day: F64, rng: np.random.Generator, swing_K: float) -> F64:
    """Winding temperature around its mean, K: the season (in some a heated winter) and the weather."""
    phase = rng.uniform(0.0, YEAR_D)
    weather = _wandering(day, 4.0, rng) * min(2.0, swing_K / 3.0)
    heated = rng.uniform(-0.6, 0.0) if rng.random() < 0.5 else -1.0  # below this share of the swing there is heating
    season = np.maximum(np.cos(2 * np.pi * (day - phase) / YEAR_D), heated)
    whole = np.maximum(np.cos(np.linspace(0.0, 2 * np.pi, 400)), heated)
    return swing_K * (season - whole.mean()) + weather


def _noise(day: F64, rng: np.random.Generator) -> tuple[F64, F64]:
    """Relative noise: from day to day (some days much worse), and excursions of days to weeks."""
    white = float(np.exp(rng.uniform(np.log(0.001), np.log(0.01))))
    slow = float(np.exp(rng.uniform(np.log(0.001), np.log(0.01))))
    tau_d = float(np.exp(rng.uniform(np.log(1.0), np.log(40.0))))
    noise = white * rng.normal(size=len(day)) + slow * _wandering(day, tau_d, rng)
    wrong = rng.random(len(day)) < rng.choice([0.0, 0.02])
    noise = noise + wrong * white * 10.0 * rng.standard_t(3.0, len(day))
    return noise, np.full(len(day), white)


def _wandering(day: F64, tau_d: float, rng: np.random.Generator) -> F64:
    """A first-order process of unit variance on a daily grid, at those days."""
    first, last = int(day[0]), int(day[-1])
    keep = np.exp(-1.0 / tau_d)
    drive = rng.normal(size=last - first + 201) * np.sqrt(1.0 - keep**2)
    every = lfilter([1.0], [1.0, -keep], drive)[200:]
    return np.asarray(every)[np.floor(day).astype(int) - first]
