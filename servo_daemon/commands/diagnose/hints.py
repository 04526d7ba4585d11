"""Which experiment tells two causes apart that leave the same trace in a capture.

Each effect's file says what tells it from others (`Effect.told_from`); here is what holds for kinds of them. Hints
follow from the equations; none is computed from the capture.
"""

from __future__ import annotations

from collections.abc import Sequence

from servo_daemon.plant.effects import effects_by_name

_DRY = ("coulomb_friction", "asymmetric_friction", "stribeck_friction")
_ANGLE = ("gravity_load", "cogging_torque", "torque_ripple", "encoder_eccentricity")
_EVENT = ("load_torque_step", "resistance_step")

_REVERSALS = "slow reversals through standstill, a few seconds each way"
#: Where the pair has no line of its own: by what kind of thing the two are; the first that fits.
_KINDS: tuple[tuple[Sequence[str], Sequence[str], str], ...] = (
    (_DRY, _DRY, f"{_REVERSALS}, and constant speeds over the whole range in both directions."),
    (_ANGLE, _ANGLE, "turn slowly through several revolutions, at two speeds and two loads."),
    (_EVENT, _EVENT, "hold current and speed constant over the event: only a load changes the torque balance."),
)
_ANY = "a second capture with another motion (slow reversals, several constant speeds) and a second load."


def experiment(name: str, others: Sequence[str]) -> str:
    """What to record so that the effect and what these data could not tell from it come apart."""
    base = _first_harmonic(name)
    for other in map(_first_harmonic, others):
        own = _told(base, other) or _told(other, base)
        if own is not None:
            return own
        for mine, theirs, text in _KINDS:
            if (base in mine and other in theirs) or (base in theirs and other in mine):
                return text
    return _ANY


def _told(name: str, other: str) -> str | None:
    """What an effect's own file says tells it from another."""
    effect = effects_by_name().get(name)
    return None if effect is None else effect.told_from.get(other)


def _first_harmonic(name: str) -> str:
    """`cogging_torque_2` is a cogging torque."""
    effect = effects_by_name().get(name)
    return effect.further if effect is not None and effect.further else name
