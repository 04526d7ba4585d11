"""One daemon for each drive's state: two would overwrite each other's knowledge in turn.

A lock of the operating system (flock) on a file beside the state: it is gone with the process, however that ends, so
there is no stale lock to clean up. Where the file cannot be made or locked (a read-only directory, a file system
without locks) nothing is locked: that the state cannot be kept is told elsewhere.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO

from servo_daemon.errors import ServoDaemonError

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None  # type: ignore[assignment]


@contextmanager
def state_locked(directory: Path | None, drives: Iterable[str]) -> Iterator[None]:
    """The state of these drives is this process's own while the context lasts.

    Args:
        directory: where state files are; None: nothing is kept.
        drives: their names.

    Raises:
        ServoDaemonError: another process has that of one of them.
    """
    with ExitStack() as held:
        if directory is not None and fcntl is not None:
            for drive in drives:
                file = _locked(directory / f"{drive}.lock", drive)
                if file is not None:
                    held.enter_context(file)
        yield


def _locked(path: Path, drive: str) -> IO[str] | None:
    """The open file that holds the lock; None where there can be none."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("a+", encoding="utf-8")
    except OSError:
        return None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.seek(0)
        who = file.read(20).strip()
        file.close()
        raise ServoDaemonError(
            f"the state of drive {drive} in {path.parent} belongs to another servo-daemon that runs"
            f"{f' (process {who})' if who else ''}; stop it, or give this one a directory of its own with --state-dir"
        ) from None
    except OSError:
        file.close()
        return None
    file.truncate(0)
    file.write(f"{os.getpid()}\n")
    file.flush()
    return file
