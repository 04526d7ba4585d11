"""`--to mujoco`: a joint and its actuator as MJCF. MuJoCo 3.7 and newer have a `dcmotor` with winding, cogging,
Stribeck friction and heat; where the winding is not known, a `general` actuator takes the current.

MuJoCo, *XML reference*, actuator/dcmotor and body/joint; *DC Motor Model* (dcmotor.pdf), sections 2.1 to 2.4.
"""

from __future__ import annotations

import math

from servo_daemon.export.balances import rigid
from servo_daemon.export.model import Export, ExportedModel, Target
from servo_daemon.export.words import (
    ALL_INERTIA,
    common_notes,
    header,
    identifier,
    not_expressed,
    number,
    xml_comment,
)  # fmt: skip
from servo_daemon.plant.effects import effects_by_name
from servo_daemon.plant.effects.winding_heating import ALPHA_COPPER_1_K

#: Bristles of MuJoCo's LuGre friction swing with this share of the step: explicit integration is stable below 2.
_BRISTLE_SWING = 0.5
#: Impedance of dry friction (MuJoCo, *Computation*, solver parameters): nearly rigid, so that it holds a shaft.
_HARD = 0.9999
#: Steps in a time constant of the winding; and the shortest and longest step, s.
_STEPS, _SHORTEST_S, _LONGEST_S = 10.0, 2e-5, 2e-3
#: A body must have a mass: this share of the joint's inertia is left to it.
_BODY = 1e-6
_EXPRESSED = ("coulomb_friction", "stribeck_friction", "cogging_torque", "winding_heating", "quadratic_drag")


def write(model: ExportedModel) -> Export:
    """Raises BadInputError: J, B, or (with voltage or current as input) K is not known."""
    model = rigid(model, "mujoco")
    winding = "R" in model.values and "K" in model.values
    core = ("R", "K", "J", "B") if winding else (("J", "B") if model.drive == "torque" else ("K", "J", "B"))
    own = [p.name for n in model.effects if n in _EXPRESSED for p in effects_by_name()[n].parameters]
    v = model.require((*core, *own), "mujoco")
    expressed = _EXPRESSED if winding else ("coulomb_friction", "quadratic_drag")
    notes = [*common_notes(model), ALL_INERTIA, *not_expressed(model, expressed)]
    if winding and "L" not in model.values:
        notes.append("without L the current follows the voltage at once")
    if not winding:
        control = "current, A" if "K" in v else "torque"
        notes.append(f"without R the winding cannot be simulated: the actuator's control is the {control}")
    timestep = _timestep_s(v, model.get("L"))
    actuator = _dcmotor(model, v, timestep, notes) if winding else _general(model, v)
    told = [*header(model, notes), _SCALED, *(_older(model, v) if winding else [])]
    name = identifier(model.name)
    inertia = number(_BODY * v["J"] * model.gear**2)
    lines = [
        xml_comment(told),
        f'<mujoco model="{name}">',
        f'  <option timestep="{number(timestep)}" gravity="0 0 0" integrator="implicitfast"/>',
        "  <worldbody>",
        f'    <body name="{name}_output">',
        f'      <inertial pos="0 0 0" mass="{inertia}" diaginertia="{inertia} {inertia} {inertia}"/>',
        f"      {_joint(model, v, timestep, winding=winding)}",
        "    </body>",
        "  </worldbody>",
        "  <actuator>",
        f"    {actuator}",
        "  </actuator>",
        "</mujoco>",
        "",
    ]
    return Export("\n".join(lines).encode(), tuple(notes))


_SCALED = "armature and damping are the actuator's, which multiplies them by gear squared by itself"


def _joint(model: ExportedModel, v: dict[str, float], timestep: float, *, winding: bool) -> str:
    given = {"name": identifier(model.name), "type": "slide" if model.linear else "hinge", "axis": "0 0 1"}
    if not winding:
        given |= {"armature": number(v["J"] * model.gear**2), "damping": _damping(v, model.gear)}
    if "Tc" in v and _friction(model, winding) == "frictionloss":
        given |= {"frictionloss": number(v["Tc"] * model.gear), "solreffriction": f"{number(2 * timestep)} 1"}
        given["solimpfriction"] = f"{_HARD} {_HARD} 0.001"
    return "<joint " + " ".join(f'{key}="{text}"' for key, text in given.items()) + "/>"


def _friction(model: ExportedModel, winding: bool) -> str:
    """Which of MuJoCo's two forms it takes."""
    return "lugre" if winding and "stribeck_friction" in model.effects else "frictionloss"


def _timestep_s(v: dict[str, float], L: float | None) -> float:
    if L is None or "R" not in v:
        return _LONGEST_S
    return float(f"{min(max(L / v['R'] / _STEPS, _SHORTEST_S), _LONGEST_S):.3g}")


def _damping(v: dict[str, float], gear: float) -> str:
    """B and, with drag, c2: polynomial in the speed, at the joint."""
    parts = [v["B"] * gear**2, *([v["c2"] * gear**3] if "c2" in v else [])]
    return " ".join(number(part) for part in parts)


def _dcmotor(model: ExportedModel, v: dict[str, float], timestep: float, notes: list[str]) -> str:
    name = identifier(model.name)
    # MuJoCo multiplies all of them by gear squared, and the speed is the joint's: drag lacks one more.
    damping = " ".join([number(v["B"]), *([number(v["c2"] * model.gear)] if "c2" in v else [])])
    given = {
        "name": f"{name}_motor", "joint": name, "gear": number(model.gear),
        "motorconst": number(v["K"]), "resistance": number(v["R"]),
        "armature": number(v["J"]), "damping": damping,
    }  # fmt: skip
    if (L := model.get("L")) is not None:
        given["inductance"] = number(L)
    if "Tcog" in v:  # ours loads the shaft, MuJoCo's drives it
        given["cogging"] = f"{number(v['Tcog'])} {number(v['n_cog'])} {number(v['phi_cog'] + math.pi)}"
    if "R_th" in v:
        # Rise above the temperature at which R holds: both are called 0.
        given["thermal"] = f"{number(v['R_th'])} {number(v['C_th'])} 0 {ALPHA_COPPER_1_K} 0 0"
    if "ws" in v:
        stiffness = v["J"] * (_BRISTLE_SWING / timestep) ** 2
        given["lugre"] = " ".join(number(x) for x in (stiffness, 0.0, v["Tc"], v["Ts"], v["ws"]))
        notes.append(
            "stribeck_friction is MuJoCo's LuGre model: the stiffness of its bristles is chosen for this "
            "timestep, no measurement tells it"
        )
    if (limit := model.limits.get("voltage_V")) is not None:
        given["ctrlrange"] = f"{number(-limit)} {number(limit)}"
    if (current := model.limits.get("current_A")) is not None:
        given["saturation"] = f"0 {number(current)}"
    return "<dcmotor " + " ".join(f'{key}="{text}"' for key, text in given.items()) + "/>"


def _older(model: ExportedModel, v: dict[str, float]) -> list[str]:
    """Joint and actuator for a MuJoCo that has no dcmotor: the current follows the voltage at once."""
    name, n = identifier(model.name), model.gear
    friction = f' frictionloss="{number(v["Tc"] * n)}"' if "Tc" in v else ""
    gain, brake = number(v["K"] / v["R"]), number(-(v["K"] ** 2) / v["R"])
    return [
        "before MuJoCo 3.7 (without L, cogging, heat and Stribeck friction):",
        f'<joint name="{name}" armature="{number(v["J"] * n**2)}" damping="{number(v["B"] * n**2)}"{friction}/>',
        f'<general joint="{name}" gear="{number(n)}" gainprm="{gain}" biastype="affine" biasprm="0 0 {brake}"/>',
    ]


def _general(model: ExportedModel, v: dict[str, float]) -> str:
    name = identifier(model.name)
    gain = number(v.get("K", 1.0))
    return f'<general name="{name}_motor" joint="{name}" gear="{number(model.gear)}" gainprm="{gain}" biastype="none"/>'


TARGET = Target("mujoco", ".xml", write)
