"""Motors with their drives: from 60 mN·m/A to 1.2 N·m/A, electrical time constants from 0.3 to 16 ms."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Motor:
    """A linear DC motor, its encoder and what its drive allows. SI units.

    Attributes:
        name: for tables.
        R: armature resistance, Ω.
        L: armature inductance, H.
        K: torque constant = back-EMF constant, N·m/A.
        J: inertia on the motor's side, kg·m²; the inertia J_l of backlash and compliance comes on top.
        B: viscous friction, N·m·s/rad.
        supply_V: the drive's supply; no voltage command exceeds it.
        rated_current_A: what the motor stands continuously, A.
        current_limit_A: the drive's limit, A; it lowers the voltage command that would exceed it.
        counts_per_rev: encoder counts a revolution.
        source: where the values come from.
    """

    name: str
    R: float
    L: float
    K: float
    J: float
    B: float
    supply_V: float
    rated_current_A: float
    current_limit_A: float
    counts_per_rev: float
    source: str

    @property
    def speed_max_rad_s(self) -> float:
        """Speed without load at full supply, rad/s."""
        return self.supply_V * self.K / (self.R * self.B + self.K**2)

    @property
    def working_torque_Nm(self) -> float:
        """Torque at rated current, N·m: the measure of how faint a hidden torque is."""
        return self.K * self.rated_current_A

    @property
    def time_constant_s(self) -> float:
        """Mechanical time constant at constant voltage, s."""
        return self.J * self.R / (self.R * self.B + self.K**2)


PAPER = Motor(
    name="paper",
    R=0.4937,
    L=2.2769e-3,
    K=0.30628,
    J=0.009751,
    B=0.51141,
    supply_V=24.0,
    rated_current_A=15.0,
    current_limit_A=40.0,
    counts_per_rev=16384,
    source="the paper's result of its method 2; the drive's limits are ours",
)
#: maxon RE 40, 150 W, 48 V, order number 148877: R, L and K from its catalogue page. The catalogue's rotor has
#: 137 g·cm²; inertia and viscous friction here are those of the rotor with a small load, and ours.
RE40 = Motor(
    name="re40",
    R=1.13,
    L=0.33e-3,
    K=60.3e-3,
    J=4.0e-5,
    B=3.0e-5,
    supply_V=48.0,
    rated_current_A=3.0,
    current_limit_A=8.0,
    counts_per_rev=4096,
    source="maxon catalogue (R, L, K); load and limits plausible",
)
GEAR_MOTOR = Motor(
    name="gear",
    R=2.2,
    L=1.3e-3,
    K=0.30,
    J=1.5e-3,
    B=1.5e-3,
    supply_V=12.0,
    rated_current_A=1.5,
    current_limit_A=4.0,
    counts_per_rev=8192,
    source="plausible: a 12 V brushed motor of 37 mm, seen at the output of its 30:1 gear",
)
LARGE_SERVO = Motor(
    name="large",
    R=0.35,
    L=5.5e-3,
    K=1.2,
    J=0.08,
    B=0.05,
    supply_V=100.0,
    rated_current_A=12.0,
    current_limit_A=30.0,
    counts_per_rev=10000,
    source="plausible: a large slow servo, complex pole pair at 57 rad/s",
)
BELT_SERVO = Motor(
    name="belt",
    R=1.2,
    L=2.4e-3,
    K=0.14,
    J=1.6e-4,
    B=2.0e-3,
    supply_V=48.0,
    rated_current_A=5.0,
    current_limit_A=15.0,
    counts_per_rev=4000,
    source="plausible: a 48 V brushed servo of 57 mm on a belt axis with sealed bearings",
)

#: Those that the matrices draw from; `BELT_SERVO` stands beside them, so that no draw of theirs changes.
MOTORS = {motor.name: motor for motor in (PAPER, RE40, GEAR_MOTOR, LARGE_SERVO)}
