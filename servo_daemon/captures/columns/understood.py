"""What was understood of a file's signals, and what was not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from servo_daemon.captures.capture.layout import KNOWN_COLUMNS, MOTION, lacks
from servo_daemon.captures.columns.questions import Question
from servo_daemon.captures.columns.signal_map import COUNTS, MappedColumn
from servo_daemon.column_names import meaning, not_measured


@dataclass(slots=True)
class Understood:
    """What names and values of a file say.

    Attributes:
        columns: of the capture, from the file's signals.
        counts_per_rev: of `position_counts`.
        told: "t_ms → time_s", a part of the line that the user sees.
        metadata: that the kind of file brings.
        questions: signal -> what has to be known of it.
    """

    columns: dict[str, MappedColumn] = field(default_factory=dict)
    counts_per_rev: float | None = None
    told: list[str] = field(default_factory=list)
    metadata: dict[str, str] = field(default_factory=dict)
    questions: dict[str, Question] = field(default_factory=dict)

    def ask(self, signal: str, column: str, text: str, units: tuple[str, ...] = ()) -> None:
        """Ask about a signal: see `Question`."""
        self.questions[signal] = Question(column, text, units)

    @property
    def fields(self) -> set[str]:
        """Fields of `Capture` that the columns fill."""
        return {field_of(name) for name in self.columns}


def field_of(column: str) -> str:
    """The field of `Capture` that a column of a signal map fills."""
    return "position_rad" if column == COUNTS else KNOWN_COLUMNS.get(column, column)


def only_ours(names: Sequence[str]) -> bool:
    """Whether the signals named like a capture's columns make one: then no other name has to be understood."""
    known = {KNOWN_COLUMNS[name] for name in names if name in KNOWN_COLUMNS}
    foreign = {name: meaning(name) for name in names if name not in KNOWN_COLUMNS}
    others = {field_of(m.column) for m in foreign.values() if m is not None}
    moves = bool(MOTION & known)
    unknown = not moves and any(m is None and name and not not_measured(name) for name, m in foreign.items())
    return not lacks(known) and others <= {*known, "supply"} and not unknown
