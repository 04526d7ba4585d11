"""Which experiment tells two causes apart that leave the same trace in a capture.

Each effect's file says what tells it from others (`Effect.told_from`); here is what holds for kinds of them. Hints
follow from the equations; none is computed from the capture.
"""

from __future__ import annotations

from collections.abc import Sequence

from servo_daemon.plant.effects import Effect, effects_by_name

_REVERSALS = "slow reversals through standstill, a few seconds each way"
#: Where the pair has no line of its own, and both are of one kind.
_OF_ONE_KIND = {
    "friction": f"{_REVERSALS}, and constant speeds over the whole range in both directions.",
    "angle": "turn slowly through several revolutions, at two speeds and two loads.",
    "event": "hold current and speed constant over the event: only a load changes the torque balance.",
}
_ANY = "a second capture with another motion (slow reversals, several constant speeds) and a second load."


def experiment(name: str, others: Sequence[str]) -> str:
    """What to record so that the effect and what these data could not tell from it come apart."""
    mine = _first_harmonic(name)
    for theirs in map(_first_harmonic, others):
        if mine is not None and theirs is not None:
            told = mine.told_from.get(theirs.name) or theirs.told_from.get(mine.name)
            if told is None and mine.kind == theirs.kind:
                told = _OF_ONE_KIND.get(mine.kind)
            if told is not None:
                return told
    return _ANY


def _first_harmonic(name: str) -> Effect | None:
    """`cogging_torque_2` is a cogging torque; None: it is no effect."""
    effect = effects_by_name().get(name)
    return effects_by_name()[effect.further] if effect is not None and effect.further else effect
