"""A permanent-magnet motor under field-oriented control, for simulated drives: not the estimator's plant.

In the amplitude-invariant dq frame, with its cross-coupling, stepped at the controller's rate:

    vd = R id + L did/dt − p ω L iq        J dω/dt = 1.5 p λ iq − B ω − Tc tanh(ω / 0.01)
    vq = R iq + L diq/dt + p ω (L id + λ)

A current controller with proportional and integral part, decoupling and the inverter's limit follows a speed
controller, which follows a speed of several sines.
"""

from __future__ import annotations

import math
import random
import time
from collections.abc import Callable
from dataclasses import dataclass

from servo_daemon.sim_drive.source import MAX_BEHIND_S

#: Control cycles a second.
CONTROL_HZ = 20_000
#: Bandwidth of the current controller and of the speed controller, rad/s.
_CURRENT_BANDWIDTH, _SPEED_BANDWIDTH = 1_000.0, 40.0
#: Cycles from one step of the speed controller to the next: it runs at a kilohertz.
_SPEED_EVERY = 20
#: Noise is drawn once and gone through again and again; a prime, so that both currents take all of it.
_NOISE_VALUES = 8_191
#: Of each current reading, 1 σ.
_NOISE_A = 0.05
#: Friction turns round within so many rad/s.
_FRICTION_WIDTH = 0.01


@dataclass(frozen=True, slots=True)
class Pmsm:
    """A motor with its load; phase values, amplitude-invariant. The default: a 270 KV outrunner with a flywheel.

    Attributes:
        R, L: Ω and H of a phase. flux: Wb of the rotor, peak. J, B, Tc: kg·m², N·m·s/rad, N·m.
        supply_V: of the inverter; the largest phase amplitude is 0.95/√3 of it.
    """

    R: float = 0.039
    L: float = 15.7e-6
    flux: float = 0.002917
    pole_pairs: int = 7
    J: float = 4e-4
    B: float = 1.5e-3
    Tc: float = 0.0
    supply_V: float = 24.0
    current_limit_A: float = 40.0

    @property
    def K_phase(self) -> float:
        """Torque constant of the equivalent DC motor with R and L as they are: √1.5 p λ."""
        return math.sqrt(1.5) * self.pole_pairs * self.flux

    @property
    def Kt(self) -> float:
        """Torque for a peak ampere of iq: 1.5 p λ."""
        return 1.5 * self.pole_pairs * self.flux


@dataclass(frozen=True, slots=True)
class Motion:
    """The speed asked for: a sum of sines.

    Attributes:
        sines: (rad/s, Hz) of each.
    """

    sines: tuple[tuple[float, float], ...] = ((60.0, 0.31), (40.0, 0.83), (25.0, 2.1), (10.0, 4.7))

    def speed(self, time_s: float) -> float:
        return sum(a * math.sin(2.0 * math.pi * f * time_s) for a, f in self.sines)


@dataclass(frozen=True, slots=True)
class Sums:
    """Of every control cycle since the start: how many, and the sums of what the controller saw and applied; `motoring`
    is the filtered q current, positive where it drives and negative where it brakes."""

    n: int = 0
    i_d: float = 0.0
    i_q: float = 0.0
    v_d: float = 0.0
    v_q: float = 0.0
    motoring: float = 0.0


class FocDrive:
    """The drive as its firmware sees it.

    Attributes:
        theta, omega: rad and rad/s. v_d, v_q: applied in the last cycle. i_q_filtered: what status messages carry, a
            low pass of a tenth a cycle. sums: for averages of any span.
    """

    def __init__(self, motor: Pmsm | None = None, motion: Motion | None = None, *, seed: int = 0) -> None:
        self.motor, self.motion = motor or Pmsm(), motion or Motion()
        self.theta = self.omega = self.i_d = self.i_q = self.v_d = self.v_q = 0.0
        self.i_q_filtered = 0.0
        self.sums = Sums()
        self._integral_d = self._integral_q = self._wanted = 0.0
        drawn = random.Random(seed)
        self._noise = [drawn.gauss(0.0, _NOISE_A) for _ in range(_NOISE_VALUES)]

    @property
    def v_q_parts(self) -> tuple[float, float]:
        """Of the next q voltage: the integral part, and what is fed forward."""
        ahead = self.motor.pole_pairs * self.omega * (self.motor.flux + self.motor.L * self.i_d)
        return self._integral_q, ahead

    @property
    def time_s(self) -> float:
        return self.sums.n / CONTROL_HZ

    def advance_to(self, time_s: float) -> None:
        """Run the controller up to this time; plain floats, 1 µs a cycle and some."""
        m, s, dt = self.motor, self.sums, 1.0 / CONTROL_HZ
        cycles = max(0, round(time_s * CONTROL_HZ) - s.n)
        p, kp, ki = m.pole_pairs, m.L * _CURRENT_BANDWIDTH, m.R * _CURRENT_BANDWIDTH * dt
        decay = math.exp(-m.R * dt / m.L)
        gain, limit = (1.0 - decay) / m.R, 0.95 * m.supply_V / math.sqrt(3.0)
        speed_gain, mechanical, noise = m.J * _SPEED_BANDWIDTH / m.Kt, dt / m.J, self._noise
        i_d, i_q, theta, omega, filtered = self.i_d, self.i_q, self.theta, self.omega, self.i_q_filtered
        integral_d, integral_q, wanted = self._integral_d, self._integral_q, self._wanted
        v_d, v_q, sum_id, sum_iq, sum_vd, sum_vq = self.v_d, self.v_q, s.i_d, s.i_q, s.v_d, s.v_q
        motoring = s.motoring
        for k in range(s.n, s.n + cycles):
            if k % _SPEED_EVERY == 0:
                speed = self.motion.speed(k * dt)
                wanted = max(-m.current_limit_A, min(m.current_limit_A, speed_gain * (speed - omega)))
            seen_d, seen_q = i_d + noise[k % _NOISE_VALUES], i_q + noise[k * 3 % _NOISE_VALUES]
            electrical, error_q = p * omega, wanted - seen_q
            back_q = electrical * (m.flux + m.L * i_d)
            v_d = integral_d - kp * seen_d - electrical * m.L * seen_q
            v_q = integral_q + kp * error_q + electrical * (m.flux + m.L * seen_d)
            if -limit < v_q < limit:
                integral_d -= ki * seen_d
                integral_q += ki * error_q
            else:
                v_q = limit if v_q > 0.0 else -limit
            sum_id += seen_d
            sum_iq += seen_q
            sum_vd += v_d
            sum_vq += v_q
            before = i_q
            i_d, i_q = (
                i_d * decay + gain * (v_d + electrical * m.L * i_q),
                i_q * decay + gain * (v_q - back_q),
            )
            torque = m.Kt * 0.5 * (before + i_q) - m.B * omega
            if m.Tc:
                torque -= m.Tc * math.tanh(omega / _FRICTION_WIDTH)
            theta += dt * (omega + 0.5 * mechanical * torque)
            omega += mechanical * torque
            filtered += 0.1 * (seen_q - filtered)
            motoring += filtered if v_q > 0.0 else -filtered
        self.i_d, self.i_q, self.theta, self.omega, self.i_q_filtered = i_d, i_q, theta, omega, filtered
        self._integral_d, self._integral_q, self.v_d, self.v_q = integral_d, integral_q, v_d, v_q
        self._wanted = wanted
        self.sums = Sums(s.n + cycles, sum_id, sum_iq, sum_vd, sum_vq, motoring)


class RunningFoc:
    """A drive that runs by the clock.

    Args:
        clock: seconds, monotonic.
    """

    def __init__(self, drive: FocDrive, clock: Callable[[], float] = time.monotonic) -> None:
        self._drive, self._clock, self._start_s = drive, clock, clock()

    @property
    def now_s(self) -> float:
        """Where the drive is, on the clock."""
        return self._start_s + self._drive.time_s

    @property
    def theta(self) -> float:
        """Its angle there, rad."""
        return self._drive.theta

    def now(self) -> FocDrive:
        """The drive at this instant. After a pause longer than `MAX_BEHIND_S` it goes on from where it was."""
        ahead_s = self._clock() - self._start_s - self._drive.time_s
        if ahead_s > MAX_BEHIND_S:
            self._start_s += ahead_s
        self._drive.advance_to(self._clock() - self._start_s)
        return self._drive
