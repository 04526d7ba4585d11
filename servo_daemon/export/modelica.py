"""`--to modelica`: a model with pins, flange and bearing friction of the Modelica Standard Library."""

from __future__ import annotations

import numpy as np

from servo_daemon.export.balances import Balances, balances, expressible, rigid
from servo_daemon.export.expressions import MODELICA
from servo_daemon.export.model import Export, ExportedModel, Target
from servo_daemon.export.words import common_notes, header, identifier, line_comments, not_expressed, number, with_std

#: Dry friction that a table over the speed cannot say.
_NO_TABLE = ("asymmetric_friction", "load_dependent_friction", "position_dependent_friction", "brush_voltage_drop",
             "freewheel_drive")  # fmt: skip
#: Points of Stribeck's curve, up to so many times ws.
_POINTS, _UP_TO = 17, 4.0


def write(model: ExportedModel) -> Export:
    """Raises BadInputError: a parameter is not known."""
    model = rigid(model, "modelica")
    model.require(model.needed, "modelica")
    b, name = balances(model), identifier(model.name)
    notes = _notes(model, b)
    voltage = model.drive == "voltage"
    ports = (
        "  Modelica.Electrical.Analog.Interfaces.PositivePin p;\n  Modelica.Electrical.Analog.Interfaces.NegativePin n;"
        if voltage
        else f'  Modelica.Blocks.Interfaces.RealInput input_u "{model.drive} of the motor, SI units";'
    )
    states = "\n".join(f"  Real {state}(start = 0, fixed = true);" for state in b.states)
    current = "  Modelica.Units.SI.Current i(start = 0, fixed = true);\n" if voltage else ""
    text = f"""{line_comments(header(model, notes), "//")}
model {name}
{ports}
  Modelica.Mechanics.Rotational.Interfaces.Flange_b flange "output of the gear";
{_parameters(model, b)}
  Modelica.Mechanics.Rotational.Components.Inertia rotor(J = J);
  Modelica.Mechanics.Rotational.Sources.Torque drive "of the current, viscous friction and smooth loads";
  Modelica.Mechanics.Rotational.Components.BearingFriction friction(tau_pos = {_table(model)});
  Modelica.Mechanics.Rotational.Components.IdealGear gear(ratio = {number(model.gear)}, useSupport = false);
{current}  Real t;
  Real u;
  Modelica.Units.SI.AngularVelocity omega;
  Modelica.Units.SI.Angle theta;
{states}
equation
""" + "\n".join([*_equations(b, voltage=voltage), f"end {name};", ""])
    return Export(text.replace("\n\n", "\n").encode(), tuple(notes))


def _notes(model: ExportedModel, b: Balances) -> list[str]:
    """What the file leaves out, and what its units stand for."""
    expressed = [n for n in model.effects if expressible(n) and n not in _NO_TABLE]
    notes = [*common_notes(model), *not_expressed(model, expressed)]
    if b.sensed:
        notes.append("errors of the sensors are not in it: `i`, `omega` and `theta` are the motor's")
    if model.linear:
        notes.append("a linear axis: 1 rad stands for 1 m, 1 N.m for 1 N")
    return notes


def _equations(b: Balances, *, voltage: bool) -> list[str]:
    """The two balances, the effects' states, and how the parts of the drive train are connected."""
    motor = "p.v - n.v" if voltage else "input_u"
    equations = [f"  u = {motor};", "  t = time;", "  omega = rotor.w;", "  theta = rotor.phi;"]
    if voltage:
        equations += ["  p.i = i;", "  n.i = -i;", f"  der(i) = {b.text(b.current_rate, MODELICA)};"]
    equations += [f"  der({state}) = {b.text(rate, MODELICA)};" for state, rate in b.states.items()]
    return [
        *equations,
        f"  drive.tau = J * ({b.text(b.speed_rate, MODELICA)});",
        "  connect(drive.flange, rotor.flange_a);",
        "  connect(rotor.flange_b, friction.flange_a);",
        "  connect(friction.flange_b, gear.flange_a);",
        "  connect(gear.flange_b, flange);",
    ]


def _parameters(model: ExportedModel, b: Balances) -> str:
    table = "Tc", "Tc_neg", "Ts", "ws"  # in the table of the bearing's friction
    names = [n for n in b.used if n not in table]
    return "\n".join(
        f'  parameter Real {n} = {number(model.values[n].value)} "{with_std(model.values[n])}";' for n in names
    )


def _table(model: ExportedModel) -> str:
    """Friction over speed, N·m over rad/s."""
    if "stribeck_friction" in model.effects:
        Tc, Ts, ws = (model.values[name].value for name in ("Tc", "Ts", "ws"))
        speeds = np.linspace(0.0, _UP_TO * ws, _POINTS)
        rows = [(w, Tc + (Ts - Tc) * float(np.exp(-((w / ws) ** 2)))) for w in speeds.tolist()]
    else:
        level = model.values["Tc"].value if "coulomb_friction" in model.effects else 0.0
        rows = [(0.0, level), (1.0, level)]
    return "[" + "; ".join(f"{number(w)}, {number(level)}" for w, level in rows) + "]"


TARGET = Target("modelica", ".mo", write)
