"""What a set of signals can determine: which model runs, what it measures, which parameters are free.

With voltage, current and motion all five parameters of the linear motor are visible. Without the current only three
combinations of five are (the coefficients of ω/v), without the voltage only J/K and B/K; the rest is held at the
nominal value or, without one, not published at all.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from servo_daemon.plant.build import PlantModel, build_plant
from servo_daemon.plant.core import Drive
from servo_daemon.plant.parameters import LINEAR


@dataclass(frozen=True, slots=True)
class SignalPlan:
    """What will be estimated from these signals.

    Attributes:
        plant: the model driven by the best input there is; None if nothing can be run.
        measured: channels the filter corrects with.
        held: parameters kept at a given value.
        free: parameters that are estimated.
        nuisance: parameters estimated beside them and not published: small offsets that every drive has and that would
            bend the others at full confidence. Those of the user's model are among the free ones instead.
        reasons: why a parameter is not free, in words.
    """

    plant: PlantModel | None
    measured: tuple[str, ...]
    held: Mapping[str, float]
    free: tuple[str, ...]
    reasons: Mapping[str, str]
    nuisance: tuple[str, ...] = ()

    @property
    def known(self) -> Mapping[str, float]:
        """The motor's own parameters among the held ones: what stands for a missing signal."""
        own = {p.name for p in LINEAR}
        return {name: value for name, value in self.held.items() if name in own}


#: Offsets that are always in the filter's model: of the torque (a hanging cable, a tilted axis) and, where a voltage
#: lets it be told apart, of the current sensor (one of the voltage leaves the same trace).
_NUISANCE: Mapping[str, str] = {"constant_load_torque": "TL", "current_sensor_offset": "i0"}
#: Which effect a nuisance parameter stands for.
EFFECT_OF: Mapping[str, str] = {parameter: effect for effect, parameter in _NUISANCE.items()}
_HIDDEN_BY: dict[Drive, tuple[str, ...]] = {"voltage": (), "current": ("R", "L"), "torque": ("R", "L", "K")}
#: Heating is driven by R i², which nothing shows without a voltage; effects on the armature have no say then. Where the
#: torque is the input, none on the torque constant has.
_ARMATURE_ONLY = (
    "winding_heating",
    "resistance_step",
    "brush_voltage_drop",
    "current_sensor_offset",
    "current_sensor_gain",
    "voltage_sensor_offset",
)
_SILENT: dict[Drive, tuple[str, ...]] = {
    "voltage": (),
    "current": (*_ARMATURE_ONLY, "drive_lag"),
    "torque": (*_ARMATURE_ONLY, "torque_ripple", "magnetic_saturation"),
}
#: Without a current sensor the armature's share must be given: R and K close the two null directions of ω/v, and L/R is
#: far too short to show in the motion.
_NEEDED_WITHOUT_CURRENT = ("R", "L", "K")


def plan_signals(channels: tuple[str, ...], effects: tuple[str, ...], nominal: Mapping[str, float]) -> SignalPlan:
    """Choose input, measurements and free parameters.

    Args:
        channels: what the drive delivers (`samples.CHANNELS`).
        nominal: given values, natural units.
    """
    plan = _by_signals(channels, effects, nominal)
    if plan.plant is None:
        return plan
    given = {p.name: nominal.get(p.name, p.nominal) for p in plan.plant.parameters if p.held != "no"}
    given = {name: value for name, value in given.items() if name in plan.free}
    return replace(
        plan,
        held={**plan.held, **given},
        free=tuple(n for n in plan.free if n not in given),
        reasons={
            **plan.reasons,
            **dict.fromkeys(given, "held as given: a filter that runs along cannot search for it"),
        },
    )


def _by_signals(channels: tuple[str, ...], effects: tuple[str, ...], nominal: Mapping[str, float]) -> SignalPlan:
    motion = tuple(c for c in ("position_rad", "velocity_rad_s") if c in channels)[:1]
    if "voltage_V" in channels and (motion or "current_A" in channels):
        return _with_voltage(channels, motion, effects, nominal)
    if motion and "current_A" in channels:
        return _without_voltage("current", motion, effects, nominal)
    if motion and "torque_Nm" in channels:
        return _without_voltage("torque", motion, effects, nominal)
    have = ", ".join(channels) or "nothing"
    why = f"the drive delivers {have}: no pair of an input and a response"
    return SignalPlan(None, (), {}, (), {p.name: why for p in LINEAR})


def _with_voltage(
    channels: tuple[str, ...], motion: tuple[str, ...], effects: tuple[str, ...], nominal: Mapping[str, float]
) -> SignalPlan:
    if not motion:
        why = "no position or speed is measured: the motion is not visible"
        return SignalPlan(None, (), {}, (), {p.name: why for p in LINEAR})
    if "current_A" in channels:
        plant, nuisance = _with_offsets(effects, "voltage", tuple(_NUISANCE))
        return SignalPlan(plant, ("current_A", *motion), {}, _own(plant, nuisance), {}, nuisance)
    why = "no current is measured: of R, L, K, J, B only combinations are visible"
    missing = [name for name in _NEEDED_WITHOUT_CURRENT if name not in nominal]
    if missing:
        why += f"; give {', '.join(missing)} as nominal values to determine the others"
        return SignalPlan(None, (), {}, (), {p.name: why for p in LINEAR})
    held = {name: nominal[name] for name in _NEEDED_WITHOUT_CURRENT}
    plant, nuisance = _with_offsets(effects, "voltage", ("constant_load_torque",))
    free = tuple(n for n in _own(plant, nuisance) if n not in held)
    reasons = dict.fromkeys(held, f"held at the nominal value: {why}")
    return SignalPlan(plant, motion, held, free, reasons, nuisance)


def _with_offsets(
    effects: tuple[str, ...], drive: Drive, offsets: tuple[str, ...]
) -> tuple[PlantModel, tuple[str, ...]]:
    """The plant with the offsets that are not in it already, and their parameters."""
    # Levels of dry friction that differ by direction are a constant load beside equal ones: never both.
    there = (*effects, *(("constant_load_torque",) if "asymmetric_friction" in effects else ()))
    added = tuple(e for e in offsets if e not in there)
    return build_plant((*effects, *added), drive), tuple(_NUISANCE[e] for e in added)


def _own(plant: PlantModel, nuisance: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(n for n in plant.parameter_names if n not in nuisance)


def _without_voltage(
    drive: Drive, motion: tuple[str, ...], effects: tuple[str, ...], nominal: Mapping[str, float]
) -> SignalPlan:
    shown = tuple(e for e in effects if e not in _SILENT[drive])
    plant, nuisance = _with_offsets(shown, drive, ("constant_load_torque",))
    missing_signal = "voltage" if drive == "current" else "voltage and current"
    reasons = {name: f"no {missing_signal} measured: {name} not visible" for name in _HIDDEN_BY[drive]}
    if drive == "torque":
        return SignalPlan(plant, motion, {}, _own(plant, nuisance), reasons, nuisance)
    if "K" not in nominal:
        why = "no voltage is measured: only J/K and B/K are visible; give K as nominal value to determine J and B"
        return SignalPlan(None, (), {}, (), {p.name: why for p in LINEAR})
    reasons["K"] = "held at the nominal value: no voltage is measured, only J/K and B/K are visible"
    free = tuple(n for n in _own(plant, nuisance) if n != "K")
    return SignalPlan(plant, motion, {"K": nominal["K"]}, free, reasons, nuisance)
