"""A plan from a task: blocks chosen from the family, put in order, checked by simulation, and told what it is worth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from servo_daemon.errors import BadInputError
from servo_daemon.experiment.drive import Rig
from servo_daemon.experiment.family import Shape, scaled
from servo_daemon.experiment.limits import Peaks
from servo_daemon.experiment.questions import Cuts, Question, Separation
from servo_daemon.experiment.search import choose
from servo_daemon.experiment.statistics import rows_of
from servo_daemon.samples import F64

#: The second model is fitted to the first, and the plan chosen anew, so many times; steps of each such fit.
_ROUNDS, _FIT_STEPS = 3, 12
#: A fit is over when the step that is left would lower the distance by less than this share.
_FITTED = 0.02
#: Peaks of a plan stay below this share of the limits, for every draw.
_MARGIN = 0.98
_TRIES = 40
#: So long after a block, as a share of it, the motion is still its doing.
_AFTERMATH = 0.1
#: Told how far it is, 0 .. 1, and what is being done.
Progress = Callable[[float, str], None]
#: A question as it is after a fit, and the statistics there.
_Answer = tuple[Question, tuple[F64, ...]]
#: Score, reference, members (None: the multisine), answers.
_Best = tuple[float, F64, "list[int] | None", list[_Answer]]


@dataclass(frozen=True, slots=True)
class Block:
    """A stretch of the plan: samples `begin` to `end`, and what it is."""

    begin: int
    end: int
    text: str


@dataclass(frozen=True)
class MotionPlan:
    """The result.

    Attributes:
        rig: what it is for.
        reference: shape (n,), held from each sample to the next.
        blocks: what it is made of.
        nominal, worst: what the nominal motor reaches, and the most over all motors that it may be.
        default: the multisine of equal length and limits that it is compared with, shape (n,).
        default_peaks: what the nominal motor reaches under that.
        questions: as answered by this plan; separations hold the second model fitted to it.
        sums, default_sums: for each question and draw the statistics of plan and multisine.
    """

    rig: Rig
    reference: F64
    blocks: tuple[Block, ...]
    nominal: Peaks
    worst: Peaks
    default: F64
    default_peaks: Peaks
    questions: tuple[Question, ...]
    default_questions: tuple[Question, ...]
    sums: tuple[tuple[F64, ...], ...]
    default_sums: tuple[tuple[F64, ...], ...]


def make_plan(
    rig: Rig,
    questions: Sequence[Question],
    family: Sequence[Shape],
    default: F64,
    blocks: int,
    free_run: int,
    progress: Progress,
) -> MotionPlan:
    """The best mixture of the family's members for these questions.

    Args:
        family: all of one length.
        default: the motion to compare with, any size, shape (n,): it gives the plan its length, too.
        blocks: how many members make a plan.
        free_run: about how many samples a fit simulates freely before it begins anew.

    Raises:
        BadInputError: the motor cannot be kept within the limits.
    """
    length = len(family[0].wave)
    members = [scaled(shape, rig.linear_share) for shape in family]
    default = _within_limits(rig, default / rig.linear_share(default), [(0, len(default))])
    cuts, member_cuts = _cuts(len(default), free_run), _cuts(length, free_run)
    progress(0.0, "what a multisine tells")
    at_default = [_fitted(q, rig, default, cuts) for q in questions]
    current = [q for q, _ in at_default]
    # The multisine itself is the plan to beat.
    best: _Best = (sum(q.score(s) for q, s in at_default), default, None, at_default)
    tables: list[list[list[F64]]] = [[[] for _ in members] for _ in questions]
    rounds = _ROUNDS if any(isinstance(q, Separation) for q in questions) else 1
    for k in range(rounds):
        progress((0.1 + k) / (rounds + 0.2), f"choosing among {len(members)} motions")
        _extend(tables, current, rig, members, member_cuts)
        chosen = choose(current, tables, blocks)
        reference = _arranged(rig, members, chosen, len(default))
        reference = _within_limits(rig, reference, [(j * length, (j + 1) * length) for j in range(blocks)])
        fitted = [_fitted(_last(q), rig, reference, cuts) for q in current]
        value = sum(q.score(s) for q, s in fitted)
        if value > best[0]:
            best = value, reference, chosen, fitted
        current = [_with_place(q, f) for q, (f, _) in zip(current, fitted, strict=True)]
    return _told(rig, best, default, at_default, family, length)


def _told(
    rig: Rig, best: _Best, default: F64, at_default: Sequence[_Answer], family: Sequence[Shape], length: int
) -> MotionPlan:
    """What was found, with all that is to be said of it."""
    _, reference, order, fitted = best
    texts = ["multisine over all of it"] if order is None else [family[m].text for m in order]
    size = len(default) if order is None else length
    return MotionPlan(
        rig=rig,
        reference=reference,
        blocks=tuple(Block(j * size, (j + 1) * size, text) for j, text in enumerate(texts)),
        nominal=rig.peaks(reference),
        worst=_worst(rig, reference),
        default=default,
        default_peaks=rig.peaks(default),
        questions=tuple(q for q, _ in fitted),
        default_questions=tuple(q for q, _ in at_default),
        sums=tuple(s for _, s in fitted),
        default_sums=tuple(s for _, s in at_default),
    )


def _cuts(n: int, length: int) -> list[tuple[int, int]]:
    """Free runs of about `length` samples, as a fit with segments has them."""
    edges = np.linspace(0, n, max(1, round(n / length)) + 1).astype(int).tolist()
    return list(pairwise(edges))


def _extend(
    tables: list[list[list[F64]]], questions: Sequence[Question], rig: Rig, members: Sequence[F64], cuts: Cuts
) -> None:
    """Statistics of every member from rest, for every draw; of separations at the places that are new."""
    for table, question in zip(tables, questions, strict=True):
        fresh = _last(question)
        for k, member in enumerate(members):
            sums = _sums(fresh, rig, member, cuts)
            known = table[k]
            table[k] = [np.concatenate([a, b]) for a, b in zip(known, sums, strict=True)] if known else list(sums)


def _last(question: Question) -> Question:
    return question.last() if isinstance(question, Separation) else question


def _with_place(question: Question, fitted: Question) -> Question:
    """The question, with the places of the fitted one beside its own."""
    if isinstance(question, Separation) and isinstance(fitted, Separation):
        return replace(question, places=(*question.places, *fitted.places))
    return question


def _sums(question: Question, rig: Rig, reference: F64, cuts: Cuts) -> tuple[F64, ...]:
    """Statistics of a motion for every draw."""
    truth = question.truth
    voltages = [rig.voltage(reference, truth, d) for d in range(len(truth.draws))]
    return tuple(question.statistics(rows_of(v, rig.rate_hz), cuts, d) for d, v in enumerate(voltages))


def _fitted(question: Question, rig: Rig, reference: F64, cuts: Cuts) -> tuple[Question, tuple[F64, ...]]:
    """The question with its second model fitted to this motion, and the statistics there."""
    sums = _sums(question, rig, reference, cuts)
    if not isinstance(question, Separation):
        return question, sums
    best, least = (question, sums), _left(question, sums)
    for _ in range(_FIT_STEPS):
        if all(question.distance(S) > (1 - _FITTED) * question.now(S) for S in sums):
            break
        question = question.stepped(sums)
        sums = _sums(question, rig, reference, cuts)
        if (left := _left(question, sums)) < least:
            best, least = (question, sums), left
    return best


def _left(question: Separation, sums: Sequence[F64]) -> float:
    """How far the second model is now, all draws together."""
    return float(np.sum([np.log1p(question.now(S)) for S in sums]))


def _arranged(rig: Rig, members: Sequence[F64], chosen: Sequence[int], n: int) -> F64:
    """Blocks one after another, each forward or backward as keeps the shaft near where it began; then at rest."""
    reference, length, at = np.zeros(n), len(members[0]), 0.0
    for k, m in enumerate(chosen):
        gone = rig.displacement(members[m])
        sign = -1.0 if abs(at - gone) < abs(at + gone) else 1.0
        at += sign * gone
        reference[k * length : (k + 1) * length] = sign * members[m] + 0.0  # never −0
    return reference


def _worst(rig: Rig, reference: F64) -> Peaks:
    each = [rig.peaks(reference, d) for d in range(len(rig.model.draws))]
    return Peaks(*(max(getattr(p, name) for p in each) for name in Peaks.__dataclass_fields__))


def _within_limits(rig: Rig, reference: F64, stretches: Sequence[tuple[int, int]]) -> F64:
    """Stretches that lead beyond a limit, for any draw, made smaller until none does; if that does not help, all.

    Raises:
        BadInputError: even a small motion does.
    """
    for k in range(_TRIES):
        share = rig.share_over_time(reference) / _MARGIN
        if share.max() <= 1.0:
            return reference
        reference = reference.copy()
        for a, b in stretches:
            after = b + round(_AFTERMATH * (b - a))  # what a block leaves moving is its doing
            most = float(share[a:after].max()) if k < _TRIES / 2 else float(share.max())
            reference[a:b] /= max(1.0, 1.01 * most)
    raise BadInputError(
        "no motion stays within [drive.limits]: the motor moves beyond them even when it is hardly driven (a load "
        "torque or a weight in the model?)"
    )
