"""Runs a program that may be slow beside the daemon, and never survives it.

    python low_priority.py PARENT_PID NICE PROGRAM ARGUMENT…

A file of its own and nothing but the standard library: between fork and exec of a process with threads no Python may
run, so the child does this to itself before it becomes the program.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1  # <linux/prctl.h>


def main(arguments: list[str]) -> int:
    parent, nice, program = int(arguments[0]), int(arguments[1]), arguments[2:]
    with contextlib.suppress(OSError):  # less is not forbidden, more may be
        os.nice(nice)
    if sys.platform == "linux":
        import ctypes

        # Sent when the thread that started us ends, however the daemon ends; survives exec.
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        return 1  # it has ended before it could be asked to take us along
    try:
        os.execvp(program[0], program)
    except OSError as error:
        sys.stderr.write(f"{program[0]}: cannot be started: {error.strerror or error}\n")
    return 127


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
