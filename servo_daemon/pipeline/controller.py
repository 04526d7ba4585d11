"""`[drive.controller]` as what tuning and the margins' watch understand."""

from __future__ import annotations

from servo_daemon.config import ControllerConfig, DriveConfig
from servo_daemon.published.knowledge import LoopFacts
from servo_daemon.tuning.knowledge import Ask, CascadeGains, MarginLimits


def incomplete(c: ControllerConfig) -> str | None:
    """Why the configured gains are no loop whose margins could be watched, in words; None: they are, or there are
    none."""
    if not (c.position_kp_1_s or c.position_ki_1_s2 or c.position_kd):
        return None
    if not c.speed_kp_V_s_rad and not c.speed_ki_V_rad:
        return "the position loop's output is a speed; the speed loop's gains (speed_kp_V_s_rad) are missing"
    return None if c.position_kp_1_s else "the position loop has no position_kp_1_s"


def gains_in_use(c: ControllerConfig) -> CascadeGains | None:
    """The configured gains; None where there are none, or not enough. Gains that are not given are zero."""
    if incomplete(c) is not None or not (c.speed_kp_V_s_rad or c.speed_ki_V_rad):
        return None
    return CascadeGains(
        speed_kp_V_s_rad=c.speed_kp_V_s_rad or 0.0,
        speed_ki_V_rad=c.speed_ki_V_rad or 0.0,
        position_kp_1_s=c.position_kp_1_s or None,
        position_ki_1_s2=c.position_ki_1_s2 or 0.0,
        position_kd=c.position_kd or 0.0,
        setpoint_weight=c.speed_setpoint_weight,
        filter_hz=c.speed_filter_hz,
    )


def loop_facts(config: DriveConfig, counts_per_rev: float | None = None) -> LoopFacts:
    """Of this drive.

    Args:
        counts_per_rev: as the driver or a capture tells it; the configuration wins.
    """
    c = config.controller
    return LoopFacts(
        ask=Ask(c.bandwidth_hz, c.settling_s),
        in_use=gains_in_use(c),
        rate_hz=c.rate_hz,
        delay_samples=c.delay_samples,
        filter_hz=c.speed_filter_hz,
        limits=MarginLimits(c.phase_margin_min_deg, c.gain_margin_min_dB, c.sensitivity_max),
        voltage_V=config.limits.voltage_V,
        counts_per_rev=config.load.counts_per_rev or counts_per_rev,
        nominal=config.nominal,
    )
