"""Logs of the programs that come with a drive, known by the names of their columns: what these mean there.

Sources: VESC Tool 6 (`RT Data` and `Sampled Data` logs), moteus tview (`servo_stats`, `servo_control`), SimpleFOC's
monitor, TMotorCANControl. VESC, moteus and SimpleFOC report amplitude-invariant dq values of one instant, VESC's
real-time data means since the row before; the capture's metadata say so (`signal_meaning.py`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from servo_daemon.column_names import RPM, TURN, Meaning

INSTANT = {"voltage": "instant", "convention": "dq"}
#: VESC's firmware casts what it sends to whole hundredths of an ampere and thousandths of a volt, toward zero.
_MEAN = {
    "voltage": "mean",
    "current": "mean",
    "convention": "dq",
    "truncated_A": "0.01",
    "truncated_V": "0.001",
}


@dataclass(frozen=True, slots=True)
class ProgramLog:
    """A kind of log.

    Attributes:
        name: of the program, for the user.
        marks: column names that only this kind has together.
        meanings: what its columns mean; one that is not here means nothing.
        metadata: of a capture made of it.
        channel: beginning of its signals' names, where a file holds several tables.
        formulas: column -> formula and its operands, where a column has to be computed.
    """

    name: str
    marks: frozenset[str]
    meanings: Mapping[str, Meaning]
    metadata: Mapping[str, str] = field(default_factory=dict)
    formulas: Mapping[str, tuple[str, tuple[str, ...]]] = field(default_factory=dict)
    channel: str = ""


def _q_axis(phases: str) -> tuple[str, tuple[str, ...]]:
    """The q component of three phase values by the electrical angle `Phase`, °: Clarke's amplitude-invariant and Park's
    transformation, as VESC's firmware has them."""
    a, b, c = (f"{phases}{k}" for k in (1, 2, 3))
    angle = f"({math.pi / 180!r} * Phase)"
    beta = f"({1 / math.sqrt(3)!r} * ({b} - {c}))"
    alpha = f"((2 * {a} - {b} - {c}) / 3)"
    return f"{beta} * cos{angle} - {alpha} * sin{angle}", (a, b, c, "Phase")


PROGRAM_LOGS = (
    ProgramLog(
        "VESC Tool, real-time data",
        frozenset({"ms_today", "erpm", "q_axis_current", "duty_cycle"}),
        {
            "ms_today": Meaning("time_s", 1e-3),
            "q_axis_voltage": Meaning("voltage_V"),
            "q_axis_current": Meaning("current_A"),
            "encoder_position": Meaning("position_rad", math.pi / 180),
            "erpm": Meaning("erpm", RPM),
        },
        _MEAN,
    ),
    ProgramLog(
        "VESC Tool, sampled data",
        frozenset({"T", "I1", "I2", "I3", "V1", "V2", "V3", "Phase"}),
        {"T": Meaning("time_s")},
        INSTANT,
        {"voltage_V": _q_axis("V"), "current_A": _q_axis("I")},
    ),
    *(
        ProgramLog(
            "moteus, servo_stats",
            frozenset({"timestamp", "position", "q_A", beside}),
            {
                "timestamp": Meaning("time_s"),
                "position": Meaning("position_rad", TURN),
                "velocity": Meaning("velocity_rad_s", TURN),
                "q_A": Meaning("current_A"),
                "i_q_A": Meaning("current_A"),
                "q_V": Meaning("voltage_V"),
                "torque_Nm": Meaning("torque_Nm"),
            },
            INSTANT,
            channel="servo_stats",
        )
        for beside in ("d_A", "power_W")
    ),
    ProgramLog(
        "moteus, servo_control",
        frozenset({"timestamp", "i_q_A", "q_V"}),
        {"timestamp": Meaning("time_s"), "q_V": Meaning("voltage_V"), "i_q_A": Meaning("current_A")},
        INSTANT,
    ),
    ProgramLog(
        "TMotorCANControl",
        frozenset({"pi_time", "output_angle", "output_velocity", "output_torque"}),
        {
            "pi_time": Meaning("time_s"),
            "output_angle": Meaning("position_rad"),
            "output_velocity": Meaning("velocity_rad_s"),
            "output_torque": Meaning("torque_Nm"),
        },
    ),
)


def program_log(names: Sequence[str]) -> ProgramLog | None:
    """The kind of log that has columns of these names; None: none that is known."""
    there = {name.rpartition(".")[2] for name in names}
    return next((log for log in PROGRAM_LOGS if log.marks <= there), None)


#: SimpleFOC's monitor, by the number of its columns: `_monitor` prints what its bit mask asks for, in this order.
_SIMPLEFOC = {
    4: ("target", "Uq_V", "vel_rad/s", "angle_rad"),
    5: ("target", "Uq_V", "Iq_mA", "vel_rad/s", "angle_rad"),
    7: ("target", "Uq_V", "Ud_V", "Iq_mA", "Id_mA", "vel_rad/s", "angle_rad"),
}
#: The angle's steps and the speed's mean between them go together so closely only if they are those of one motion.
_SAME_MOTION = 0.98


def simplefoc(rows: Sequence[Sequence[str]]) -> tuple[tuple[str, ...], float] | None:
    """Names and rate, Hz, of a bare table that looks like SimpleFOC's monitor: its last column is the integral of the
    one before. The rate is what makes it so. None: it does not look like it.

    Args:
        rows: the first rows' cells.
    """
    names = _SIMPLEFOC.get(len(rows[0])) if len(rows) > 9 else None
    if names is None:
        return None
    try:
        table = np.array(rows, dtype=np.float64)
    except ValueError:
        return None
    steps, speed = np.diff(table[:, -1]), (table[1:, -2] + table[:-1, -2]) / 2.0
    size = float(np.sqrt((steps @ steps) * (speed @ speed)))
    if size == 0.0 or float(steps @ speed) < _SAME_MOTION * size:
        return None
    return names, float(speed @ speed) / float(steps @ speed)
