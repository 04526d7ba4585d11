"""Which columns the two balances of a model have, and which parameters they give."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from servo_daemon.parameters import WINDING_NAMES
from servo_daemon.plant.build import PlantModel
from servo_daemon.regression.columns.derived_terms import ADDED_TO, DerivedTerms
from servo_daemon.regression.columns.terms import (
    armature_columns,
    armature_offsets,
    derived_of,
    given_by,
    shaft_columns,
    unseen_in,
)


@dataclass(frozen=True)
class ModelColumns:
    """The columns of one model in both balances.

    Attributes:
        armature, shaft: names of the columns.
        shaft_effects: effects whose columns are among them, in their order.
        derived: those of them that follow from an effect's terms.
        open: balances that do not close, and judge nothing.
        offsets: parameters that are a constant in the armature's balance.
        named: the armature's columns that give a parameter, and which.
    """

    armature: tuple[str, ...]
    shaft: tuple[str, ...]
    shaft_effects: tuple[str, ...]
    derived: tuple[DerivedTerms, ...]
    open: frozenset[str]
    offsets: tuple[str, ...]
    named: dict[str, str]

    @classmethod
    def of(cls, plant: PlantModel, biases: Sequence[str], *, sees_current: bool, sees_angle: bool) -> ModelColumns:
        """Columns of a plant's balances.

        Args:
            biases: parameters that nobody asks for: no offset of the armature is named that is one of them.
        """
        unseen = unseen_in(plant.effects, sees_current=sees_current, sees_angle=sees_angle)
        effects = tuple(e for e in plant.effects if e not in unseen)
        every, seen, offsets = derived_of(plant.effects), derived_of(effects), armature_offsets(plant.effects)
        armature = (*WINDING_NAMES, *armature_columns(effects))
        asked = len(offsets) == 1 and offsets[0] not in biases
        of_terms = [c for d in seen for c in d.columns["armature"]]
        named = {c: c for c in (*WINDING_NAMES, "Vb", *of_terms)} | ({"one": offsets[0]} if asked else {})
        return cls(
            armature=armature,
            shaft=("J", "B", *shaft_columns(effects)),
            shaft_effects=effects,
            derived=seen,
            open=frozenset[str]().union(*(d.open if d in seen else ADDED_TO for d in every)),
            offsets=offsets,
            named={c: named[c] for c in armature if c in named},
        )

    @cached_property
    def given(self) -> tuple[str, ...]:
        """Parameters that the shaft's columns give."""
        return tuple(map(given_by, self.shaft))

    @property
    def judged(self) -> frozenset[str]:
        """Parameters that no open balance gives."""
        columns = {"armature": self.named.values(), "shaft": self.given}
        out = {name for which in self.open for name in columns[which]}
        return frozenset((*self.named.values(), *self.given)) - out
