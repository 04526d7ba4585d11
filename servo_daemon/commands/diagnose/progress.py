"""How far a diagnosis is: a bar for those who watch, lines of JSON for programs; on stderr."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from tqdm import tqdm

from servo_daemon.diagnosis.diagnose import Progress


@contextmanager
def progress_told(*, as_json: bool) -> Iterator[Progress]:
    """What `diagnose` is to be told by: shares from 0 to 1, never falling, each with the step that begins."""
    reached = 0.0

    def line(share: float, step: str) -> None:
        nonlocal reached
        reached = max(reached, min(share, 1.0))
        print(
            json.dumps({"progress": round(reached, 3), "step": step}, ensure_ascii=False), file=sys.stderr, flush=True
        )

    if as_json:
        yield line
        line(1.0, "done")
        return
    form = "{percentage:3.0f} %|{bar}| {elapsed}  {desc}"
    with tqdm(total=1.0, disable=None, file=sys.stderr, leave=False, bar_format=form) as bar:

        def drawn(share: float, step: str) -> None:
            nonlocal reached
            bar.set_description_str(step, refresh=False)
            bar.update(max(share - reached, 0.0))
            reached = max(reached, share)
            bar.refresh()

        yield drawn
