"""Stops the motor on any doubt. Knows samples, commands and limits, and nothing of any estimate.

The signs are checked by energy, which holds for every motor that starts at rest and is driven by nothing else:
electrical work ∫ v i dt and mechanical work ∝ ∫ i dθ are never negative, whatever friction, play or stop there is.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from servo_daemon.commissioning.limits import MotionLimits
from servo_daemon.commissioning.stop import Reason, Stop, StoppedError

#: A limit is called reached at this share of it; what is left is for noise and the sample until 0 V acts.
_REACHED = 0.95
#: Half of the window over which the speed is a mean, in samples: what it shows is so old.
_LATE = 2
#: Samples over which a speed is taken.
_WINDOW = 4
#: Standard deviations of the current by which two samples differ without a rise: three of a difference.
_NO_RISE = 4.2
#: A sum is negative beyond noise at so many standard deviations.
_SIGMA = 8.0
#: The shaft moves when it has gone so many counts; at rest it stays within them.
_COUNTS = 6
#: A locked shaft takes this share of the greatest current; without any current this share of the voltage.
_LOCKED, _OPEN = 0.6, 0.1
#: A longer delay of the line is named in the message of a limit that was passed, samples.
_LATE_SAMPLES = 20.0
#: A shaft that was seen to move and does not for so long, s, with so many times the current that moved it first.
_STUCK_S, _STUCK = 0.15, 3.0
#: No current is taken for less noisy than this share of its limit: σ of a step of a converter of twelve bits.
LEAST_NOISE = 1e-4
#: At rest the current is no more than this share of its limit.
_REST = 0.05
#: The drive reports this share of its limit more or less than it was told, so many samples on end.
_VOLTAGE, _VOLTAGE_SAMPLES = 0.05, 5


@dataclass(frozen=True, slots=True)
class Reading:
    """One sample: s, V, A, rad from the start, °C or None."""

    time_s: float
    voltage_V: float
    current_A: float
    position_rad: float
    temperature_C: float | None = None


class Supervisor:
    """Checks every sample.

    Args:
        limits: of the run.
        period_s: of the samples.
        count_rad: one encoder count.
        watchdog_s: time without a sample that ends the run while it is driven.

    Attributes:
        stopping_s: a shaft at 0 V goes on by its speed times this; set anew when the motor is known better.
        resting: nothing has been commanded yet.
        driven: a voltage acts that is to move the motor.
        latency_s: from a sample until the command that answers it acts.
        moving_A: the greatest current until the shaft moved first; None: it has not yet.
        bounded_current: the command is such that even a stalled motor stays within the limit.
    """

    def __init__(self, limits: MotionLimits, period_s: float, count_rad: float, watchdog_s: float) -> None:
        self._limits, self._period_s, self._count, self._watchdog_s = limits, period_s, count_rad, watchdog_s
        self.stopping_s = 0.05
        self.resting = True
        self.driven = False
        self.bounded_current = False
        self.latency_s = period_s
        self.peak_current_A = self.peak_speed_rad_s = self.peak_travel_rad = self.peak_voltage_V = 0.0
        self.speed_rad_s = 0.0
        self._last: Reading | None = None
        self._at: deque[tuple[float, float]] = deque(maxlen=_WINDOW + 1)
        self._speeds: deque[float] = deque(maxlen=_WINDOW + 1)
        self._rest_n, self._rest_sum, self._rest_squares = 0, 0.0, 0.0
        self._electrical = self._electrical_var = 0.0
        self._mechanical = self._mechanical_di = self._mechanical_dx = 0.0
        self._differs = 0
        self.moving_A: float | None = None
        self._stuck_at, self._stuck_since, self._stuck_A = 0.0, 0.0, 0.0

    @property
    def has_moved(self) -> bool:
        """Beyond what an encoder at rest shows."""
        return self.peak_travel_rad > _COUNTS * self._count

    @property
    def current_noise_A(self) -> float:
        """1 σ, as the current was at rest, beside its mean."""
        n = max(self._rest_n, 1)
        return math.sqrt(max(self._rest_squares / n - (self._rest_sum / n) ** 2, 0.0))

    @property
    def offset_A(self) -> float:
        """Mean of the current at rest."""
        return self._rest_sum / max(self._rest_n, 1)

    @property
    def last(self) -> Reading | None:
        """The sample checked last."""
        return self._last

    @property
    def stands_since_s(self) -> float:
        """Since then the encoder stands, while something is commanded."""
        return self._stuck_since

    def skip(self, r: Reading) -> None:
        """Goes on from this sample after a time in which nobody looked and nothing was commanded."""
        self._last = r
        self._at.clear()
        self._speeds.clear()
        self._at.append((r.time_s, r.position_rad))
        self._speeds.append(0.0)
        self.speed_rad_s = 0.0
        self._stuck_at, self._stuck_since, self._stuck_A = r.position_rad, r.time_s, 0.0

    def check(self, r: Reading, commanded_V: float) -> None:
        """Takes the next sample.

        Args:
            commanded_V: the voltage that should act from this sample on.

        Raises:
            StoppedError: there is a doubt.
        """
        last = self._last
        if last is not None and not self.driven and r.time_s - last.time_s > self._watchdog_s:
            self.skip(r)  # samples are lost while nothing acts: there is nothing to stop
            return
        self._check_data(r, last, commanded_V)
        self._take(r)
        self._last = r
        if self.resting:
            self._rest(r)
            return
        if last is not None:
            self._check_signs(last, r)
        self._check_limits(r, last)
        self._check_answers(r)

    def _check_data(self, r: Reading, last: Reading | None, commanded_V: float) -> None:
        if not all(map(math.isfinite, (r.time_s, r.voltage_V, r.current_A, r.position_rad))):
            self._stop("bad_data", "a reading is not a number or marked as wrong by the drive", r)
        if last is not None and r.time_s - last.time_s > self._watchdog_s:
            self._stop("data_missing", f"no sample for {1e3 * (r.time_s - last.time_s):.3g} ms", r)
        if last is not None and r.time_s <= last.time_s:
            self._stop("bad_data", "the device's time does not go on", r)
        wrong = abs(r.voltage_V - commanded_V) > _VOLTAGE * self._limits.voltage_V
        self._differs = self._differs + 1 if wrong else 0
        if self._differs >= _VOLTAGE_SAMPLES:
            self._stop("voltage_differs", f"the drive applies {r.voltage_V:.3g} V and not {commanded_V:.3g} V", r)

    def _take(self, r: Reading) -> None:
        """Take note of a checked sample's speed and peaks."""
        self._at.append((r.time_s, r.position_rad))
        (t0, x0) = self._at[0]
        self.speed_rad_s = (r.position_rad - x0) / (r.time_s - t0) if r.time_s > t0 else 0.0
        self._speeds.append(self.speed_rad_s)
        self.peak_voltage_V = max(self.peak_voltage_V, abs(r.voltage_V))
        self.peak_current_A = max(self.peak_current_A, abs(r.current_A))
        self.peak_speed_rad_s = max(self.peak_speed_rad_s, abs(self.speed_rad_s))
        self.peak_travel_rad = max(self.peak_travel_rad, abs(r.position_rad))

    def _rest(self, r: Reading) -> None:
        """Nothing is commanded: nothing may happen."""
        self._rest_n += 1
        self._rest_sum += r.current_A
        self._rest_squares += r.current_A**2
        if self.has_moved:
            self._stop("not_at_rest", "the shaft moves although no voltage is commanded", r)
        if self._rest_n > 20 and abs(self.offset_A) > _REST * self._limits.current_A:
            self._stop("not_at_rest", f"{self.offset_A:.3g} A although no voltage is commanded", r)

    def _check_signs(self, last: Reading, r: Reading) -> None:
        noise = max(self.current_noise_A, LEAST_NOISE * self._limits.current_A)
        dt = r.time_s - last.time_s
        mean = 0.5 * (last.current_A + r.current_A) - self.offset_A
        self._electrical += last.voltage_V * mean * dt
        self._electrical_var += (last.voltage_V * noise * dt) ** 2
        dx, di = r.position_rad - last.position_rad, r.current_A - last.current_A
        self._mechanical += mean * dx
        self._mechanical_di += di * di
        self._mechanical_dx += dx * dx
        electrical_std = math.sqrt(self._electrical_var)
        if self._electrical < -_SIGMA * electrical_std:
            text = "the current flows against the voltage: its sensor has the wrong sign"
            self._stop("current_sign", text, r)
        mechanical_std = math.sqrt(self._count**2 / 12 * self._mechanical_di + noise**2 * self._mechanical_dx)
        if self._electrical > _SIGMA * electrical_std and self._mechanical < -_SIGMA * mechanical_std:
            text = (
                "the shaft turns against the torque: the encoder has the wrong sign (or the motor's wires are swapped)"
            )
            self._stop("encoder_sign", text, r)

    def _check_limits(self, r: Reading, last: Reading | None) -> None:
        lim, ahead = self._limits, self.latency_s / self._period_s
        rise = gain = 0.0
        if self.driven:  # what nothing drives does not rise; and noise and one count are no rise
            noise = _NO_RISE * self.current_noise_A
            if last is not None and not self.bounded_current:
                rise = max(0.0, abs(r.current_A) - abs(last.current_A) - noise)
            count = self._count / (_WINDOW * self._period_s)
            faster = abs(self._speeds[-1]) - abs(self._speeds[0]) - count
            gain = max(0.0, faster) / max(1, len(self._speeds) - 1)
        outward = max(0.0, math.copysign(1.0, r.position_rad) * self.speed_rad_s)
        reached = (
            ("current", abs(r.current_A) + ahead * rise, lim.current_A, "A"),
            ("speed", abs(self.speed_rad_s) + (_LATE + ahead) * gain, lim.speed_rad_s, "rad/s"),
            (
                "travel",
                abs(r.position_rad) + outward * (self.stopping_s + self.latency_s - self._period_s),
                lim.travel_rad,
                "rad",
            ),
        )
        for name, value, limit, unit in reached:
            if value > _REACHED * limit:
                late = f" (commands act {1e3 * self.latency_s:.0f} ms late)" if ahead > _LATE_SAMPLES else ""
                self._stop("limit", f"{name} is about to pass its limit of {limit:g} {unit}{late}", r)
        if lim.temperature_C is not None and r.temperature_C is not None and r.temperature_C > lim.temperature_C:
            self._stop("limit", f"temperature has passed its limit of {lim.temperature_C:g} °C", r)

    def _check_answers(self, r: Reading) -> None:
        lim, noise = self._limits, self.current_noise_A
        silent = self.peak_current_A < max(_SIGMA * noise, 1e-3 * lim.current_A)
        if abs(r.voltage_V) > _OPEN * lim.voltage_V and silent:
            self._stop("no_current", "no current flows although there is a voltage: wire or current sensor open", r)
        if abs(r.current_A) > _LOCKED * lim.current_A and not self.has_moved:
            self._stop("no_motion", "the shaft does not move: locked, or the encoder does not count", r)

        self._check_stuck(r)

    def _check_stuck(self, r: Reading) -> None:
        """An encoder that dies, or a shaft that gets stuck, after it has moved."""
        if self.moving_A is None and self.has_moved:
            self.moving_A = self.peak_current_A
        if not self.driven or abs(r.position_rad - self._stuck_at) > 1.5 * self._count:
            self._stuck_at, self._stuck_since, self._stuck_A = r.position_rad, r.time_s, 0.0
        self._stuck_A = max(self._stuck_A, abs(r.current_A - self.offset_A))
        long = r.time_s - self._stuck_since > _STUCK_S
        if self.moving_A is not None and long and self._stuck_A > _STUCK * self.moving_A:
            text = "the shaft moved and now does not: the encoder has died, or the shaft is stuck or at a stop"
            self._stop("motion_ended", text, r)

    def _stop(self, reason: Reason, text: str, r: Reading) -> None:
        raise StoppedError(Stop(reason, text, r.time_s))
