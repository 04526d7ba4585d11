"""One heap for all threads."""

from __future__ import annotations

import ctypes
import subprocess
import sys

import pytest

#: Threads that hold memory at the same time, then glibc's own list of its heaps.
_HEAPS = """
import ctypes, sys, threading
from servo_daemon.commands.run.heap import share_one_heap
if sys.argv[1] == "one":
    assert share_one_heap()
meeting, kept = threading.Barrier(4), []
def hold():
    meeting.wait()
    kept.extend(bytes(1000) for _ in range(1000))
    meeting.wait()
threads = [threading.Thread(target=hold) for _ in range(4)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
libc = ctypes.CDLL(None)
libc.fdopen.restype = ctypes.c_void_p
out = ctypes.c_void_p(libc.fdopen(1, b"w"))
libc.malloc_info(0, out)
libc.fflush(out)
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "malloc_info"), reason="the C library is not glibc")
@pytest.mark.parametrize(("heaps", "one"), [("one", True), ("as it is", False)])
def test_all_threads_share_one_heap(heaps: str, one: bool) -> None:
    told = subprocess.run([sys.executable, "-c", _HEAPS, heaps], check=True, capture_output=True, text=True, timeout=60)
    assert (told.stdout.count("<heap nr=") == 1) == one
