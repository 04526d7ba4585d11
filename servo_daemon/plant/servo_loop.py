"""The paper's servo mechanism: its transfer functions as printed, and the loop as we close it, sample by sample too.

The mechanism (paper, figure 3): an input potentiometer turns the wanted angle into a voltage (k_io), an operational
amplifier, attenuator, preamplifier and servo amplifier raise it (k_s = k_op·k_au·k_pu·k_su), the motor turns, and a
tacho generator feeds its speed back (k_g). What the paper prints has no feedback of the angle, so a step of the wanted
angle gives a ramp, and it gives no gains. Here the loop is closed through a second, equal potentiometer on the shaft:

    v = k_s [k_io (θ_i − θ_o) − k_g ω],  |v| ≤ supply

The gains in `ServoGains` are ours. `docs/model.md` lists what is printed and what is wrong with it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import casadi as ca
import numpy as np

from servo_daemon.plant.build import PlantModel
from servo_daemon.plant.linear import linear_step
from servo_daemon.samples import F64

_DAMPING = 0.35  # a step then overshoots by about 30 % at most: lively, and far from unstable


@dataclass(frozen=True, slots=True)
class ServoGains:
    """Gains of the servo mechanism. The defaults are ours, the paper gives none.

    With them a 50° step asks for 20 V, which a 24 V supply can give, and the paper's motor settles in 0.3 s.

    Attributes:
        k_io: potentiometers, V/rad: 10 V over 300° of travel.
        k_op, k_au, k_pu, k_su: operational amplifier, attenuator, preamplifier, servo amplifier, V/V.
        k_g: tacho generator, V·s/rad: 7 V at 1000 rpm.
    """

    k_io: float = 10.0 / math.radians(300.0)
    k_op: float = 1.0
    k_au: float = 0.6
    k_pu: float = 10.0
    k_su: float = 2.0
    k_g: float = 7.0 / (1000.0 * 2.0 * math.pi / 60.0)

    @property
    def k_s(self) -> float:
        """All amplifiers in a row, V/V."""
        return self.k_op * self.k_au * self.k_pu * self.k_su


class Transfer(NamedTuple):
    """A transfer function's polynomials in s, highest power first."""

    numerator: F64
    denominator: F64


def motor_speed(p: Mapping[str, float]) -> Transfer:
    """ω/v of the unloaded motor, rad/s per V: K / ((J s + B)(R + s L) + K²). The paper prints this one correctly."""
    electrical, mechanical = np.array([p["L"], p["R"]]), np.array([p["J"], p["B"]])
    denominator = np.polyadd(np.polymul(mechanical, electrical), [p["K"] ** 2])
    return Transfer(np.array([p["K"]]), np.asarray(denominator, np.float64))


def closed_servo(p: Mapping[str, float], gains: ServoGains) -> Transfer:
    """θ_o/θ_i as we close it: tacho feedback inside, the potentiometer on the shaft outside. Unity at rest."""
    motor = motor_speed(p)
    forward = gains.k_s * motor.numerator
    with_tacho = np.polyadd(motor.denominator, gains.k_g * forward)
    wanted = gains.k_io * forward
    denominator = np.polyadd(np.polymul(with_tacho, [1.0, 0.0]), wanted)
    return Transfer(wanted, np.asarray(denominator, np.float64))


def suitable_gains(p: Mapping[str, float], supply_V: float, rate_hz: float) -> ServoGains:
    """Gains for any motor, at this supply and sample rate.

    The servo amplifier's gain goes with its supply (a 50° step asks for 5/6 of it), and is then halved until every mode
    of the sampled loop, which acts only once a sample, is damped with a ratio of at least 0.35.
    """
    gains = ServoGains(k_su=supply_V / 12.0)
    Ad, Bd = linear_step(p, 1.0 / rate_hz)
    for _ in range(40):
        feedback = gains.k_s * np.array([[0.0, gains.k_g, gains.k_io]])
        modes = np.log(np.linalg.eigvals(Ad - Bd[:, :1] @ feedback).astype(complex) + 1e-300)
        if np.all(-modes.real >= _DAMPING * np.abs(modes)):
            break
        gains = replace(gains, k_su=gains.k_su / 2.0)
    return gains


class SampleRow(NamedTuple):
    """Columns of a sample of `servo_step` before the parameters."""

    time_s: int = 0
    step_s: int = 1
    reference_rad: int = 2
    dither_V: int = 3
    hidden_V: int = 4


ROW = SampleRow()
N_ROW = len(ROW)


class OutputRow(NamedTuple):
    """Columns of an output of `servo_step` before the plant's state."""

    voltage_V: int = 0
    current_A: int = 1
    velocity_rad_s: int = 2
    position_rad: int = 3


OUT = OutputRow()
N_OUT = len(OUT)


def servo_constants(gains: ServoGains, supply_V: float, voltage_lsb_V: float) -> F64:
    """The `constants` of `servo_step`."""
    return np.array([gains.k_io, gains.k_s, gains.k_g, supply_V, voltage_lsb_V])


def servo_step(model: PlantModel) -> ca.Function:
    """Controller and plant in one step for `SampleLoop`, so that a closed loop runs in blocks without Python.

    At sample k the sensors are read, the voltage follows at once and is held until sample k + 1 (ZOH), as a drive does
    whose computation is short against its sample period. The potentiometer and the tacho see the shaft as it is; what
    effects do to the recorded sensors does not reach the loop.

    Returns:
        function "step": state (n,) of the plant; constants of `servo_constants`; sample: `SampleRow`, then the model's
        parameters -> (next state; output: `OutputRow` as the record's sensors show it, then the plant's true state),
        all at the moment of the sample. `hidden_V` acts on the motor and is not in `voltage_V`.
    """
    x, c = ca.SX.sym("x", len(model.states)), ca.SX.sym("c", 5)
    row = ca.SX.sym("row", N_ROW + len(model.parameters))
    k_io, k_s, k_g, supply, lsb = (c[k] for k in range(5))
    p, t = row[N_ROW:], row[ROW.time_s]
    omega, theta = (x[model.state_names.index(name)] for name in ("velocity_rad_s", "position_rad"))
    wanted = k_s * (k_io * (row[ROW.reference_rad] - theta) - k_g * omega) + row[ROW.dither_V]
    safe = ca.if_else(lsb > 0, lsb, 1.0)
    stepped = ca.if_else(lsb > 0, safe * ca.floor(wanted / safe + 0.5), wanted)
    v = ca.fmax(ca.fmin(stepped, supply), -supply)
    x_next = model.step(x, v + row[ROW.hidden_V], p, t, row[ROW.step_s])
    output = ca.vertcat(v, model.sensed(x, p, t), x)
    return ca.Function("step", [x, c, row], [x_next, output])
