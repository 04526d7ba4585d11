"""`--to urdf`: a joint with its damping, friction and limits, as ROS and its tools read it (urdf/XML/joint)."""

from __future__ import annotations

from servo_daemon.export.balances import rigid
from servo_daemon.export.joint import Joint, joint_notes, joint_of
from servo_daemon.export.model import Export, ExportedModel, Target
from servo_daemon.export.words import header, identifier, number, xml_comment


def write(model: ExportedModel) -> Export:
    """Raises BadInputError: neither inertia nor friction is known."""
    model = rigid(model, "urdf")
    joint, name = joint_of(model, "urdf"), identifier(model.name)
    notes = _notes(model, joint)
    kind = "prismatic" if model.linear else "continuous"
    dynamics = {"damping": joint.damping, "friction": joint.friction}
    given = " ".join(f'{key}="{number(value)}"' for key, value in dynamics.items() if value is not None)
    lines = [
        '<?xml version="1.0"?>',
        xml_comment([*header(model, notes), "damping, friction and limits are those at the output"]),
        f'<robot name="{name}">',
        f'  <link name="{name}_base"/>',
        f'  <link name="{name}_output">',
        *_inertial(joint),
        "  </link>",
        f'  <joint name="{name}" type="{kind}">',
        f'    <parent link="{name}_base"/>',
        f'    <child link="{name}_output"/>',
        '    <axis xyz="0 0 1"/>',
        f"    <dynamics {given}/>",
        *_limit(joint),
        "  </joint>",
        f'  <transmission name="{name}_transmission">',
        "    <type>transmission_interface/SimpleTransmission</type>",
        f'    <joint name="{name}"/>',
        f'    <actuator name="{name}_motor"><mechanicalReduction>{number(model.gear)}</mechanicalReduction></actuator>',
        "  </transmission>",
        "</robot>",
        "",
    ]
    return Export("\n".join(lines).encode(), tuple(notes))


def _notes(model: ExportedModel, joint: Joint) -> list[str]:
    """What the file cannot express, and what the user has to put in."""
    notes = joint_notes(model, joint)
    if model.linear:
        notes.append("a prismatic joint needs a <limit> with lower, upper, effort and velocity: put yours in")
    elif not _limit(joint):
        notes.append("the joint has no <limit>: current_A and velocity_rad_s under [drive.limits] give one")
    if joint.inertia is not None and not model.linear:
        notes.append(
            "only the inertia about the joint's axis is known: the link's mass of 1 kg at the axis is a placeholder "
            "that no motion shows"
        )
    return notes


def _limit(joint: Joint) -> list[str]:
    """The limits of torque and speed where both are known: the element has no place for one alone."""
    if joint.effort is None or joint.velocity is None:
        return []
    return [f'    <limit effort="{number(joint.effort)}" velocity="{number(joint.velocity)}"/>']


def _inertial(joint: Joint) -> list[str]:
    """The moving link's mass and inertia, where they are known."""
    if joint.inertia is None or joint.link_mass is None:
        return []
    i, mass = number(joint.inertia), number(joint.link_mass)
    return [
        f'    <inertial><mass value="{mass}"/>',
        f'      <inertia ixx="{i}" iyy="{i}" izz="{i}" ixy="0" ixz="0" iyz="0"/></inertial>',
    ]


TARGET = Target("urdf", ".urdf", write)
