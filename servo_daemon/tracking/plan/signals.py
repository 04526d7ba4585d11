"""What a set of signals can determine: which model runs, what it measures, which parameters are free.

With voltage, current and motion all five parameters of the linear motor are visible. Without the current only three
combinations of five are (the coefficients of ω/v), without the voltage only J/K and B/K; the rest is held at the
nominal value or, without one, not published at all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from servo_daemon.parameters import LINEAR, MOTOR_NAMES, WINDING_NAMES, Parameter
from servo_daemon.plant.build import PlantModel, build_plant
from servo_daemon.plant.contribution import contribution
from servo_daemon.plant.core import Drive
from servo_daemon.plant.effects import effects_by_name, event_times


@dataclass(frozen=True, slots=True)
class SignalPlan:
    """What will be estimated from these signals.

    Attributes:
        plant: the model driven by the best input there is; None if nothing can be run.
        measured: channels the filter corrects with.
        held: parameters kept at a given value.
        free: parameters that are estimated.
        unclaimed: why a free parameter is estimated and yet not to be believed.
        biases: parameters estimated beside them and not published: small offsets that every drive has and that would
            bias the others at full confidence. Those of the user's model are among the free ones instead.
        reasons: why a parameter is not free, in words.
    """

    plant: PlantModel | None
    measured: tuple[str, ...]
    held: Mapping[str, float]
    free: tuple[str, ...]
    reasons: Mapping[str, str]
    biases: tuple[str, ...] = ()
    unclaimed: Mapping[str, str] = field(default_factory=dict)

    @property
    def known(self) -> Mapping[str, float]:
        """The motor's own parameters among the held ones: what stands for a missing signal."""
        own = {*MOTOR_NAMES}
        return {name: value for name, value in self.held.items() if name in own}


#: Offsets that are always in the filter's model: of the torque (a hanging cable, a tilted axis) and, where a voltage
#: makes it identifiable, of the current sensor (one of the voltage leaves the same trace).
_LOAD, _SENSOR = "constant_load_torque", "current_sensor_offset"
_BIASES: Mapping[str, str] = {_LOAD: "TL", _SENSOR: "i0"}
#: A constant in a balance leaves the same trace as this offset: only one of them is estimated.
_SAME_AS: Mapping[str, str] = {"torque": _LOAD, "voltage": _SENSOR}
#: Which effect a bias state stands for.
EFFECT_OF: Mapping[str, str] = {parameter: effect for effect, parameter in _BIASES.items()}
_HIDDEN_BY: dict[Drive, tuple[str, ...]] = {"voltage": (), "current": ("R", "L"), "torque": WINDING_NAMES}
_NOT_SEARCHED = "held {}: a filter that runs along cannot search for it"
_AS_GIVEN, _AT_START = "as given", "at its start value, for none is given"
#: Without a current sensor the armature's share must be given: R and K close the two null directions of ω/v, and L/R is
#: far too short to show in the motion.
_NEEDED_WITHOUT_CURRENT = WINDING_NAMES


def is_held(p: Parameter) -> bool:
    """Whether a filter that runs along holds it at the value that is given."""
    hidden = [e.hides[p.name] for e in effects_by_name().values() if p.name in e.hides]
    return p.held != "no" or any(p.name not in concerned for concerned in hidden)


def plan_signals(channels: tuple[str, ...], effects: tuple[str, ...], nominal: Mapping[str, float]) -> SignalPlan:
    """Choose input, measurements and free parameters.

    Args:
        channels: what the drive delivers (`samples.CHANNELS`).
        nominal: given values, natural units.
    """
    plan = _by_signals(channels, effects, nominal)
    if plan.plant is None:
        return plan
    held = [p.name for p in plan.plant.parameters if is_held(p)]
    why = {name: _NOT_SEARCHED.format(_AS_GIVEN if name in nominal else _AT_START) for name in held}
    for size, instant in event_times().items():  # from a wrong one on it could not be told from what it changes
        if instant not in nominal:
            why[size] = f"held as given: give {instant} as nominal value, before which there is nothing of it"
    given = {p.name: nominal.get(p.name, p.nominal) for p in plan.plant.parameters if p.name in why}
    given = {name: value for name, value in given.items() if name in plan.free}
    free = tuple(n for n in plan.free if n not in given)
    return replace(
        plan,
        held={**plan.held, **given},
        free=free,
        reasons={**plan.reasons, **{name: why[name] for name in given}},
        unclaimed=_unclaimed(plan.plant.effects, free, nominal),
    )


def _unclaimed(effects: Sequence[str], free: Sequence[str], nominal: Mapping[str, float]) -> dict[str, str]:
    out: dict[str, str] = {}
    for effect in (effects_by_name()[name] for name in effects):
        for unseen, concerned in effect.hides.items():
            if unseen not in nominal:
                why = f"nothing shows it while {unseen} is not given: give it as nominal value (a diagnosis finds one)"
                out |= {n: why for n in free if n in concerned}
    for effect in (effects_by_name()[name] for name in effects):
        for own, concerned in effect.never_sure.items():
            why = f"a filter that runs along cannot tell how sure it is beside a {own}: `fit` and `diagnose` can"
            out |= {n: why for n in free if n in concerned}
    return out


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
        plant, biases = _with_offsets(effects, "voltage", tuple(_BIASES))
        return SignalPlan(plant, ("current_A", *motion), {}, _own(plant, biases), {}, biases)
    why = "no current is measured: of R, L, K, J, B only combinations are visible"
    missing = [name for name in _NEEDED_WITHOUT_CURRENT if name not in nominal]
    if missing:
        why += f"; give {', '.join(missing)} as nominal values to determine the others"
        return SignalPlan(None, (), {}, (), {p.name: why for p in LINEAR})
    held = {name: nominal[name] for name in _NEEDED_WITHOUT_CURRENT}
    plant, biases = _with_offsets(effects, "voltage", (_LOAD,))
    free = tuple(n for n in _own(plant, biases) if n not in held)
    reasons = dict.fromkeys(held, f"held at the nominal value: {why}")
    return SignalPlan(plant, motion, held, free, reasons, biases)


def _with_offsets(
    effects: tuple[str, ...], drive: Drive, offsets: tuple[str, ...]
) -> tuple[PlantModel, tuple[str, ...]]:
    """The plant with the offsets that are not in it already, and their parameters."""
    # Levels that differ by direction are equal ones and a constant load.
    together = (instead for e in effects for instead in effects_by_name()[e].simpler if len(instead) > 1)
    there = {*effects, *(e for instead in together for e in instead)}
    there |= {same for balance, same in _SAME_AS.items() if any(contribution(e).is_offset(balance) for e in effects)}
    added = tuple(e for e in offsets if e not in there)
    return build_plant((*effects, *added), drive), tuple(_BIASES[e] for e in added)


def _own(plant: PlantModel, biases: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(n for n in plant.parameter_names if n not in biases)


def _without_voltage(
    drive: Drive, motion: tuple[str, ...], effects: tuple[str, ...], nominal: Mapping[str, float]
) -> SignalPlan:
    shown = tuple(e for e in effects if contribution(e).shows(drive))
    plant, biases = _with_offsets(shown, drive, (_LOAD,))
    missing_signal = "voltage" if drive == "current" else "voltage and current"
    reasons = {name: f"no {missing_signal} measured: {name} not visible" for name in _HIDDEN_BY[drive]}
    if drive == "torque":
        return SignalPlan(plant, motion, {}, _own(plant, biases), reasons, biases)
    if "K" not in nominal:
        why = "no voltage is measured: only J/K and B/K are visible; give K as nominal value to determine J and B"
        return SignalPlan(None, (), {}, (), {p.name: why for p in LINEAR})
    reasons["K"] = "held at the nominal value: no voltage is measured, only J/K and B/K are visible"
    free = tuple(n for n in _own(plant, biases) if n != "K")
    return SignalPlan(plant, motion, {"K": nominal["K"]}, free, reasons, biases)
