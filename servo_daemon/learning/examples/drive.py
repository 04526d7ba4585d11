"""For which drives a model serves: channels and sample rates. Loads nothing: the daemon's worker asks."""

from __future__ import annotations

from collections.abc import Collection

#: Channels of which there are features.
_CHANNELS = ("voltage_V", "current_A", "position_rad", "velocity_rad_s")
#: A drive's clock is not exact, and a capture's rate is rounded.
_RATE_TOLERANCE = 0.05


def trainable(channels: Collection[str]) -> tuple[str, ...]:
    """Those of a drive's channels that a model is trained with."""
    return tuple(c for c in _CHANNELS if c in channels)


def same_rate(one_hz: float, other_hz: float) -> bool:
    """Whether a model for one sample rate can be asked about windows of the other."""
    return abs(one_hz / other_hz - 1.0) < _RATE_TOLERANCE


def rounded_rate(rate_hz: float) -> float:
    """What to train for, so that a clock that is a little off finds the same model again."""
    return float(f"{rate_hz:.2g}")
