"""What a search may cost: threads, processor time; and what an earlier one that did not finish has left."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path


class Journal:
    """Models that have been fitted to the end, as lines of JSON: a search that is begun again over the same data goes
    on from there.

    Args:
        path: of the file, which need not exist; None: nothing is kept.
        data: what it is about. Lines about anything else are not used.
    """

    def __init__(self, path: Path | None, data: str) -> None:
        self._path, self._data, self._lock = path, data, threading.Lock()
        self._known = dict(self._read())

    def _read(self) -> list[tuple[str, dict[str, float]]]:
        if self._path is None or not self._path.exists():
            return []
        found = []
        for line in self._path.read_text(encoding="utf-8", errors="replace").splitlines():
            try:
                row = json.loads(line)
                if row["data"] == self._data:
                    found.append((str(row["model"]), {str(n): float(v) for n, v in row["values"].items()}))
            except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
                continue  # cut off where it was stopped
        return found

    def values(self, model: str) -> dict[str, float] | None:
        """Where a model's fit has ended, natural units; None: it is not known."""
        return self._known.get(model)

    def keep(self, model: str, values: Mapping[str, float]) -> None:
        """A model has been fitted to the end: for the next search, this one is the same with a file and without. A file
        that cannot be written is passed over: it only saves time."""
        with self._lock:
            if self._path is None:
                return
            line = json.dumps({"data": self._data, "model": model, "values": dict(values)})
            try:
                with self._path.open("a", encoding="utf-8") as file:
                    file.write(line + "\n")
            except OSError:
                self._path = None


@dataclass(frozen=True, slots=True)
class Unfinished:
    """What was left untried when the budget was used up.

    Attributes:
        budget_s, cpu_s: processor time allowed and taken.
        not_tried: what has not been fitted, or not to the end.
    """

    budget_s: float
    cpu_s: float
    not_tried: tuple[str, ...]


class Effort:
    """What one search may cost and what became of it.

    Args:
        workers: threads that fit.
        budget_s: processor time of this process from now on after which no fit is begun; None: as long as it takes.
        journal: see there.

    Attributes:
        untried: models that there was no time for, in the order in which they came up.
    """

    def __init__(self, workers: int = 2, budget_s: float | None = None, journal: Journal | None = None) -> None:
        self.workers, self.budget_s = workers, budget_s
        self.journal = journal or Journal(None, "")
        self.untried: list[str] = []
        self._began_s = time.process_time()

    @property
    def spent_s(self) -> float:
        """Processor time since it was made, of all threads."""
        return time.process_time() - self._began_s

    @property
    def unfinished(self) -> Unfinished | None:
        """What there was no time for; None: there was for everything."""
        if self.budget_s is None or not self.untried:
            return None
        return Unfinished(self.budget_s, self.spent_s, tuple(self.untried))

    def allows(self, name: str) -> bool:
        """Whether a fit may be begun; if not it is noted."""
        if self.budget_s is None or self.spent_s < self.budget_s:
            return True
        if name not in self.untried:
            self.untried.append(name)
        return False


def model_key(present: Sequence[str], effects: Sequence[str], segment_s: float) -> str:
    """Key of a fit of a model beside the present one, over free runs of one length."""
    return f"{'+'.join(present)} > {'+'.join(effects)} @ {segment_s:g} s"
