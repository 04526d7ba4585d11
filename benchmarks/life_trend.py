"""How good the time until the limit is: lives of one to five years from `tests/lives.py`, which knows nothing of the
model that is fitted, each asked on a day of its own.

    python -m benchmarks.life_trend                 # 500 lives, seeds of reports
    python -m benchmarks.life_trend --calibration   # seeds that constants are chosen by

Intervals: of the lives with an interval for the time until the limit, how many reach it within. False: lives that never
reach it and were told they will, on one day, and on any day of those asked every half year. Warnings: of the lives
that reach the limit within their years, asked every 45 days, when the first one came whose interval begins under
`warn_before`.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from servo_daemon.config import LimitsConfig
from servo_daemon.trend.records import Limit, Trend
from servo_daemon.trend.series import YEAR_D
from servo_daemon.trend.trend import assess
from servo_daemon.trend.warning import is_near
from tests.lives import KINDS, STEADY, Life, calibration_seed, kinds, make_life, report_seed

_EVERY_D = 45.0
WARN_BEFORE_D = LimitsConfig().warn_before_d


@dataclass(frozen=True)
class Asked:
    """A life asked on one day: what was told, and the years that were really left (inf: for ever)."""

    kind: str
    told: Trend
    left_y: float

    @property
    def has_interval(self) -> bool:
        return self.told.years is not None and self.told.years.low is not None

    @property
    def off(self) -> int:
        """-1: the limit was reached before the interval, 1: after it, 0: within."""
        years = self.told.years
        assert years is not None and years.low is not None
        return -1 if self.left_y < years.low else int(self.left_y > (np.inf if years.high is None else years.high))


def ask(life: Life, day: float) -> Asked:
    """What the trend of a life is on a day."""
    known = life.until(day)
    limit = Limit("R_max", life.limit, True)
    told = assess("R", known.time_d, known.value, known.temperature_C, (limit,), nominal=1.0)
    return Asked(life.kind, told, (life.crosses_d - day) / YEAR_D)


def day_of(life: Life, seed: int) -> float:
    """The day on which a life is asked: in its last 70 %, after an exchange 150 days later at the soonest."""
    last = float(life.time_d[-1])
    day = float(np.random.default_rng((seed, 1)).uniform(0.3, 1.0)) * last
    return day if life.exchange_d is None else max(day, min(life.exchange_d + 150.0, last))


def warning(life: Life) -> float | None:
    """How many days before the limit was reached the first warning came, asked from three times `WARN_BEFORE_D` on;
    None: it was reached without one."""
    day = max(life.crosses_d - 3 * WARN_BEFORE_D, 60.0)
    while day < life.crosses_d:
        if is_near(ask(life, day).told, WARN_BEFORE_D):
            return life.crosses_d - day
        day += _EVERY_D
    return None


def _share(part: int, whole: int) -> str:
    return f"{part} ({100.0 * part / whole:.0f} %)" if whole else "0"


def _intervals(asked: Sequence[Asked]) -> list[str]:
    out = [
        "| lives | number | trend told | with an interval | limit reached within it | before | after |",
        "|---|---|---|---|---|---|---|",
    ]
    for kind in (*KINDS, "all"):
        some = [a for a in asked if kind in (a.kind, "all")]
        trends = sum(a.told.status == "trend" for a in some)
        offs = Counter(a.off for a in some if a.has_interval)
        n = offs.total()
        out.append(
            f"| {kind} | {len(some)} | {trends} | {n} | {_share(offs[0], n)} | {_share(offs[-1], n)} "
            f"| {_share(offs[1], n)} |"
        )
    return out


def _false(lives: Sequence[Life], asked: Sequence[Asked]) -> list[str]:
    once = sum(a.has_interval for a in asked if a.kind in STEADY)
    steady = [life for life in lives if life.kind in STEADY]
    ever = near = 0
    for life in steady:
        told = [ask(life, day) for day in np.arange(0.5 * YEAR_D, life.time_d[-1], 0.5 * YEAR_D)]
        ever += any(a.has_interval for a in told)
        near += any(is_near(a.told, WARN_BEFORE_D) for a in told)
    n = len(steady)
    return [
        "| lives that never reach the limit | of | told that they will, on one day | on any day | warned |",
        "|---|---|---|---|---|",
        f"| season, none, run-in | {n} | {once} ({100 * once / n:.1f} %) | {ever} ({100 * ever / n:.1f} %) "
        f"| {near} ({100 * near / n:.1f} %) |",
    ]


def _warnings(lives: Sequence[Life]) -> list[str]:
    out = [
        f"| lives that reach the limit | number | warned {WARN_BEFORE_D / 2:.0f} to {2 * WARN_BEFORE_D:.0f} days "
        "before | earlier | later | not at all |",
        "|---|---|---|---|---|---|",
    ]
    within = [life for life in lives if life.crosses_d < life.time_d[-1] + 2.0 + 60.0 and life.crosses_d > 240.0]
    leads = [(life.kind, warning(life)) for life in within]
    for kind in ("linear", "exponential", "stepwise", "exchange", "all"):
        some = [lead for k, lead in leads if kind in (k, "all")]
        n, told = len(some), [lead for lead in some if lead is not None]
        early = sum(lead > 2 * WARN_BEFORE_D for lead in told)
        late = sum(lead < WARN_BEFORE_D / 2 for lead in told)
        out.append(
            f"| {kind} | {n} | {_share(len(told) - early - late, n)} | {_share(early, n)} | {_share(late, n)} "
            f"| {_share(n - len(told), n)} |"
        )
    return out


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lives", type=int, default=500)
    parser.add_argument("--calibration", action="store_true")
    options = parser.parse_args(argv)
    seed_of: Callable[[int], int] = calibration_seed if options.calibration else report_seed
    lives = [make_life(kind, seed_of(k)) for k, kind in enumerate(kinds(options.lives))]
    began = time.process_time()
    asked = [ask(life, day_of(life, seed_of(k))) for k, life in enumerate(lives)]
    spent = (time.process_time() - began) / len(lives)
    print("\n".join([*_intervals(asked), "", *_false(lives, asked), "", *_warnings(lives), ""]))
    print(f"one trend of one parameter: {1e3 * spent:.0f} ms of one core in the mean")
    return 0


if __name__ == "__main__":
    sys.exit(main())
