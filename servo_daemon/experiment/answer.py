"""What a plan is worth, in figures for people and programs: standard deviations, and how far models stay apart."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servo_daemon.experiment.plan import MotionPlan
from servo_daemon.experiment.questions import Precision, Separation
from servo_daemon.samples import F64


@dataclass(frozen=True, slots=True)
class ExpectedStd:
    """1 σ of a parameter in its unit, at its nominal value, after this plan and after the multisine."""

    name: str
    unit: str
    value: float
    std: float
    default_std: float
    wanted: bool


@dataclass(frozen=True, slots=True)
class ExpectedError:
    """How many times the noise a fit of `other` leaves where `truth` is true: 1 means that nothing shows.

    Attributes:
        truth, other: the models' effects.
        growth, default_growth: after this plan and after the multisine, geometric mean over what may be true.
        least, default_least: for the values for which it is least.
    """

    truth: tuple[str, ...]
    other: tuple[str, ...]
    growth: float
    least: float
    default_growth: float
    default_least: float


def expected_stds(plan: MotionPlan) -> list[ExpectedStd]:
    """Of every free parameter; empty where models are to be distinguished."""
    out = []
    for question, sums, default in zip(plan.questions, plan.sums, plan.default_sums, strict=True):
        if not isinstance(question, Precision):
            continue
        mine, theirs = question.std(sums), question.std(default)
        table, values = {p.name: p for p in question.model.plant.parameters}, question.model.draws[0]
        for name in question.model.free:
            unit = values[name] if table[name].transform == "log" else 1.0
            wanted = name in question.wanted
            out.append(
                ExpectedStd(name, table[name].unit, values[name], unit * mine[name], unit * theirs[name], wanted)
            )
    return out


def expected_errors(plan: MotionPlan) -> list[ExpectedError]:
    """Of every model fitted to every other; empty where parameters are wanted."""
    out = []
    each = zip(plan.questions, plan.default_questions, plan.sums, plan.default_sums, strict=True)
    for question, at_default, sums, default in each:
        if isinstance(question, Separation) and isinstance(at_default, Separation):
            mine, theirs = _growth(plan, question, sums), _growth(plan, at_default, default)
            truth, other = question.truth.effects, question.other.effects
            out.append(ExpectedError(truth, other, *mine, *theirs))
    return out


def _growth(plan: MotionPlan, question: Separation, sums: Sequence[F64]) -> tuple[float, float]:
    values = len(plan.reference) * len(question.noise.channels)
    squares = np.array([1.0 + question.now(S) / values for S in sums])
    return math.sqrt(float(np.exp(np.mean(np.log(squares))))), math.sqrt(float(squares.min()))
