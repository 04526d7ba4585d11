"""`--to simulink`: an m-file with a struct of the parameters, the equations, and which block takes which of them."""

from __future__ import annotations

from servo_daemon.export.balances import balances, expressible, rigid
from servo_daemon.export.expressions import MATLAB
from servo_daemon.export.model import Export, ExportedModel, Target
from servo_daemon.export.words import common_notes, header, identifier, line_comments, not_expressed, number, with_std

#: Labels in the dialogs of Simscape Electrical's "DC Motor" and Simscape's "Rotational Friction" and "Gear Box".
_BLOCKS = (
    ("R", "DC Motor: Armature resistance"),
    ("L", "DC Motor: Armature inductance"),
    ("K", "DC Motor: Back-emf constant and torque constant, V/(rad/s) = N*m/A"),
    ("J", "DC Motor: Rotor inertia"),
    ("B", "DC Motor: Rotor damping"),
    ("Tc", "Rotational Friction: Coulomb friction torque"),
    ("Ts", "Rotational Friction: Breakaway friction torque"),
    ("ws", "Rotational Friction: Breakaway friction velocity is ws / sqrt(2)"),
)


def write(model: ExportedModel) -> Export:
    """Raises BadInputError: a parameter is not known."""
    model = rigid(model, "simulink")
    model.require(model.needed, "simulink")
    b, name = balances(model), identifier(model.name)
    notes = [*common_notes(model), *not_expressed(model, [n for n in model.effects if expressible(n)])]
    core = ["i", "omega", "theta"] if model.drive == "voltage" else ["omega", "theta"]
    at = {state: f"x({k})" for k, state in enumerate([*core, *b.states], start=1)}
    rates = ([b.text(b.current_rate, MATLAB)] if model.drive == "voltage" else []) + [
        b.text(b.speed_rate, MATLAB), "omega", *(b.text(rate, MATLAB) for rate in b.states.values())
    ]  # fmt: skip
    arguments = ", ".join(["t", "u", *at])
    current, speed, angle = b.shown(model.drive, MATLAB)
    i, gear = model.meaning.factors[1], number(model.gear)
    lines = [
        line_comments(header(model, notes), "%"),
        *(f"{name}.{n} = {number(v.value)};  % {with_std(v)}" for n, v in model.values.items()),
        f"{name}.gear = {number(model.gear)};",
        "% blocks of Simscape:",
        *(f"%   {label}: {name}.{n}" for n, label in _BLOCKS if n in model.values),
        f"%   Gear Box: Gear ratio: {name}.gear",
        f"% states: {', '.join(at)}; u: {model.drive} of the DC motor",
        *(f"{n} = {name}.{n};" for n in b.used if n in model.values),
        f"rates = @({arguments}) [" + "; ".join(rates) + "];  % without dry friction and dry drop",
        f"{name}.rates = @(t, x, u) rates(t, u, {', '.join(at.values())});",
        "% torque against the motion, and voltage against the current: they stop and never drive",
        f"{name}.dry_friction = @({arguments}) [{b.text(b.forward, MATLAB)}, {b.text(b.backward, MATLAB)}];",
        f"{name}.dry_drop = @({arguments}) {b.text(b.dry_drop, MATLAB)};",
        "% current, speed and angle as the drive's sensors show them",
        f"{name}.sensed = @({arguments}) [{current} / {i!r}; {speed} / {gear}; {angle} / {gear}];",
        f"clear rates {' '.join(n for n in b.used if n in model.values)};",
        "",
    ]
    return Export("\n".join(lines).encode(), tuple(notes))


TARGET = Target("simulink", ".m", write)
