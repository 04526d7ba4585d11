"""What is to be simulated so that a drive of the configuration gets a learned model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from servo_daemon.config import DriveConfig
from servo_daemon.errors import ConfigError
from servo_daemon.learning.examples.drive import trainable
from servo_daemon.parameters import LINEAR

if TYPE_CHECKING:
    from servo_daemon.learning.examples.drawing import TrainingSpec

#: Without a drive that has told its own.
_RATE_HZ = 1000.0
_USUAL = ("voltage_V", "current_A", "position_rad")


def training_spec(
    drive: DriveConfig,
    *,
    nominal: Mapping[str, float] | None = None,
    rate_hz: float | None = None,
    channels: tuple[str, ...] = _USUAL,
    spread: float = 3.0,
    window_s: float | None = None,
    seed: int = 0,
) -> TrainingSpec:
    """For one drive.

    Args:
        nominal: the datasheet; None: the configuration's.
        rate_hz: None: the simulated driver's own, else 1000 Hz.
        channels: that it delivers.
        window_s: None: as the configuration has it.

    Raises:
        ConfigError: the datasheet lacks a parameter.
        BadInputError: see `TrainingSpec`.
    """
    from servo_daemon.learning.examples.drawing import TrainingSpec

    known = _datasheet(drive.name, drive.nominal if nominal is None else nominal)
    rate = rate_hz or (drive.options.get("rate_hz") if drive.driver == "simulated" else None) or _RATE_HZ
    return TrainingSpec(
        known,
        drive.model,
        spread=spread,
        rate_hz=float(rate),
        window_s=drive.estimation.refresh_window_s if window_s is None else window_s,
        supply_V=drive.limits.voltage_V,
        counts_per_rev=drive.load.counts_per_rev,
        channels=trainable(channels),
        seed=seed,
    )


def _datasheet(drive: str, nominal: Mapping[str, float]) -> dict[str, float]:
    """What training takes of it.

    Raises:
        ConfigError: it lacks a parameter.
    """
    known = {name: value for name, value in nominal.items() if name != "J_m"}
    if missing := [p.name for p in LINEAR if p.name not in known]:
        raise ConfigError(
            f"drive {drive}: training needs a datasheet: nominal {', '.join(missing)} missing under "
            "[drive.nominal] (`servo-daemon fit` finds them from a capture)"
        )
    return known
