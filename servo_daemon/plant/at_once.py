"""What is simulated at once: what is alike goes through one call, and calls through all cores."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TypeVar

_Item = TypeVar("_Item")
_Key = TypeVar("_Key")
_Result = TypeVar("_Result")


@cache
def cores() -> int:
    """That this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(cores(), "all-cores")


if hasattr(os, "register_at_fork"):  # a forked child has the pool, but none of its threads
    os.register_at_fork(after_in_child=_pool.cache_clear)


def on_all_cores(work: Callable[[_Item], _Result], items: Sequence[_Item]) -> list[_Result]:
    """The work on each item, on all cores that this process may use. It should be a compiled pass, which does not hold
    the interpreter, and must not call this itself: it would wait for its own place."""
    return [work(items[0])] if len(items) == 1 else list(_pool().map(work, items))


def alike(keys: Iterable[_Key]) -> dict[_Key, list[int]]:
    """Of each key the numbers of those that have it, in order."""
    out: dict[_Key, list[int]] = {}
    for number, key in enumerate(keys):
        out.setdefault(key, []).append(number)
    return out
