"""Many cases on several processes, each a line of JSON in a file: what is there is not run again."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path
from typing import Any, Protocol, TypeVar

from tqdm import tqdm


class Keyed(Protocol):
    """A frozen dataclass of plain values."""

    @property
    def key(self) -> str:
        """The same for the same case, and for no other."""
        ...


_C = TypeVar("_C", bound=Keyed)


def rows_of(path: Path) -> list[dict[str, Any]]:
    """All that is in the file; none where there is no file."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []


def run(path: Path, wanted: Sequence[_C], work: Callable[[_C], Any], workers: int) -> list[dict[str, Any]]:
    """The results of all cases as they are in the file, in the order of the cases.

    Args:
        work: gives a dataclass that has the case in its field `case`.
    """
    if not wanted:
        return []
    done = {type(wanted[0])(**row["case"]).key: row for row in rows_of(path)}
    left = [c for c in wanted if c.key not in done]
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file, ProcessPoolExecutor(workers) as pool:
        futures = {pool.submit(work, c): c for c in left}
        for future in tqdm(as_completed(futures), total=len(wanted), initial=len(wanted) - len(left), unit="case"):
            row = json.dumps(asdict(future.result()), ensure_ascii=False)
            print(row, file=file, flush=True)
            done[futures[future].key] = json.loads(row)
    return [done[c.key] for c in wanted]
