"""One order for captures that are used together, however they were handed over."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

from servo_daemon.captures.capture.model import Capture


def in_canonical_order(captures: Sequence[Capture]) -> tuple[Capture, ...]:
    """Sorted by their samples, not by their names: sums are rounded, runs divided and ties broken alike in any order of
    the files, and of copies of them."""
    return tuple(sorted(captures, key=_digest))


def without_copies(captures: Sequence[Capture]) -> tuple[tuple[Capture, ...], list[str]]:
    """The captures, each measurement once, and what is said of those left out: twice the same noise is no more data,
    and who is judged by a recording that took no part must not meet its copy."""
    first: dict[str, Capture] = {}
    kept = [(capture, first.setdefault(_digest(capture), capture)) for capture in captures]
    notes = [f"{c.path}: the same samples as {own.path}: used once" for c, own in kept if c is not own]
    return tuple(first.values()), notes


def _digest(capture: Capture) -> str:
    """Of the samples: equal for equal measurements."""
    digest = hashlib.sha256((capture.time_s - capture.time_s[0]).tobytes())
    for name in capture.channels:
        digest.update(name.encode())
        digest.update(getattr(capture, name).tobytes())
    return digest.hexdigest()
