"""Live, a held voltage beside a current that is its mean over each row: both sides of the winding's balance are means,
and the shaft is driven by that current."""

from __future__ import annotations

from dataclasses import replace

import pytest

from servo_daemon.config import DriveConfig
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.published.snapshot import Estimate
from servo_daemon.signal_meaning import SignalMeaning
from tests.mean_current import MOTOR, PERIOD_S, recorded

MEANS = SignalMeaning(current="mean")


def published(L: float, period_s: float, size: int, n: int) -> Estimate:
    block = recorded(L, means=True, n=n, period_s=period_s)
    pipeline, found = Pipeline(DriveConfig(), meaning=MEANS), list[Estimate]()
    for k in range(0, n, size):
        found += pipeline.process(block.slice(k, min(k + size, n)))
    return found[-1]


@pytest.mark.parametrize(
    ("time_constant", "period_s"), [(0.25, PERIOD_S), (1.0, PERIOD_S), (5.0, PERIOD_S), (0.2, 5e-3)]
)
def test_what_is_published_is_right(time_constant: float, period_s: float) -> None:
    """Taken for the current at its row K was 5 % off at 24 of its std with 200 rows a second."""
    L = time_constant * period_s * MOTOR["R"]
    estimate = published(L, period_s, 5000, 9000 if period_s == PERIOD_S else 3000)
    known = {p.name: p for p in estimate.parameters}
    for name, true in {**MOTOR, "L": L}.items():
        p = known[name]
        if p.status != "estimating":
            assert p.value is not None and p.std is not None
            assert abs(p.value - true) < max(4.0 * p.std, 0.03 * true), (name, p)
    assert all(known[name].status == "tracking" for name in ("R", "K", "J"))
    assert {name for name in ("R", "K") if known[name].std > 0.01 * MOTOR[name]} == set()  # type: ignore[operator]


def test_it_does_not_depend_on_the_blocks() -> None:
    whole, pieces = (published(1.2e-3, PERIOD_S, size, 4000) for size in (4000, 7))
    assert replace(whole, estimators={}) == replace(pieces, estimators={})


def test_the_voltage_of_an_interval_is_the_one_that_was_held_over_it() -> None:
    assert MEANS.of_means and MEANS.follows_current and not MEANS.measures_voltage
    assert SignalMeaning(voltage="mean").of_means and SignalMeaning(voltage="instant").follows_current
    assert not SignalMeaning().follows_current and not SignalMeaning(voltage="instant", current="mean").of_means
