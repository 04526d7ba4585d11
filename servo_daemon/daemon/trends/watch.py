"""Trends of a drive's parameters from its history, and the warning that a limit may soon be reached.

A warning begins when the near end of the interval comes under `warn_before`, and ends when it is beyond by half as much
again, or there is no trend any more: what noise moves to and fro is told once.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from servo_daemon.config import DriveConfig
from servo_daemon.pipeline.alarms import Alarms
from servo_daemon.pipeline.publish import published_names
from servo_daemon.published.buckets import Buckets
from servo_daemon.published.snapshot import Event
from servo_daemon.published.trends import DAY_S, DriveTrends
from servo_daemon.samples import F64
from servo_daemon.tracking.plan.settings import Message
from servo_daemon.trend.records import Limit, Trend
from servo_daemon.trend.warning import is_near
from servo_daemon.trend.words import sentence

TEMPERATURE: Final = "temperature_C"
#: Kinds of events: a warning, and its end.
NEAR: Final = "limit_near"
FAR: Final = "limit_far"
#: A warning ends beyond so many times `warn_before`.
_RELIEF: Final = 1.5


def names_of(config: DriveConfig) -> tuple[str, ...]:
    """Series of the history that trends are found from."""
    return (*published_names(config), TEMPERATURE)


def already_told(events: tuple[Event, ...]) -> frozenset[str]:
    """Parameters whose warning stands, by events of both kinds, oldest first."""
    last = {str(event.data.get("parameter")): event.kind for event in events}
    return frozenset(name for name, kind in last.items() if kind == NEAR)


def find_trends(config: DriveConfig, hours: Buckets, time_s: float) -> DriveTrends:
    """Trends of all parameters that the history holds.

    Args:
        config: the drive, with its model as it is now.
        hours: hourly means, some of `names_of`.
        time_s: now, UTC, seconds since the epoch.
    """
    alarms, limits = Alarms(config).limits, config.limits
    means = {name: hours.mean[:, k] for k, name in enumerate(hours.names)}
    trends: dict[str, Trend] = {}
    for name in published_names(config):
        if name in means:
            own = tuple(Limit(a.name, a.value, a.is_upper) for a in alarms if a.parameter == name)
            trends[name] = _trend(config, name, hours.time_s, means, own)
    near = frozenset(name for name, t in trends.items() if is_near(t, limits.warn_before_d))
    return DriveTrends(time_s, None if trends else "the history holds nothing yet", limits.warn_before_d, trends, near)


def _trend(config: DriveConfig, name: str, time_s: F64, means: Mapping[str, F64], limits: tuple[Limit, ...]) -> Trend:
    from servo_daemon.trend.trend import assess  # loads scipy

    warm = means.get(TEMPERATURE)
    if warm is not None and not np.isfinite(warm).any():
        warm = None
    of_winding = config.signals.temperature == "winding"
    nominal = config.nominal.get(name)
    return assess(name, time_s / DAY_S, means[name], warm, limits, nominal, of_winding=of_winding)


def warnings(before: frozenset[str], now: DriveTrends) -> tuple[frozenset[str], list[Message]]:
    """Parameters whose warning stands now, and what begins and ends.

    Args:
        before: parameters whose warning stood.
    """
    begun = ((name, now.trends[name]) for name in sorted(now.near - before))
    told = [_message(NEAR, name, trend, sentence(name, trend)) for name, trend in begun]
    stays = set(now.near)
    for name in sorted(before - now.near):
        trend = now.trends.get(name)
        if trend is not None and is_near(trend, _RELIEF * now.warn_before_d):
            stays.add(name)
            continue
        text = f"{name}: its limit is no longer near" + ("" if trend is None else f" ({sentence(name, trend)})")
        told.append(_message(FAR, name, trend, text))
    return frozenset(stays), told


def _message(kind: str, name: str, trend: Trend | None, text: str) -> Message:
    limit = None if trend is None else trend.limit
    years = None if trend is None else trend.years
    return (
        kind,
        text,
        {
            "parameter": name,
            "limit": None if limit is None else limit.name,
            "years_low": None if years is None else years.low,
            "years_mid": None if years is None else years.mid,
            "years_high": None if years is None else years.high,
        },
    )
