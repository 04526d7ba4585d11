"""A motor as a joint of a robot: what URDF, SDF and Isaac have a place for, at the output of the gear."""

from __future__ import annotations

from dataclasses import dataclass

from servo_daemon.export.model import ExportedModel
from servo_daemon.export.words import ALL_INERTIA, common_notes, not_expressed

#: Effects that are one number of a joint's friction.
EXPRESSED = ("coulomb_friction",)


@dataclass(frozen=True, slots=True)
class Joint:
    """At the output, SI units; None: not known. `effort` and `velocity` are limits.

    Attributes:
        inertia: J n².
        link_mass: of the moving link: as its inertia where it slides; 1 kg as a placeholder where it turns, which shows
            only the inertia.
        damping: B n².
        friction, breakaway: Tc n and, with Stribeck friction, Ts n.
        stall, no_load: torque and speed at the voltage's limit, without and with only the motor's own motion.
    """

    inertia: float | None
    link_mass: float | None
    damping: float | None
    friction: float | None
    breakaway: float | None
    effort: float | None
    velocity: float | None
    stall: float | None
    no_load: float | None


def joint_of(model: ExportedModel, target: str) -> Joint:
    """Raises BadInputError: neither inertia nor friction is known."""
    n, v = model.gear, {name: value.value for name, value in model.values.items()}
    if not {"J", "B", "Tc"} & set(v):
        raise model.lacking([name for name in ("J", "B", "Tc") if name in model.needed], "J, B or Tc", target)

    def times(name: str, factor: float) -> float | None:
        return v[name] * factor if name in v else None

    current, voltage, K, R = model.limits.get("current_A"), model.limits.get("voltage_V"), v.get("K"), v.get("R")
    speed = model.limits.get("velocity_rad_s")
    inertia = times("J", n**2)
    return Joint(
        inertia=inertia,
        link_mass=inertia if model.linear or inertia is None else 1.0,
        damping=times("B", n**2),
        friction=times("Tc", n),
        breakaway=times("Ts", n),
        effort=None if current is None or K is None else K * current * n,
        velocity=None if speed is None else speed / n,
        stall=None if voltage is None or K is None or R is None else K * voltage / R * n,
        no_load=None if voltage is None or K is None else voltage / K / n,
    )


def joint_notes(model: ExportedModel, joint: Joint, expressed: tuple[str, ...] = EXPRESSED) -> list[str]:
    """What of the model a simulator's joint cannot express."""
    notes = [*common_notes(model), ALL_INERTIA, *not_expressed(model, expressed)]
    electrical = [name for name in ("R", "L", "K") if name in model.values]
    if electrical:
        notes.append(f"{', '.join(electrical)} have no place in a joint: its input is a torque, not a voltage")
    for name, what in (("damping", "B"), ("inertia", "J")):
        if getattr(joint, name) is None:
            notes.append(f"{what} is not known: the file has no {name}")
    if joint.effort is None:
        notes.append("no limit of the torque: [drive.limits] current_A and K are not both known")
    return notes
