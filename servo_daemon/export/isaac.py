"""`--to isaac`: the fields of Isaac Lab's actuators (isaaclab.actuators: ImplicitActuatorCfg, DCMotorCfg)."""

from __future__ import annotations

from servo_daemon.export.balances import rigid
from servo_daemon.export.joint import joint_notes, joint_of
from servo_daemon.export.model import Export, ExportedModel, Target
from servo_daemon.export.words import header, identifier, line_comments, number


def write(model: ExportedModel) -> Export:
    """Raises BadInputError: neither inertia nor friction is known."""
    model = rigid(model, "isaac")
    joint, name = joint_of(model, "isaac"), identifier(model.name)
    notes = joint_notes(model, joint, ("coulomb_friction", "stribeck_friction"))
    if "stribeck_friction" in model.effects:
        notes.append("stribeck_friction: PhysX breaks away at `friction` and slides at `dynamic_friction`; ws, the "
                     "speed over which one becomes the other, has no place")  # fmt: skip
    implicit = {
        "armature": joint.inertia,
        "friction": joint.breakaway if joint.breakaway is not None else joint.friction,
        "dynamic_friction": joint.friction,
        "viscous_friction": joint.damping,
        "effort_limit_sim": joint.effort,
        "velocity_limit_sim": joint.velocity,
    }
    motor = {
        "saturation_effort": joint.stall,
        "velocity_limit": joint.no_load,
        "effort_limit": joint.effort if joint.effort is not None else joint.stall,
    }
    if joint.stall is None:
        notes.append("DCMotorCfg's torque-speed line needs R, K and [drive.limits] voltage_V: DC_MOTOR is empty")
        motor = {}
    else:
        notes.append("DC_MOTOR is the line between the torque at standstill and the speed without load at voltage_V")
    lines = [
        line_comments([*header(model, notes), "at the output; friction in N·m (or N) as of Isaac Sim 5"], "#"),
        "# from isaaclab.actuators import DCMotorCfg, ImplicitActuatorCfg",
        f'# {name} = ImplicitActuatorCfg(joint_names_expr=["{name}"], stiffness=..., damping=..., **JOINT)',
        "JOINT = {",
        *(f'    "{key}": {number(value)},' for key, value in implicit.items() if value is not None),
        "}",
        "DC_MOTOR = {",
        *(f'    "{key}": {number(value)},' for key, value in motor.items() if value is not None),
        "}",
        "",
    ]
    return Export("\n".join(lines).encode(), tuple(notes))


TARGET = Target("isaac", ".py", write)
