"""Cheap screening: how much of the unmodelled torque and voltage each effect of the library could explain.

Every effect is a few columns (its formula over the smoothed signals, carried through the smoother), linear in their
coefficients; what is not linear is scanned. They are fitted to both series at once, in units of their standard
deviations, beside what the plant's free parameters would explain: a biased R, K or B is no effect. The score is the
share explained of time blocks that the coefficients have not seen. It ranks candidates and gives their start values; a
verdict it is not.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from servo_daemon.diagnosis.missing.missing import Fitted, Missing
from servo_daemon.diagnosis.missing.response import smoothed
from servo_daemon.diagnosis.missing.signals import motion_of
from servo_daemon.diagnosis.screening.derived import derived, usual_values
from servo_daemon.diagnosis.screening.regression import Regression, biased_names, of_parameters
from servo_daemon.parameters import MOTOR_NAMES
from servo_daemon.plant.build import PlantModel
from servo_daemon.plant.columns.screening import Basis, Context, Family, Motion, Trace
from servo_daemon.plant.contribution import contribution
from servo_daemon.plant.effects import effects_by_name

#: A parameter more must lower what is left by this share to come before (chosen; not tried).
_WORTH = 0.05
#: The motor's own parameters, and by what factors a missing effect may have biased them.
_MOTOR, _BIASED = MOTOR_NAMES, (0.2, 5.0)


@dataclass(frozen=True, slots=True)
class ScreenedCandidate:
    """An effect with what screening has found of it.

    Attributes:
        effect: its name.
        share: of the unmodelled torque and voltage that it explains beyond the plant's free parameters, 0 .. 1.
        start: start values of its parameters, SI units ("channel" of a delay: the channel's name).
        heldout_share: the same on blocks the coefficients have not seen; negative: worse than nothing.
        motor: R, L, K, J and B, as far as they are free, with this effect beside them.
        unseen: no column along a motion stands for it (a second inertia, a lag): only a fit can tell.
    """

    effect: str
    share: float
    start: Mapping[str, float | str]
    heldout_share: float
    motor: Mapping[str, float]
    unseen: bool = False


def families(plant: PlantModel, free: Collection[str]) -> dict[str, Family]:
    """The effects that this plant's input can show, by name, less those it has and those that free parameters hide."""
    known = {n: e.screening or derived(n) for n, e in effects_by_name().items() if not e.further and _shows(n, plant)}
    if {"J", "B"} <= set(free) and ({"R", "L"} <= set(free) or plant.drive != "voltage"):
        known.pop("current_sensor_gain", None)  # the same as all of these scaled
    return {name: family for name, family in known.items() if name not in plant.effects}


def _shows(name: str, plant: PlantModel) -> bool:
    """Whether what is measured shows it: what lags behind is one with the input, and a current that is the input has a
    sensor, too."""
    c = contribution(name)
    return c.shows(plant.drive) or c.terms.lag_s is not None or (plant.drive == "current" and c.touches("current_A"))


def has_no_formula(name: str) -> bool:
    """Whether an effect is screened by its terms alone."""
    effect = effects_by_name()[name]
    return effect.screening is None and not effect.further


def screen(fit: Fitted, missing: Missing) -> tuple[ScreenedCandidate, ...]:
    """All effects that could be, the most promising first.

    Args:
        fit: whose free parameters explain first.
        missing: of `missing_inputs`.
    """
    motion = motion_of(missing)
    names = biased_names(fit, missing)
    of_motor, stiff = of_parameters(motion, fit, missing)
    context = context_of(missing, motion, of_motor)
    tried = families(fit.problem.plant, (*fit.problem.free, *fit.problem.local))
    with np.errstate(all="ignore"):  # a speed or a current that is always 0; see `Regression.of`
        bases = [(name, basis) for name, family in tried.items() for basis in family(context)]
    keys = list(context.traces)
    equations = Regression.of(missing, motion, [*of_motor, *context.traces.values()], stiff)
    before = equations.errors(range(len(of_motor)))
    best: dict[str, tuple[float, ScreenedCandidate]] = {}
    for name, basis in bases:
        columns = [*range(len(of_motor)), *(len(of_motor) + keys.index(key) for key in basis.columns)]
        scored = _scored(name, basis, equations, columns, before, {n: motion.p.get(n) for n in names})
        if scored is not None and (name not in best or scored[0] < best[name][0]):
            best[name] = scored
    unseen = [contribution(name) for name in tried if has_no_formula(name) and not contribution(name).is_along_motion]
    return (
        *(candidate for _, candidate in sorted(best.values(), key=lambda pair: pair[0])),
        *(ScreenedCandidate(c.effect.name, 0.0, usual_values(c, motion), 0.0, {}, unseen=True) for c in unseen),
    )


def _scored(
    name: str,
    basis: Basis,
    equations: Regression,
    columns: Sequence[int],
    before: tuple[float, float],
    own: Mapping[str, float | None],
) -> tuple[float, ScreenedCandidate] | None:
    """Rank (low is good) and candidate; None where no physical parameters give these coefficients."""
    found = equations.coefficients(columns)
    start = basis.start(found[-len(basis.columns) :])
    if start is None:
        return None
    inside, heldout = equations.errors(columns)
    # The mean square of what is missing is that of its mean and its variance: where the series is no larger than its
    # standard deviation there is little to explain.
    share = (before[0] - inside) / (before[0] + equations.unknown)
    heldout_share = (before[1] - heldout) / (before[1] + equations.unknown)
    # The lesser of both: what the parameters alone leave held out may be large by chance, and then all shares are.
    rank = float(np.log(max(1 - min(share, heldout_share), 1e-12))) + _WORTH * basis.parameters
    plain = {name: value if isinstance(value, str) else float(value) for name, value in start.items()}
    motor = {
        own_name: value * float(np.clip(1 + change, *_BIASED))
        for (own_name, value), change in zip(own.items(), found.tolist(), strict=False)
        if value is not None and own_name in _MOTOR
    }
    return rank, ScreenedCandidate(name, float(share), plain, float(heldout_share), motor)


def context_of(missing: Missing, motion: Motion, of_motor: Sequence[Trace]) -> Context:
    """What the formulas need: raw series less what the free parameters explain, and the friction held at rest."""
    moving = ~motion.rest & missing.seen
    residual = {name: np.where(moving, series, 0.0) for name, series in missing.series.items()}
    columns = smoothed(missing, of_motor) if of_motor else {}
    stacked = [(columns[n] / np.median(missing.std[n])) * moving[:, None] for n in columns]
    if stacked:
        y = np.concatenate([residual[n] / np.median(missing.std[n]) for n in columns])
        beta, *_ = np.linalg.lstsq(np.vstack(stacked), y, rcond=1e-9)
        residual = {n: np.where(moving, missing.series[n] - columns[n] @ beta, 0.0) for n in columns}
    held = motion.direction
    if "torque" in residual and moving.any():
        level = float(residual["torque"] @ motion.direction) / int(moving.sum())
        at_rest = np.clip(missing.series["torque"] / level, -1, 1) if level > 0 else np.zeros(len(held))
        held = np.where(motion.rest, at_rest, motion.direction)
    return Context(motion, residual, held, missing.augmented.channels)
