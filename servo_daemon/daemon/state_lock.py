"""One daemon for each drive's state: two would overwrite each other's knowledge in turn.

A lock of the operating system (flock) on a file beside the state: it is gone with the process, however that ends, so
there is no stale lock to clean up. Where the file cannot be made or locked (a read-only directory, a file system
without locks) nothing is locked: that the state cannot be kept is told elsewhere.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import IO

from servo_daemon.errors import ServoDaemonError

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None  # type: ignore[assignment]


class StateLocks:
    """The state of drives is this process's own while their locks are held; at the end of the context all are free.

    Args:
        directory: where state files are; None: nothing is kept.
    """

    def __init__(self, directory: Path | None) -> None:
        self._directory = directory
        self._held: dict[str, IO[str] | None] = {}

    def take(self, drives: Iterable[str]) -> None:
        """All of these or none.

        Raises:
            ServoDaemonError: another process has that of one of them.
        """
        taken: list[str] = []
        try:
            for drive in drives:
                if self._directory is not None and fcntl is not None and drive not in self._held:
                    self._held[drive] = _locked(self._directory / f"{drive}.lock", drive)
                    taken.append(drive)
        except ServoDaemonError:
            self.release(taken)
            raise

    def release(self, drives: Iterable[str]) -> None:
        """They may be another process's."""
        for drive in drives:
            file = self._held.pop(drive, None)
            if file is not None:
                file.close()

    def __enter__(self) -> StateLocks:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release(tuple(self._held))


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
