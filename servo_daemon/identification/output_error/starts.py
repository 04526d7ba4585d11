"""Where the search begins: the nominal values if there are any, the regression, and guesses from the signals' sizes.

The cost has one minimum near the truth and long flat valleys far from it (a motor ten times too slow does not move in
the recording). Guesses from sizes are never far in that sense; they cost one simulation each to compare.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from servo_daemon.conditioning.layout import Stretches
from servo_daemon.identification.output_error.problem.problem import HELD_SHAFT, Problem
from servo_daemon.identification.output_error.problem.setup import (
    Recording,
    acceleration_size,
    current_size,
    size_of,
    speed_size,
)
from servo_daemon.identification.output_error.window_regression import window_starts
from servo_daemon.kalman.gaussian import to_coordinate
from servo_daemon.numerics import sample_period
from servo_daemon.parameters import LINEAR, MOTOR_NAMES, Parameter
from servo_daemon.plant.build import PlantModel
from servo_daemon.regression.motor_rls import MotorRls
from servo_daemon.regression.rls import SPANS_S
from servo_daemon.samples import SampleBlock

#: Mechanical and electrical time constants that are tried, s: from small coreless motors to geared axes.
_MECHANICAL_S, _ELECTRICAL_S = (0.005, 0.03, 0.2), (0.0003, 0.003)
#: Viscous friction as a share of the back-EMF's braking K²/R; an effect's torque as a share of the motor's.
_FRICTION_SHARE, _EFFECT_SHARE = 0.2, 0.05
#: Sources of starts of which only the best are searched from.
BY_WINDOWS, BY_SIZES = "regression over windows", "signal sizes"
#: Samples handed to the regression at once: its windows are short against them.
_TICK = 500


@dataclass(frozen=True, slots=True)
class Start:
    """A set of values in natural units and where it comes from."""

    source: str
    values: Mapping[str, float]


def starting_points(
    recordings: Sequence[Recording], problem: Problem, nominal: Mapping[str, float], *, windows: bool = True
) -> Iterator[Start]:
    """Starts, the nominal one first if it is complete, then the rest in no particular order; each made when it is asked
    for.

    Args:
        nominal: what the user gave, natural units.
        windows: with those by regression over windows.
    """
    blocks, turns = _turning(recordings, problem)
    for start in _starts(blocks, problem, nominal, windows=windows and turns):
        yield start if turns else replace(start, values={**start.values, **HELD_SHAFT})


def by_sizes(
    recordings: Sequence[Recording], problem: Problem, nominal: Mapping[str, float]
) -> Iterator[Mapping[str, float]]:
    """Guesses from the signals' sizes alone, natural values, one for each mechanical time constant."""
    guesses = _from_sizes(_liveliest(_turning(recordings, problem)[0]), problem.plant, nominal)
    yield from {values["J"]: values for values in guesses}.values()


def _turning(recordings: Sequence[Recording], problem: Problem) -> tuple[list[SampleBlock], bool]:
    """The recordings in which the shaft turns, else all; and whether it turns in any."""
    turning = [r.seen_block for k, r in enumerate(recordings) if k not in problem.blocked]
    return turning or [r.seen_block for r in recordings], bool(turning)


def _liveliest(blocks: Sequence[SampleBlock]) -> SampleBlock:
    """The recording with most speed for its voltage: in the others more of that holds a weight or overcomes friction,
    and K ≤ V/ω in all of them."""
    return max(blocks, key=lambda b: speed_size(b) / (1.0 if b.voltage_V is None else size_of(b.voltage_V) or 1.0))


def _starts(
    blocks: Sequence[SampleBlock], problem: Problem, nominal: Mapping[str, float], *, windows: bool
) -> Iterator[Start]:
    block = max(blocks, key=len)
    guesses = _from_sizes(_liveliest(blocks), problem.plant, nominal)

    def complete(some: Mapping[str, float], rest: Mapping[str, float] = guesses[0]) -> dict[str, float]:
        return {name: some.get(name, rest[name]) for name in problem.plant.parameter_names}

    needed = {*MOTOR_NAMES} & {*problem.free, *problem.local}
    if nominal and needed <= nominal.keys():
        yield Start("nominal values", complete(nominal))
    if regression := regression_values(block, problem.plant):
        yield Start("regression", complete(regression))
    if nominal and not needed <= nominal.keys():
        for guess in guesses:
            yield Start(f"nominal values, {BY_SIZES}", complete(nominal, guess))
    if windows and problem.plant.drive == "voltage" and problem.channels != ("current_A",):
        given = {n: v for n, v in nominal.items() if n in problem.given}
        for length, values in window_starts(block, _core(guesses[0])):
            yield Start(f"{BY_WINDOWS} of {length} samples", complete({**values, **given}))
    for guess in guesses:
        yield Start(BY_SIZES, guess)


def _core(values: Mapping[str, float]) -> dict[str, float]:
    return {p.name: values[p.name] for p in LINEAR}


def coordinates(start: Start, problem: Problem) -> dict[str, float]:
    """The start in the estimated coordinates, given parameters included."""
    table = {p.name: p for p in problem.plant.parameters}
    out = {n: to_coordinate(p, float(np.clip(start.values[n], p.lower, p.upper))) for n, p in table.items()}
    return out | dict(problem.given)


def _from_sizes(block: SampleBlock, plant: PlantModel, nominal: Mapping[str, float]) -> list[dict[str, float]]:
    speed = max(speed_size(block), 1e-9)
    core: list[dict[str, float]] = []
    if plant.drive == "voltage":
        assert block.voltage_V is not None
        voltage = max(size_of(block.voltage_V), 1e-9)
        moves = block.position_rad is not None or block.velocity_rad_s is not None
        K = 0.7 * voltage / speed if moves else 0.05
        R = 0.5 * voltage / max(current_size(block), 1e-9) if block.current_A is not None else 1.0
        if block.current_A is None and "Tg" in nominal:  # a known weight says how much torque a volt makes
            R = K * voltage / (2.0 * nominal["Tg"])
        for mechanical, electrical in product(_MECHANICAL_S, _ELECTRICAL_S):
            braking = K * K / R
            J = mechanical * braking * (1 + _FRICTION_SHARE)
            core.append({"R": R, "L": R * electrical, "K": K, "J": J, "B": _FRICTION_SHARE * braking})
    else:
        known = block.torque_Nm if plant.drive == "torque" else block.current_A
        assert known is not None
        torque = max(size_of(known), 1e-12)
        acceleration = max(acceleration_size(block), 1e-9)
        core = [{"K": 1.0, "J": (1 - s) * torque / acceleration, "B": s * torque / speed} for s in (0.1, 0.5)]
    return [_with_effects(values, block, plant) for values in core]


def torque_size(values: Mapping[str, float], block: SampleBlock, drive: str) -> float:
    """N·m: what the motor typically exerts."""
    if drive == "torque" and block.torque_Nm is not None:
        return size_of(block.torque_Nm)
    if block.current_A is None and block.voltage_V is not None:
        return values["K"] * size_of(block.voltage_V) / values["R"]
    return values["K"] * current_size(block)


def sizes(values: Mapping[str, float], block: SampleBlock, plant: PlantModel) -> dict[str, float]:
    """What a parameter's `Scale` multiplies, from signals and the motor's values."""
    voltage = size_of(block.voltage_V) if block.voltage_V is not None else 1.0
    travel = float(np.ptp(block.position_rad)) / 2 if block.position_rad is not None else 1.0
    seconds = float(block.time_s[-1] - block.time_s[0])
    measured = {
        "torque": torque_size(values, block, plant.drive),
        "voltage": voltage,
        "current": current_size(block),
        "speed": speed_size(block),
        "travel": travel,
        "seconds": seconds,
    }
    return {**{n: values[n] for n in ("R", "J", "B") if n in values}, **{n: v or 1.0 for n, v in measured.items()}}


def _with_effects(values: dict[str, float], block: SampleBlock, plant: PlantModel) -> dict[str, float]:
    size = sizes(values, block, plant)
    for p in plant.parameters:
        if p.name not in values:
            values[p.name] = effect_start(p, size)
    return values


def effect_start(p: Parameter, size: Mapping[str, float]) -> float:
    """Where a search begins of an effect's parameter, natural unit.

    Args:
        size: of `sizes`.
    """
    if p.scale is not None and p.scale.share:
        return float(np.clip(p.scale.share * p.scale.product(size), p.lower, p.upper))
    if p.unit == "N·m" and p.transform == "log":
        return _EFFECT_SHARE * size["torque"]
    return p.nominal


def regression_values(block: SampleBlock, plant: PlantModel) -> dict[str, float]:
    """What the daemon's own regression finds of R, L, K, J and B, where it can be used at all; empty otherwise."""
    if plant.drive != "voltage" or block.current_A is None:
        return {}
    if block.position_rad is None and block.velocity_rad_s is None:
        return {}
    rls, stretches = MotorRls(plant, {}, spans_s=(SPANS_S[-1],)), Stretches()
    period = sample_period(block.time_s)
    for begin in range(0, len(block), _TICK):
        part = block.slice(begin, begin + _TICK)
        last = float(block.time_s[begin - 1]) if begin else None
        rls.update(stretches.of(part, float(block.time_s[0]), last, period), {})
    found = rls.estimate()
    if found is None:
        return {}
    table = {p.name: p for p in plant.parameters}
    good = [k for k, n in enumerate(found.names) if n in table and table[n].lower < found.value[k] < table[n].upper]
    return {found.names[k]: float(found.value[k]) for k in good}
