"""From what the user asks for to gains that give it, on the exact sampled loop; or the most that can be reached.

A design has to keep `DESIGN_LIMITS` at the estimate and the drive's own limits over the whole region of motors.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from servo_daemon.errors import TuningError
from servo_daemon.samples import F64
from servo_daemon.tuning.assess import weaknesses
from servo_daemon.tuning.design import Family, lateness_s
from servo_daemon.tuning.knowledge import Ask, LoopSetup, MarginLimits, MotorKnowledge, named
from servo_daemon.tuning.laws import Gains, controller
from servo_daemon.tuning.margins import Margins, margins
from servo_daemon.tuning.response import Response, bandwidth_hz, response, settling_s
from servo_daemon.tuning.sampled import Controller, SampledMotor, sampled_motor
from servo_daemon.tuning.worst import Region, Worst, worst_case

#: What a new design keeps at the estimate: the margins that SIMC has at its fastest recommended setting (Skogestad
#: 2003, table 1: M_s 1.59 to 1.70, gain margin 2.96 to 3.14, phase margin 47 to 61°), rounded down.
DESIGN_LIMITS = MarginLimits(phase_margin_deg=45.0, gain_margin_dB=8.0, sensitivity_peak=1.7)
#: Bandwidth over sample rate: beyond, what lies between the samples is not controlled, and nothing of the motor that
#: this model lacks (torsion, PWM, current ripple) is small any more. Textbooks ask for 20 samples a cycle (Franklin,
#: Powell & Workman, *Digital Control of Dynamic Systems*), 10 at the very least.
RATE_SHARE = 0.1
#: Without an ask: this share of the bandwidth that can be reached.
_UNASKED_SHARE = 0.5
#: Design frequencies that are looked at, slowest as a share of Nyquist's; then bisections between two of them.
_SCAN, _BISECTIONS, _SLOWEST = 16, 24, 1e-5
#: Settling time times bandwidth lies between these: 0.6 for one pole or two equal ones, more where a loop rings.
_SETTLING_TIMES_BANDWIDTH = (0.15, 6.0)
#: A bandwidth this far from the wanted one between two neighbouring designs is a jump: none lies between.
_JUMP = 0.005


@dataclass(frozen=True, slots=True)
class Design:
    """One family's gains.

    Attributes:
        worst: over the region of motors; None where there is none.
        capped: what was asked for is out of reach and these are the fastest acceptable gains; `reason` says why.
    """

    family: Family
    gains: Gains
    margins: Margins
    worst: Worst | None
    response: Response
    capped: bool
    reason: str | None


def check_ask(ask: Ask, rate_hz: float) -> None:
    """Refuse what no controller at this rate can do.

    Raises:
        TuningError: not positive, both, too fast for the rate, or so slow that one sample changes next to nothing.
    """
    if ask.bandwidth_hz is not None and ask.settling_s is not None:
        raise TuningError("bandwidth and settling time are both asked for: give one of them")
    for name, value in (("bandwidth", ask.bandwidth_hz), ("settling time", ask.settling_s)):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise TuningError(f"the {name} must be a positive number, not {value:g}")
    fastest = RATE_SHARE * rate_hz
    if ask.bandwidth_hz is not None and ask.bandwidth_hz > fastest:
        text = f"a bandwidth of {ask.bandwidth_hz:g} Hz is too fast for {rate_hz:g} samples a second"
        raise TuningError(f"{text}: ask for at most {fastest:g} Hz")
    if ask.settling_s is not None and ask.settling_s < 1.0 / fastest:
        text = f"settling within {ask.settling_s:g} s is too fast for {rate_hz:g} samples a second"
        raise TuningError(f"{text}: ask for at least {1.0 / fastest:g} s")
    slowest = _SLOWEST * rate_hz
    if ask.bandwidth_hz is not None and ask.bandwidth_hz < slowest:
        text = f"a bandwidth of {ask.bandwidth_hz:g} Hz is too slow for {rate_hz:g} samples a second"
        raise TuningError(f"{text}: ask for at least {slowest:g} Hz, or sample more slowly")
    if ask.settling_s is not None and ask.settling_s > 1.0 / slowest:
        text = f"settling within {ask.settling_s:g} s is too slow for {rate_hz:g} samples a second"
        raise TuningError(f"{text}: ask for at most {1.0 / slowest:g} s, or sample more slowly")


def find(family: Family, motor: MotorKnowledge, setup: LoopSetup, ask: Ask, region: Region | None) -> Design:
    """Gains of this family.

    Raises:
        TuningError: no gains of this family are acceptable, however slow.
    """
    search = _Search(family, motor, setup)
    slowest, fastest = search.range()
    omega, reason = search.as_asked(ask, slowest, fastest)
    if region is not None and search.weak(omega, region):
        safe = _last_true(lambda x: not search.weak(x, region), slowest, omega)
        if safe is None:
            raise TuningError(f"{family.title}: no gains keep the margins over the {region.described}")
        omega, slower = safe, f"slowed down, or the margins would be too small within the {region.described}"
        reason = slower if reason is None else f"{reason}; {slower}"
    return search.design(omega, region, reason)


def _last_true(acceptable: Callable[[float], bool], low: float, high: float) -> float | None:
    """The largest argument between that is acceptable, on the assumption that all above it are not; None: none is."""
    if not acceptable(low):
        return None
    while high / low > 1.02:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if acceptable(middle) else (low, middle)
    return low


class _Search:
    """One family for one motor; `omega` is the family's design frequency, rad/s."""

    def __init__(self, family: Family, motor: MotorKnowledge, setup: LoopSetup) -> None:
        self._family, self._setup = family, setup
        self._p = named(motor.log_values)
        self._motor = self._sampled(motor.log_values[None, :])
        given, own = setup.limits, DESIGN_LIMITS
        self._limits = MarginLimits(
            max(given.phase_margin_deg, own.phase_margin_deg),
            max(given.gain_margin_dB, own.gain_margin_dB),
            min(given.sensitivity_peak, own.sensitivity_peak),
        )

    def _sampled(self, log_values: F64) -> SampledMotor:
        return sampled_motor(log_values, self._setup.period_s, self._setup.delay_samples)

    def _loop(self, omega: float) -> tuple[Gains, Controller]:
        gains = self._family.make(self._p, self._setup, omega)
        return gains, controller(gains, self._setup.period_s)

    def _acceptable(self, omega: float) -> bool:
        try:
            _, loop = self._loop(omega)
        except (np.linalg.LinAlgError, ValueError):
            return False
        if weaknesses(margins(self._motor, loop).of(0), None, self._limits):
            return False
        bandwidth = bandwidth_hz(self._motor, loop)
        return bandwidth is not None and bandwidth <= RATE_SHARE * self._setup.rate_hz

    def range(self) -> tuple[float, float]:
        """Slowest and fastest acceptable design frequency, rad/s.

        Raises:
            TuningError: none is.
        """
        nyquist = math.pi * self._setup.rate_hz
        scan = nyquist * np.logspace(math.log10(_SLOWEST), 0.0, _SCAN)
        good = [self._acceptable(float(omega)) for omega in scan]
        if not any(good):
            text = (
                f"{self._family.title}: no gains have margins at {self._setup.rate_hz:g} samples a second and a delay"
            )
            raise TuningError(f"{text} of {self._setup.delay_samples:g} samples: {self._late(nyquist / 100)}")
        first = good.index(True)
        last = next((k for k in range(first, _SCAN) if not good[k]), _SCAN) - 1
        high = float(scan[min(last + 1, _SCAN - 1)])
        return float(scan[first]), _last_true(self._acceptable, float(scan[last]), high) or float(scan[last])

    def as_asked(self, ask: Ask, slowest: float, fastest: float) -> tuple[float, str | None]:
        """The design frequency that does what was asked, or the fastest and why it is not enough."""
        if ask.settling_s is not None:
            return self._for_settling(ask.settling_s, slowest, fastest)
        reach = self._bandwidth(fastest)
        wanted = _UNASKED_SHARE * reach if ask.bandwidth_hz is None else ask.bandwidth_hz
        if wanted > reach:
            return fastest, f"at most {reach:.3g} Hz: {self._why_not_faster(fastest)}"
        low, high = self._around(wanted, slowest, fastest)
        if self._bandwidth(high) < (1.0 + _JUMP) * wanted or ask.bandwidth_hz is None:
            return high, None
        ends = f"from {self._bandwidth(low):.3g} to {self._bandwidth(high):.3g} Hz"
        return low, f"as it gets faster its bandwidth jumps {ends}, past a resonance of motor and loop"

    def _around(self, wanted_hz: float, low: float, high: float) -> tuple[float, float]:
        """Two neighbouring design frequencies with a bandwidth below and not below this one; or an end twice."""
        if self._bandwidth(low) >= wanted_hz:
            return low, low
        if self._bandwidth(high) < wanted_hz:
            return high, high
        for _ in range(_BISECTIONS):
            middle = math.sqrt(low * high)
            low, high = (low, middle) if self._bandwidth(middle) >= wanted_hz else (middle, high)
        return low, high

    def _for_settling(self, wanted: float, slowest: float, fastest: float) -> tuple[float, str | None]:
        """The slowest that settles in time, of those whose bandwidth can be right for it at all."""
        ends = [self._around(product / wanted, slowest, fastest)[0] for product in _SETTLING_TIMES_BANDWIDTH]
        scan = np.geomspace(ends[0], ends[1], 2 * _SCAN)
        times = np.array([self._settling(float(omega), 4.0 * wanted) for omega in scan])
        if times.min() > wanted:
            best, least = float(scan[times.argmin()]), float(times.min())
            if math.isinf(least):
                best, least = fastest, self._settling(fastest, 1000.0 * wanted)
            when = "much later" if math.isinf(least) else f"after {least:.3g} s at the earliest"
            return best, f"settles {when}: {self._why_not_faster(best)}"
        k = int((times <= wanted).argmax())
        if k == 0:
            return float(scan[0]), None
        low, high = float(scan[k - 1]), float(scan[k])
        for _ in range(_BISECTIONS // 2):
            middle = math.sqrt(low * high)
            low, high = (low, middle) if self._settling(middle, 4.0 * wanted) <= wanted else (middle, high)
        return high, None

    def _settling(self, omega: float, horizon_s: float) -> float:
        """s; infinite where it is not within the horizon."""
        found = settling_s(self._motor, self._loop(omega)[1], horizon_s)
        return math.inf if found is None else found

    def _bandwidth(self, omega: float) -> float:
        found = bandwidth_hz(self._motor, self._loop(omega)[1])
        return math.inf if found is None else found

    def weak(self, omega: float, region: Region) -> bool:
        """Whether the drive's own limits are broken somewhere in the region."""
        return bool(weaknesses(self._worst(self._loop(omega)[1], region).margins, None, self._setup.limits))

    def _worst(self, loop: Controller, region: Region) -> Worst:
        return worst_case(lambda motors: margins(self._sampled(motors), loop), region)

    def design(self, omega: float, region: Region | None, reason: str | None) -> Design:
        gains, loop = self._loop(omega)
        return Design(
            family=self._family,
            gains=gains,
            margins=margins(self._motor, loop).of(0),
            worst=None if region is None else self._worst(loop, region),
            response=response(self._motor, loop),
            capped=reason is not None,
            reason=reason,
        )

    def _why_not_faster(self, fastest: float) -> str:
        if self._bandwidth(fastest) > 0.97 * RATE_SHARE * self._setup.rate_hz:
            return f"{self._setup.rate_hz:g} samples a second allow no more"
        limits = self._limits
        kept = f"M_s {limits.sensitivity_peak:g}, {limits.phase_margin_deg:g}°, {limits.gain_margin_dB:g} dB"
        return f"margins are kept ({kept}), and {self._late(fastest)}"

    def _late(self, omega: float) -> str:
        try:
            gains, _ = self._loop(omega)
        except (np.linalg.LinAlgError, ValueError):
            return "the loop acts too late"
        parts = sorted(lateness_s(self._p, gains, self._setup).items(), key=lambda part: -part[1])
        told = ", ".join(f"{name} {1e3 * late:.3g} ms" for name, late in parts if late > 0)
        return f"the loop acts late by {1e3 * sum(late for _, late in parts):.3g} ms ({told})"
