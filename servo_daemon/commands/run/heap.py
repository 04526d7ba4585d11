"""The C library's heap in a process that runs for years with many threads."""

from __future__ import annotations

import ctypes
from typing import Final

#: Of `mallopt` in glibc's malloc.h.
_M_ARENA_MAX: Final = -8


def share_one_heap() -> bool:
    """Have all threads that are to come allocate from one heap; False: the C library is not glibc.

    Else glibc gives each thread its own, up to eight a core, and what is free in one is of no use to the others: under
    requests and faults that wake many threads the heaps grew by 200 MB an hour although nothing was kept
    (`python -m benchmarks.soak`). Python's lock lets one thread run at a time, so they hardly wait for each other.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    return mallopt is not None and mallopt(_M_ARENA_MAX, 1) == 1
