"""A motor that takes commands, with equations and faults of its own, for the tests of commissioning.

Written apart from `servo_daemon.plant`: the linear part by a matrix exponential over a short step, dry friction by
sticking, a gap by a spring that pulls outside of it, a stop by a rebound.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.linalg import expm

from drivers.base import DriveInfo
from servo_daemon.commissioning import MotionLimits
from servo_daemon.samples import SampleBlock, make_block


@dataclass(frozen=True)
class Setup:
    """What motor it is, and what is wrong with it; SI units."""

    R: float = 1.0
    L: float = 1e-3
    K: float = 0.05
    J: float = 2e-5
    B: float = 2e-5
    rate_hz: float = 1000.0
    counts_per_rev: float = 8192.0
    noise_A: float = 0.005
    seed: int = 0
    encoder_sign: float = 1.0
    current_sign: float = 1.0
    locked: bool = False
    Tc: float = 0.0
    gap_rad: float = 0.0  # a load of J/2 behind it
    stop_rad: float = math.inf  # a hard stop on either side
    drop_share: float = 0.0  # of samples, in bursts
    encoder_dies_s: float = math.inf
    locks_s: float = math.inf  # the shaft is held from then on


_PEAKS = ("voltage_V", "current_A", "speed", "travel")


@dataclass
class CommandedMotor:
    """The drive: `read` gives one sample and lets one period pass."""

    setup: Setup
    peaks: dict[str, float] = field(default_factory=lambda: dict.fromkeys(_PEAKS, 0.0))
    silent_after_s: float = math.inf

    def __post_init__(self) -> None:
        s = self.setup
        self._substeps = 1 if not (s.Tc or s.gap_rad or math.isfinite(s.stop_rad)) else 8
        self._h = 1.0 / s.rate_hz / self._substeps
        J = 0.5 * s.J if s.gap_rad else s.J
        A = np.zeros((5, 5))
        A[0, 0], A[0, 1], A[0, 3] = -s.R / s.L, -s.K / s.L, 1 / s.L
        A[1, 0], A[1, 1], A[1, 4] = s.K / J, -s.B / J, -1 / J
        A[2, 1] = 1.0
        self._step = expm(A * self._h)[:3].tolist()
        self._still = math.exp(-s.R / s.L * self._h)
        self._J = J
        self._i = self._w = self._x = 0.0
        self._w_load = self._x_load = 0.0
        self._rng = np.random.default_rng(s.seed)
        self._n = 0
        self._dropping = 0
        self._shown: float | None = None
        self._voltage, self._until_s = 0.0, 0.0
        self.info = DriveInfo(
            "commanded", 1.0 / s.rate_hz, s.counts_per_rev, channels=("voltage_V", "current_A", "position_rad")
        )

    hold_s = 0.02
    can_wait = True

    @property
    def latency_s(self) -> float:
        return 1.0 / self.setup.rate_hz

    def acting_V(self, block: SampleBlock) -> np.ndarray:
        return np.full(len(block), self._voltage)

    def command(self, voltage_V: float, valid_for_s: float) -> None:
        self._voltage = voltage_V
        self._until_s = self._n / self.setup.rate_hz + min(valid_for_s, 0.05)

    @property
    def commanded_V(self) -> float:
        """The last command, valid or not."""
        return self._voltage

    def push(self, speed_rad_s: float) -> None:
        """From now the shaft turns so fast."""
        self._w = speed_rad_s

    @property
    def state(self) -> tuple[float, float, float]:
        return self._i, self._w, self._x

    def read(self, timeout_s: float) -> SampleBlock | None:
        s, t = self.setup, self._n / self.setup.rate_hz
        v = self._voltage if t < self._until_s else 0.0
        shown = self._sample(t, v)
        for _ in range(self._substeps):
            self._advance(v)
        self._n += 1
        self.peaks["voltage_V"] = max(self.peaks["voltage_V"], abs(v))
        if self._dropping == 0 and s.drop_share and self._rng.random() < s.drop_share / 5:
            self._dropping = int(self._rng.integers(1, 10 if self._rng.random() < 0.9 else 60))
        if self._dropping:
            self._dropping -= 1
            return None
        return None if t >= self.silent_after_s else shown

    def _sample(self, t: float, v: float) -> SampleBlock:
        s = self.setup
        if self._shown is None or t < s.encoder_dies_s:
            count = 2 * math.pi / s.counts_per_rev
            self._shown = s.encoder_sign * math.floor(self._x / count) * count
        i = s.current_sign * self._i + s.noise_A * self._rng.standard_normal()
        return make_block(
            np.array([t]),
            sequence=np.array([self._n]),
            voltage_V=np.array([v]),
            current_A=np.array([i]),
            position_rad=np.array([self._shown]),
        )

    def _advance(self, v: float) -> None:
        s, h = self.setup, self._h
        i, w, x = self._i, self._w, self._x
        load = self._teeth(h) if s.gap_rad else 0.0
        if s.locked or self._n >= s.locks_s * s.rate_hz or (s.Tc and w == 0.0 and abs(s.K * i - load) <= s.Tc):
            self._i, self._w = v / s.R + (i - v / s.R) * self._still, 0.0
        else:
            turning = w or s.K * i - load
            torque = load + math.copysign(s.Tc, turning) if s.Tc else load
            a = self._step
            self._i = a[0][0] * i + a[0][1] * w + a[0][3] * v + a[0][4] * torque
            self._w = a[1][0] * i + a[1][1] * w + a[1][3] * v + a[1][4] * torque
            self._x = a[2][0] * i + a[2][1] * w + a[2][2] * x + a[2][3] * v + a[2][4] * torque
            if s.Tc and w * self._w < 0.0:
                self._w = 0.0
            if abs(self._x) > s.stop_rad:
                self._x = math.copysign(s.stop_rad, self._x)
                self._w *= -0.3
        p = self.peaks
        p["current_A"] = max(p["current_A"], abs(self._i))
        p["speed"] = max(p["speed"], abs(self._w))
        p["travel"] = max(p["travel"], abs(self._x))

    def _teeth(self, h: float) -> float:
        """Torque on the load: a spring of 300 rad/s with damping, outside of the gap."""
        s = self.setup
        k = 0.5 * self._J * 300.0**2
        twist = self._x - self._x_load
        outside = twist - max(min(twist, 0.5 * s.gap_rad), -0.5 * s.gap_rad)
        torque = k * outside + (0.3 * k / 300.0 * (self._w - self._w_load) if outside else 0.0)
        self._w_load += h * torque / self._J
        self._x_load += h * self._w_load
        return torque

    def share_of(self, limits: MotionLimits) -> float:
        """Of the limit that was nearest, by the true motion: 1 touches it."""
        p = self.peaks
        return max(
            p["voltage_V"] / limits.voltage_V,
            p["current_A"] / limits.current_A,
            p["speed"] / limits.speed_rad_s,
            p["travel"] / limits.travel_rad,
        )


#: Motors without a fault, with limits.
HEALTHY = {
    "small": (Setup(), MotionLimits(12, 6, 150, 30, 60)),
    "middle": (
        Setup(R=3.57, L=2.5e-3, K=0.046, J=6e-5, B=6e-5, noise_A=0.003, seed=1),
        MotionLimits(24, 3, 200, 20, 60),
    ),
    "large": (Setup(R=0.5, L=1.5e-3, K=0.3, J=8e-3, B=0.02, noise_A=0.03, seed=2), MotionLimits(24, 20, 20, 6, 60)),
}

FAULTS = (
    "encoder_sign", "current_sign", "locked", "friction", "backlash", "hard_stop", "dropped", "encoder_dies",
)  # fmt: skip


def drawn(seed: int) -> tuple[Setup, MotionLimits, str]:
    """A motor of any size between 10 W and 1 kW with limits that its drive could break, and one fault."""
    rng = np.random.default_rng([seed, 32])
    R, K = float(np.exp(rng.uniform(np.log(0.3), np.log(5.0)))), float(np.exp(rng.uniform(np.log(0.03), np.log(0.3))))
    mechanical_s = float(np.exp(rng.uniform(np.log(0.008), np.log(0.1))))
    L = R * float(np.exp(rng.uniform(np.log(5e-4), np.log(0.2 * mechanical_s))))
    J = mechanical_s * K * K / R
    voltage = float(rng.uniform(12.0, 48.0))
    limits = MotionLimits(
        voltage_V=voltage,
        current_A=float(rng.uniform(0.1, 0.6)) * voltage / R,
        speed_rad_s=float(rng.uniform(0.1, 0.6)) * voltage / K,
        travel_rad=float(np.exp(rng.uniform(np.log(2.0), np.log(60.0)))),
        seconds=20.0,
    )
    fault = FAULTS[seed % len(FAULTS)]
    late = float(rng.uniform(0.5, 8.0))
    wrong: dict[str, Any] = {
        "encoder_sign": {"encoder_sign": -1.0},
        "current_sign": {"current_sign": -1.0},
        "locked": {"locked": True},
        "friction": {"Tc": float(rng.uniform(0.02, 0.3)) * K * limits.current_A},
        "backlash": {"gap_rad": float(rng.uniform(0.005, 0.1))},
        "hard_stop": {"stop_rad": float(rng.uniform(0.05, 0.6)) * limits.travel_rad},
        "dropped": {"drop_share": float(rng.uniform(0.002, 0.05))},
        "encoder_dies": {"encoder_dies_s": late},
    }[fault]
    noise = 0.002 * limits.current_A
    B = 0.03 * K * K / R
    return Setup(R=R, L=L, K=K, J=J, B=B, noise_A=noise, seed=seed, **wrong), limits, fault
