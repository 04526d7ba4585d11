"""What is played after the first look: the plan that tells most of what is not known yet, within what is safe."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from servo_daemon.commissioning.envelope import Envelope
from servo_daemon.commissioning.limits import MotionLimits
from servo_daemon.commissioning.session import Session
from servo_daemon.experiment import Limits, Request, Sensors, plan_motion
from servo_daemon.samples import F64

#: Shares of the limits that the rounds go to, one after the other; the last for all that follow. What is left above is
#: for what the model lacks.
SHARES = (0.35, 0.5, 0.7)
#: Length of a round, s: three blocks of the planner.
ROUND_S = 6.0
#: Samples from a speed that is too high until 0 V acts; at the greatest acceleration they take at most this share of
#: the limit.
_AHEAD, _AHEAD_SHARE = 4, 0.2
#: RMS of the current as a share of its limit: what heats no more than a motor stands.
_RMS_SHARE = 0.5
#: Shares of what the envelope allows at rest and of the speed at which it allows nothing.
_ENVELOPE_VOLTAGE, _ENVELOPE_SPEED = 0.9, 0.5
#: Noise that the planner takes for the voltage, as a share of the limit: half a step of a converter of ten bits.
_INPUT_SHARE = 0.0005


def planned(
    session: Session, limits: MotionLimits, motor: Mapping[str, float], effects: tuple[str, ...],
    wanted: Sequence[str], share: float, seed: int,
) -> F64:  # fmt: skip
    """The voltages of a round, shape (n,).

    Raises:
        BadInputError: no motion stays within the limits.
    """
    rate = 1.0 / session.period_s
    request = Request(
        known=motor,
        fixed=(),
        model=effects,
        wanted=tuple(wanted),
        between=(),
        limits=_safe(session, limits, motor, share),
        sensors=Sensors(
            2 * math.pi / session.count_rad,
            max(session.supervisor.current_noise_A, 1e-4 * limits.current_A),
            _INPUT_SHARE * limits.voltage_V,
        ),
        seconds=min(ROUND_S, max(session.time_left_s, 1.0)),
        rate_hz=rate,
        seed=seed,
    )
    return plan_motion(request).reference


def _safe(session: Session, limits: MotionLimits, motor: Mapping[str, float], share: float) -> Limits:
    reach = Envelope.of(motor, limits.voltage_V, limits.current_A).reach_V
    faster = motor["K"] / motor["J"] * session.period_s * _AHEAD  # rad/s per A
    current = min(share * limits.current_A, _AHEAD_SHARE * limits.speed_rad_s / faster)
    last = session.supervisor.last
    away = 0.0 if last is None else abs(last.position_rad)
    return Limits(
        voltage_V=min(share * limits.voltage_V, _ENVELOPE_VOLTAGE * reach),
        current_A=current,
        velocity_rad_s=min(share * limits.speed_rad_s, _ENVELOPE_SPEED * reach / motor["K"]),
        travel_rad=max(share * limits.travel_rad - away, 0.1 * limits.travel_rad),
        current_rms_A=min(_RMS_SHARE * limits.current_A, current),
    )
