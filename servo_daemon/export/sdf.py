"""`--to sdf`: a joint with its damping, friction and limits for Gazebo (SDFormat 1.9, joint/axis)."""

from __future__ import annotations

from servo_daemon.export.balances import rigid
from servo_daemon.export.joint import Joint, joint_notes, joint_of
from servo_daemon.export.model import Export, ExportedModel, Target
from servo_daemon.export.words import header, identifier, number, xml_comment


def write(model: ExportedModel) -> Export:
    """Raises BadInputError: neither inertia nor friction is known."""
    model = rigid(model, "sdf")
    joint, name = joint_of(model, "sdf"), identifier(model.name)
    notes = joint_notes(model, joint)
    values = {"damping": joint.damping, "friction": joint.friction}
    dynamics = [f"          <{key}>{number(v)}</{key}>" for key, v in values.items() if v is not None]
    limits = {"effort": joint.effort, "velocity": joint.velocity}
    limit = [f"          <{key}>{number(v)}</{key}>" for key, v in limits.items() if v is not None]
    if joint.inertia is not None and not model.linear:
        notes.append("only the inertia about the joint's axis is known: the link's mass of 1 kg is a placeholder")
    lines = [
        '<?xml version="1.0"?>',
        xml_comment([*header(model, notes), "damping, friction and limits are those at the output"]),
        '<sdf version="1.9">',
        f'  <model name="{name}">',
        f'    <link name="{name}_output">',
        *_inertial(joint),
        "    </link>",
        f'    <joint name="{name}" type="{"prismatic" if model.linear else "revolute"}">',
        "      <parent>world</parent>",
        f"      <child>{name}_output</child>",
        "      <axis>",
        "        <xyz>0 0 1</xyz>",
        *(["        <dynamics>", *dynamics, "        </dynamics>"] if dynamics else []),
        *(["        <limit>", *limit, "        </limit>"] if limit else []),
        "      </axis>",
        "    </joint>",
        "  </model>",
        "</sdf>",
        "",
    ]
    return Export("\n".join(lines).encode(), tuple(notes))


def _inertial(joint: Joint) -> list[str]:
    """The moving link's mass and inertia, where they are known."""
    if joint.inertia is None or joint.link_mass is None:
        return []
    i, mass = number(joint.inertia), number(joint.link_mass)
    return [
        "      <inertial>",
        f"        <mass>{mass}</mass>",
        f"        <inertia><ixx>{i}</ixx><iyy>{i}</iyy><izz>{i}</izz>",
        "          <ixy>0</ixy><ixz>0</ixz><iyz>0</iyz></inertia>",
        "      </inertial>",
    ]


TARGET = Target("sdf", ".sdf", write)
