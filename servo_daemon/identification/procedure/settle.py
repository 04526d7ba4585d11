"""What changes from day to day, as far as the first part of a capture bears it out.

Candidates from the simplest on: nothing; the offsets; one scale of all dry friction; one scale of all friction; each of
them with the offsets; every friction and offset its own. Each is fitted to one half of the part and predicts the other.
The simplest that predicts best is then fitted to the whole part.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from servo_daemon.identification.output_error.problem.inputs import input_rows
from servo_daemon.identification.output_error.problem.rollout import simulate_many
from servo_daemon.identification.output_error.problem.score import SHORT_S, Errors, errors, measured_start
from servo_daemon.identification.output_error.problem.setup import OFFSETS
from servo_daemon.kalman.gaussian import natural_values
from servo_daemon.plant.build import PlantModel
from servo_daemon.samples import F64, SampleBlock

#: Friction that is there at any speed, and what grows with it.
DRY = ("Tc", "Tc_neg", "Ts", "mu")
VISCOUS = ("B", "B_neg", "c2")
#: A richer candidate lowers the error (rms, geometric mean) of both halves, and of both together by this share: between
#: the halves of one capture of the EMPS axis friction of the same day varies by so much from motion to motion.
_WORTH = 0.2
#: Gauss–Newton: rounds, the least gain of one that is gone on from, and how far a logarithm may go.
_ROUNDS, _ENOUGH, _FARTHEST = 12, 1e-4, 4.0
#: Damping begins at this share of the normal matrix's diagonal.
_DAMPING = 1e-3


@dataclass(frozen=True, slots=True)
class Candidate:
    """What may settle: coordinates q + by @ z of the plant's parameters.

    Attributes:
        words: for the user.
        by: shape (np, k).
    """

    words: str
    by: F64


def candidates(plant: PlantModel) -> list[Candidate]:
    """From the simplest on; those that mean nothing in this model are left out."""
    names = plant.parameter_names
    unit = np.eye(len(names))
    offsets = [unit[:, [names.index(n)]] for n in OFFSETS if n in names]
    dry = [names.index(n) for n in DRY if n in names]
    friction = [*dry, *(names.index(n) for n in VISCOUS if n in names)]
    groups: list[tuple[str, list[F64]]] = [("nothing", []), ("offsets", offsets)]
    for words, which in (("one scale of dry friction", dry), ("one scale of all friction", friction)):
        if which and (which != friction or words.endswith("all friction")):
            groups += [(words, [unit[:, which].sum(axis=1, keepdims=True)])]
    groups += [(f"{words} and offsets", [*columns, *offsets]) for words, columns in groups[2:] if offsets]
    groups += [("each friction and offset of its own", [*(unit[:, [k]] for k in friction), *offsets])]
    out, sizes = [], set[bytes]()
    for words, columns in groups:
        by = np.hstack(columns) if columns else np.zeros((len(names), 0))
        if (columns or words == "nothing") and by.tobytes() not in sizes:
            sizes.add(by.tobytes())
            out.append(Candidate(words, by))
    return sorted(out, key=lambda c: c.by.shape[1])


def settled_coordinates(part: SampleBlock, plant: PlantModel, q: F64, most: int) -> tuple[Candidate, F64]:
    """What settles on these samples, and the coordinates then.

    Args:
        q: shape (np,), as fitted to other samples.
        most: unknowns that a candidate may have.
    """
    chosen: _Tried | None = None
    for candidate in candidates(plant):
        if candidate.by.shape[1] > most:
            break
        tried = _tried(part, plant, q, candidate)
        if chosen is None or tried.is_better_than(chosen):
            chosen = tried
    assert chosen is not None
    return chosen.candidate, chosen.q


@dataclass(frozen=True, slots=True)
class _Tried:
    """A candidate fitted to a whole part, at q.

    Attributes:
        predicted: shape (2,): logarithm of what each half is off by with what settled on the other.
        explained: the same of the whole part with what settled on it.
    """

    candidate: Candidate
    q: F64
    predicted: F64
    explained: float

    def is_better_than(self, simpler: _Tried) -> bool:
        """Equally many unknowns: by the whole; more: if both halves are predicted better, and clearly."""
        if self.candidate.by.shape[1] == simpler.candidate.by.shape[1]:
            return self.explained < simpler.explained
        clearly = float(np.mean(self.predicted)) < float(np.mean(simpler.predicted)) + np.log(1.0 - _WORTH)
        return clearly and bool(np.all(self.predicted < simpler.predicted))


def _tried(part: SampleBlock, plant: PlantModel, q: F64, candidate: Candidate) -> _Tried:
    halves = [part.slice(0, len(part) // 2), part.slice(len(part) // 2, len(part))]
    there = [_fitted(half, plant, q, candidate.by) for half in halves]
    predicted = np.array([_size(errors(halves[1 - k], plant, there[k])) for k in range(2)])
    whole = _fitted(part, plant, q, candidate.by)
    return _Tried(candidate, whole, predicted, _size(errors(part, plant, whole)))


def moved(plant: PlantModel, candidate: Candidate, q: F64) -> Mapping[str, float]:
    """Natural values of the parameters that settle."""
    values = natural_values(plant.parameters, q)
    return {name: values[name] for name, row in zip(plant.parameter_names, candidate.by, strict=True) if row.any()}


def _size(found: Errors) -> float:
    """Mean logarithm of the rms, of channels, of one free run and of those of 1 s. An angle adds up what a speed is off
    by: where there is a speed it is left out."""
    use = [k for k, c in enumerate(found.channels) if c != "position_rad"] or [0]
    square = np.array([np.mean(np.square(e[:, use]), axis=0) for e in (found.long, found.short)])
    return float(np.mean(np.log(np.clip(np.nan_to_num(square, nan=1e300, posinf=1e300), 1e-300, 1e300)))) / 2


def _fitted(block: SampleBlock, plant: PlantModel, q: F64, by: F64) -> F64:
    """Least squares over free runs of 1 s, begun at what was measured; shape (np,)."""
    if not by.shape[1]:
        return q
    now = np.zeros(by.shape[1])
    residual, slope, scale = _linearised(block, plant, q, by, None)
    value, damping = float(residual @ residual), _DAMPING
    for _ in range(_ROUNDS):
        normal = slope.T @ slope
        step = np.linalg.lstsq(normal + damping * np.diag(np.diag(normal)), -slope.T @ residual, rcond=None)[0]
        then = np.clip(now + step, -_FARTHEST, _FARTHEST)
        r, s, _ = _linearised(block, plant, q + by @ then, by, scale)
        new = float(r @ r)
        if not new < value:
            damping *= 10.0
            continue
        gained, (now, residual, slope, value, damping) = value - new, (then, r, s, new, damping / 10.0)
        if gained < _ENOUGH * value:
            break
    return np.asarray(q + by @ now)


def _linearised(block: SampleBlock, plant: PlantModel, q: F64, by: F64, scale: F64 | None) -> tuple[F64, F64, F64]:
    """Residuals of all channels in units of their size at the beginning, their slopes by z, and that size."""
    channels, measured, states = measured_start(block, plant, q)
    rows = input_rows(block, plant.drive)
    count = max(1, round(float(block.time_s[-1] - block.time_s[0]) / SHORT_S))
    length = len(block) // count
    begins = np.arange(count) * length
    pieces = np.stack([rows[b : b + length] for b in begins])
    out = simulate_many(plant, channels, q, states[begins], np.ascontiguousarray(pieces))
    error = out.shown - np.stack([measured[b : b + length] for b in begins])
    size = np.maximum(np.sqrt(np.mean(np.square(error), axis=(0, 1))), 1e-300) if scale is None else scale
    slopes = (out.by_parameter @ by) / size[:, None]
    return (error / size).ravel(), slopes.reshape(-1, by.shape[1]), size
