"""What gets a fit although screening saw little of it."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

from servo_daemon.diagnosis.missing.missing import Missing
from servo_daemon.diagnosis.screening.screen import ScreenedCandidate
from servo_daemon.diagnosis.search.candidates import (
    Proposal,
    has_no_current,
    late_signals,
    open_at_zero,
    proposals,
    scaled_friction,
)
from servo_daemon.diagnosis.search.fitting import COLOURED
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.likelihood import Whole
from servo_daemon.diagnosis.trial.noise_floor import errs_beyond_noise
from servo_daemon.diagnosis.trial.trial import Trial

#: Screened so well, a cause must show in a fit: if none does, the free runs are too long for this motor.
PROMISING = 0.25


@dataclass(frozen=True, slots=True)
class Asked:
    """Of which model it is asked.

    Attributes:
        data, current: the model, as it is fitted to them.
        missing: of the model (`seen_missing`).
        first: no effect has been taken yet.
        noise_is_left: so say the data.
    """

    data: Data
    current: Trial
    missing: Missing
    first: bool
    noise_is_left: bool


def unscreened(
    asked: Asked, screened: Sequence[ScreenedCandidate], proposed: Sequence[Proposal], whole: Whole
) -> list[Proposal]:
    """If it is not noise that is left, everything: screening is linear in what may be far from it, and what it sees
    depends on what it took for noise. Without a current also what it saw nothing of: it begins at a motor that may be
    several times too large. What is late where free runs err beyond the noise, and, where no current is measured,
    whatever is left.

    Args:
        proposed: fitted already.
        whole: see `likelihood.needs_no_effect`.
    """
    current, rest, late = asked.current, tuple[Proposal, ...](), [*open_at_zero(asked.current)]
    hidden = has_no_current(current)
    left = promised_by(screened) > PROMISING or (current.independent < COLOURED and not asked.noise_is_left)
    matters = asked.first and current.problem.plant.drive == "voltage" and (left or not hidden)
    unknown = matters and _is_unknown(asked, whole)
    if hidden or unknown:
        late += late_signals(current)
    if left:
        rest = whatever(current, screened, asked.missing, worth=-math.inf if hidden and unknown else 0.0)
    others = [p for p in rest if p.name not in {q.name for q in late}]
    return [p for p in (*others, *late) if p.name not in {q.name for q in proposed}]


def whatever(
    current: Trial,
    screened: Sequence[ScreenedCandidate],
    missing: Missing,
    given: Collection[str] = (),
    worth: float = 0.0,
) -> tuple[Proposal, ...]:
    """All of which screening saw anything, however little, and what only scales a friction that is there.

    Args:
        given, worth: see `proposals`.
    """
    scaled = scaled_friction(current.effects, current.problem.channels, current.values, current.values)
    return tuple({p.name: p for p in (*scaled, *proposals(current, screened, missing, worth, given))}.values())


def promised_by(screened: Iterable[ScreenedCandidate]) -> float:
    """Share of what is missing that the best of them explains."""
    return max((s.heldout_share for s in screened), default=0.0)


def _is_unknown(asked: Asked, whole: Whole) -> bool:
    """Whether the model explains the data neither with noise that enters the motor nor in free runs."""
    fit = whole(asked.current, asked.current.values)
    explained = fit is not None and fit.white
    return not explained and errs_beyond_noise(asked.data, asked.current, asked.current, asked.missing)
