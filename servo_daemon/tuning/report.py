"""All that tuning says of a drive: the three designs, and the gains that are in use."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from servo_daemon.samples import F64
from servo_daemon.tuning.advice import Advice, advise
from servo_daemon.tuning.assess import Weakness, margins_of, weaknesses
from servo_daemon.tuning.design import FAMILIES
from servo_daemon.tuning.knowledge import NEEDED, Ask, CascadeGains, LoopSetup, MotorKnowledge
from servo_daemon.tuning.laws import controller
from servo_daemon.tuning.margins import Margins, margins
from servo_daemon.tuning.response import Response, response
from servo_daemon.tuning.sampled import SampledMotor, sampled_motor
from servo_daemon.tuning.search import Design, check_ask, find
from servo_daemon.tuning.worst import Region, Worst, region_of, worst_case


@dataclass(frozen=True, slots=True)
class InUse:
    """The gains that the drive has now.

    Attributes:
        nominal: their margins with the nominal values; None where these are not all given.
        weak: what is wrong with them at the estimate.
        response: None where the loop is unstable.
    """

    gains: CascadeGains
    margins: Margins
    nominal: Margins | None
    worst: Worst | None
    response: Response | None
    weak: tuple[Weakness, ...]
    advice: Advice


@dataclass(frozen=True, slots=True)
class Tuning:
    """Everything. `region` in words; None: no worst case is claimed."""

    motor: MotorKnowledge
    setup: LoopSetup
    ask: Ask
    region: str | None
    not_covered: tuple[str, ...]
    designs: tuple[tuple[Design, Advice], ...]
    in_use: InUse | None


def tune(
    motor: MotorKnowledge,
    setup: LoopSetup,
    ask: Ask,
    nominal: F64 | None = None,
    tolerance: Mapping[str, float] | None = None,
) -> Tuning:
    """Gains for the motor as it is, and what those in use are worth. Takes about 0.3 s.

    Args:
        nominal: logarithms of the nominal R, L, K, J, B, shape (5,); None where one of them is not given.
        tolerance: of parameters, relative, in (0, 1); counts only where nothing has a covariance.

    Raises:
        TuningError: what is asked for is impossible; the text says what would be possible.
    """
    check_ask(ask, setup.rate_hz)
    region = region_of(motor, tolerance)
    families = [f for f in FAMILIES if not (motor.answer and f.measures_current)]
    designs = tuple(find(family, motor, setup, ask, region) for family in families)
    covered = () if region is None else region.names
    return Tuning(
        motor=motor,
        setup=setup,
        ask=ask,
        region=None if region is None else region.described,
        not_covered=tuple(name for name in NEEDED if name not in covered and name not in motor.open),
        designs=tuple((d, advise(d.gains, d.response, motor, setup)) for d in designs),
        in_use=None if setup.in_use is None else _in_use(setup.in_use, motor, setup, nominal, region),
    )


def _in_use(
    gains: CascadeGains, motor: MotorKnowledge, setup: LoopSetup, nominal: F64 | None, region: Region | None
) -> InUse:
    now = margins_of(gains, motor.log_values, setup)
    meant = None if nominal is None else margins_of(gains, nominal, setup)
    loop = controller(gains, setup.period_s)

    def sampled(motors: F64) -> SampledMotor:
        return sampled_motor(motors, setup.period_s, setup.delay_samples)

    shown = response(sampled(motor.log_values[None, :]), loop) if now.stable else None
    return InUse(
        gains=gains,
        margins=now,
        nominal=meant,
        worst=None if region is None else worst_case(lambda motors: margins(sampled(motors), loop), region),
        response=shown,
        weak=tuple(weaknesses(now, meant, setup.limits)),
        advice=advise(gains, shown, motor, setup),
    )
