"""Gains in use: their margins with the motor as it is and as it was meant to be, and whether that is enough."""

from __future__ import annotations

from dataclasses import dataclass

from servo_daemon.samples import F64
from servo_daemon.tuning.knowledge import LoopSetup, MarginLimits
from servo_daemon.tuning.laws import Gains, controller
from servo_daemon.tuning.margins import Margins, margins
from servo_daemon.tuning.sampled import sampled_motor

#: A margin that has lost more than this share of its nominal value is told even where it is above its limit.
LOST_SHARE = 0.5


def margins_of(gains: Gains, log_values: F64, setup: LoopSetup) -> Margins:
    """Margins of one motor's loop: about 1 ms, NumPy and SciPy only."""
    motor = sampled_motor(log_values[None, :], setup.period_s, setup.delay_samples)
    return margins(motor, controller(gains, setup.period_s)).of(0)


@dataclass(frozen=True, slots=True)
class Weakness:
    """One complaint: `measure` as in `Margins` or "stable", and in words."""

    measure: str
    text: str


def smaller_gain_margin_dB(m: Margins) -> float | None:
    """Of raising and of lowering the gain, the nearer; None: no limit."""
    found = [g for g in (m.gain_margin_dB, m.gain_reduction_margin_dB) if g is not None]
    return min(found) if found else None


def weaknesses(now: Margins, nominal: Margins | None, limits: MarginLimits, relief: float = 0.0) -> list[Weakness]:
    """What is wrong with these margins; empty: nothing.

    Args:
        nominal: of the same gains with the nominal values; None: not known.
        relief: limits are so much stricter, as a share: for a warning that ends later than it began.
    """
    if not now.stable:
        return [Weakness("stable", "the loop is unstable")]
    found = []
    for measure, value, limit, unit in (
        ("phase_margin_deg", now.phase_margin_deg, limits.phase_margin_deg, "°"),
        ("gain_margin_dB", smaller_gain_margin_dB(now), limits.gain_margin_dB, " dB"),
    ):
        if value is not None and value < limit * (1.0 + relief):
            found.append(Weakness(measure, f"{_WORDS[measure]} {value:.3g}{unit} is below {limit:.3g}{unit}"))
    peak = now.sensitivity_peak
    if peak is not None and peak > 1.0 + (limits.sensitivity_peak - 1.0) * (1.0 - relief):
        found.append(Weakness("sensitivity_peak", f"M_s {peak:.3g} is above {limits.sensitivity_peak:.3g}"))
    if nominal is not None and nominal.stable:
        named = {w.measure for w in found}
        found += [w for w in _lost(now, nominal, LOST_SHARE * (1.0 + relief)) if w.measure not in named]
    return found


_WORDS = {"phase_margin_deg": "phase margin", "gain_margin_dB": "gain margin"}


def _lost(now: Margins, nominal: Margins, share: float) -> list[Weakness]:
    """Measures that are below this share of what they were."""
    pairs = (
        ("phase_margin_deg", now.phase_margin_deg, nominal.phase_margin_deg, "phase margin {:.3g}°, nominally {:.3g}°"),
        (
            "gain_margin_dB",
            smaller_gain_margin_dB(now),
            smaller_gain_margin_dB(nominal),
            "gain margin {:.3g} dB, nominally {:.3g} dB",
        ),
        (
            "sensitivity_peak",
            _distance(now),
            _distance(nominal),
            "distance from instability 1/M_s {:.2g}, nominally {:.2g}",
        ),
    )
    return [
        Weakness(measure, text.format(value, was) + ": more than half is lost")
        for measure, value, was, text in pairs
        if value is not None and was is not None and value < share * was
    ]


def _distance(m: Margins) -> float | None:
    return None if m.sensitivity_peak is None else 1.0 / m.sensitivity_peak
