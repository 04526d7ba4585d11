"""From screened effects to models that are worth a fit."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from servo_daemon.diagnosis.missing.missing import Missing
from servo_daemon.diagnosis.screening.screen import ScreenedCandidate
from servo_daemon.diagnosis.trial.trial import Trial, model_exists
from servo_daemon.identification.output_error.problem.rollout import INPUT
from servo_daemon.kalman.gaussian import natural_values
from servo_daemon.plant.contribution import contribution
from servo_daemon.plant.effects import effects_by_name, further_harmonics
from servo_daemon.plant.effects.base import LATE_STEPS

#: Of the screened candidates so many are fitted in each round, if they explain this share of what the best does
#: (chosen; not tried).
MOST_FITTED, WORTH_A_FIT, WORTH_A_PAIR = 6, 0.2, 0.1
#: A motor is started from both ends where screening moves one of its parameters by more, in logarithms (chosen; not
#: tried).
_FAR = 0.5
#: Of the winding's time constant so much is left to it where a late sensor is supposed to be the rest (chosen; not
#: tried).
_LEFT_TO_L = 0.2
#: Samples amid commands of zero, as a share of all, from which on an open bridge there is asked about (chosen; not
#: tried).
_LEAST_ZERO = 0.02
#: Each of them takes nearly the same from the voltage: by the way it turns, by the way the current flows.
_BY_DIRECTION = ("coulomb_friction", "brush_voltage_drop")
#: Friction that pushes and brakes as another R and J do.
_BY_LOAD = "load_dependent_friction"
#: What a train of gears loses of the torque, and a single stage: a valley leads from one to the other, slowly
#: (decision 65).
_MU = (0.2, 0.03)
#: Of the proposals so many are tried in pairs.
_IN_PAIRS = 4
#: simpler → what contains it: the richer one fits as well as the simpler one by being it.
CONTAINED: Mapping[str, tuple[str, ...]] = {
    small: tuple(n for n, e in effects_by_name().items() if (small,) in e.simpler) for small in effects_by_name()
}
#: The same, where not both can be in one model.
NESTED: Mapping[str, tuple[str, ...]] = {
    small: tuple(n for n in rich if not model_exists((small, n))) for small, rich in CONTAINED.items()
}


@dataclass(frozen=True, slots=True)
class Proposal:
    """A model to try.

    Attributes:
        name: of the effect that it adds, or of two.
        effects: of the model.
        start: natural units, every parameter.
        other: the same with the motor as it was without the effect, which may be nearer to the truth than what a
            regression makes of the whole.
        far: whether screening puts the motor far from there, so that both must be tried.
        unseen: it is tried although screening saw little of it.
    """

    name: str
    effects: tuple[str, ...]
    start: Mapping[str, float]
    other: Mapping[str, float]
    far: bool
    unseen: bool = False


def proposals(
    current: Trial,
    screened: Sequence[ScreenedCandidate],
    missing: Missing,
    worth: float = WORTH_A_FIT,
    given: Collection[str] = (),
) -> tuple[Proposal, ...]:
    """The models of one round, the most promising first. Where no current is measured dry friction, a drop at the
    brushes and friction that grows with the load are among them: the linear motor biases R and K around the first two
    until they look like a spring in the shaft, and with another R and J it pushes and brakes as the third does, of
    which screening then sees nothing.

    Args:
        worth: share of what the best explains that a cause must explain, beside something; −∞: all are fitted.
        given: parameters that the user holds. Who gives the weight of an arm has one: that cause is fitted, whatever
            screening sees of it beside a biased motor.
    """
    known, hidden = effects_by_name(), has_no_current(current)
    values = natural_values(missing.augmented.plant.parameters, missing.coordinates)
    best = max((s.heldout_share for s in screened), default=0.0)
    out: list[Proposal] = []
    for s in screened:
        name = _free_name(s.effect, current.effects)
        effects = extended(current.effects, name)
        if name not in known or effects is None:
            continue
        certain = s.unseen or any(p.name in given for p in known[name].parameters)
        certain |= worth == -math.inf or (hidden and s.effect in _BY_DIRECTION)
        if s.heldout_share <= 0 and not certain:
            continue
        simpler = any(s.effect == small and p.name in large for small, large in NESTED.items() for p in out)
        if (s.heldout_share < worth * best or len(out) >= MOST_FITTED) and not (simpler or certain):
            continue
        start = _start(s, name, effects, {n: values.get(n, v) for n, v in current.values.items()})
        far = any(_far(v, current.values[n]) for n, v in s.motor.items() if n in current.values)
        other = {**start, **current.values, **({"Tc": start["Tc"]} if "Tc" in s.start and "Tc" in start else {})}
        out.append(Proposal(name, effects, start, other, far))
    if hidden and _BY_LOAD not in {p.name for p in out}:
        out += _rubs_by_load(current)
    return tuple(out)


def _rubs_by_load(current: Trial) -> Iterator[Proposal]:
    """Friction that grows with the load, beginning at usual sizes."""
    effects = extended(current.effects, _BY_LOAD)
    if effects is not None:
        start, other = ({**current.values, "mu": mu} for mu in _MU)
        yield Proposal(_BY_LOAD, effects, start, other, far=True, unseen=True)


def _start(s: ScreenedCandidate, name: str, effects: Sequence[str], present: Mapping[str, float]) -> dict[str, float]:
    """Natural values of every parameter where a model with this candidate begins: the present ones, the motor and the
    effect as screening has them."""
    known = effects_by_name()
    start = {n: s.motor.get(n, v) for n, v in present.items()}
    start |= {p.name: p.nominal for e in effects for p in known[e].parameters if p.name not in start}
    ending = name.removeprefix(s.effect)
    for key, value in s.start.items():
        choice = next((p for p in known[name].parameters if p.name == key + ending), None)
        if choice is not None:
            start[choice.name] = float(choice.choices.index(value)) if isinstance(value, str) else float(value)
    if "Tc" in s.start and "Tc" in start:
        start["Tc"] = float(s.start["Tc"])
    return start


def pairs(proposed: Sequence[Proposal], channels: Collection[str]) -> tuple[Proposal, ...]:
    """Two of the most promising at once: what hides each other (dry friction seen through an eccentric encoder) helps
    neither alone. And a dry friction with what only scales it, which is no model by itself."""
    out = []
    for k, first in enumerate(proposed[:_IN_PAIRS]):
        for second in proposed[k + 1 : _IN_PAIRS]:
            effects = (*first.effects, *(e for e in second.effects if e not in first.effects))
            if len(effects) == len(first.effects) + 1 and model_exists(effects):
                start, other = {**second.start, **first.start}, {**second.start, **first.other}
                far = first.far or second.far
                out.append(Proposal(f"{first.name} + {second.name}", effects, start, other, far))
    friction = next((p for p in proposed if p.name == "coulomb_friction"), None)
    if friction is not None:
        scaled = scaled_friction(friction.effects, channels, friction.start, friction.other)
        out += [replace(p, name=f"{friction.name} + {p.name}", far=friction.far) for p in scaled]
    return tuple(out)


def scaled_friction(
    present: tuple[str, ...], channels: Collection[str], start: Mapping[str, float], other: Mapping[str, float]
) -> Iterator[Proposal]:
    """A model's dry friction with each effect that makes it more or less of itself, beginning at nothing: free runs
    that stick where the shaft slides show screening little of it. Where along the travel a run begins must be measured.
    """
    for effect in effects_by_name().values():
        effects = (*present, effect.name)
        added = contribution(effect.name)
        if added.follows(added.signals.theta) and "position_rad" not in channels:
            continue
        if effect.scales_friction and effect.name not in present and model_exists(effects):
            nothing = {p.name: p.nominal for p in effect.parameters}
            yield Proposal(effect.name, effects, {**nothing, **start}, {**nothing, **other}, far=False)


def has_no_current(trial: Trial) -> bool:
    """Whether the voltage drives it and no current is measured: nothing then tells the winding from the shaft."""
    return trial.problem.plant.drive == "voltage" and "current_A" not in trial.problem.channels


def late_signals(current: Trial) -> Iterator[Proposal]:
    """Each late sensor and a lag of the drive.

    What is late makes an error of a sample or two wherever the motion changes, which passes for noise of the sensor:
    screening sees none of it. Without a current nothing else tells a dead time from the winding's time constant, which
    is in the model before it: they begin where the fitted L/R would be theirs; else at a sample.
    """
    channels, hidden = current.problem.channels, has_no_current(current)
    known, values, period_s = effects_by_name(), current.values, current.problem.sample_period_s
    taken_s = max(values["L"] / values["R"], period_s / 2) if hidden else period_s
    seen_s = min(taken_s, (LATE_STEPS - 1) * period_s)
    choices = known["measurement_delay"].parameters[1].choices
    late = [{"t_d": seen_s, "channel": float(choices.index(c))} for c in channels]
    for name, more in (*(("measurement_delay", m) for m in late), ("drive_lag", {"t_lag": taken_s})):
        effects = None if name in current.effects else extended(current.effects, name)
        if effects is None:
            continue
        left_s = max(taken_s - next(iter(more.values())), _LEFT_TO_L * taken_s)
        winding = {"L": left_s * values["R"]} if hidden and "L" in current.problem.free else {}
        yield Proposal(name, effects, {**values, **more, **winding}, {**values, **more}, far=hidden)


def open_at_zero(current: Trial) -> Iterator[Proposal]:
    """A bridge that is open where the command is exactly zero, if the capture has stretches of that.

    Screening sees nothing of it: what is missing is a voltage as large as the back-EMF, in these stretches alone.
    """
    effects = extended(current.effects, "freewheel_drive")
    if current.problem.plant.drive != "voltage" or effects is None:
        return
    zero = np.concatenate([s.rows[:, INPUT] == 0.0 for s in current.problem.segments])
    stretches = np.count_nonzero(zero[2:] & zero[1:-1] & zero[:-2])  # not a voltage that only passes through zero
    if _LEAST_ZERO * len(zero) < stretches < len(zero):
        values = dict(current.values)
        yield Proposal("freewheel_drive", effects, values, values, far=True)


def _far(value: float, before: float) -> bool:
    return before > 0 and value > 0 and abs(math.log(value / before)) > _FAR


def _free_name(effect: str, present: Sequence[str]) -> str:
    """The effect's first harmonic that the model does not have."""
    return next((n for n in (effect, *further_harmonics(effect)) if n not in present), effect)


def extended(present: tuple[str, ...], name: str) -> tuple[str, ...] | None:
    """The model with one effect more; what it contains is replaced. None: there is no such model."""
    kept = tuple(e for e in present if name not in NESTED.get(e, ()))
    if name in kept:
        return None
    effects = (*kept, name)
    return effects if model_exists(effects) else None
