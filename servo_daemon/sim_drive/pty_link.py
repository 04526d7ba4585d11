"""A pseudo-terminal under a name of its own, for programs that expect a serial port."""

from __future__ import annotations

import contextlib
import os
import threading
import tty
from pathlib import Path
from types import TracebackType

from servo_daemon.errors import BadInputError

#: Longest wait before a simulated drive looks at `stop` again, s.
POLL_S = 0.05


class PtyLink:
    """A pseudo-terminal whose slave side `link` points to. Used with `with`; the link is gone afterwards.

    Args:
        link: replaced if it is a symbolic link (of a process that died), never if it is anything else.
        hold_open: keep the slave side open here too, so that a reader that comes and goes leaves the master side
            usable. Otherwise the system tells (POLLHUP) whether a reader has it open.

    Attributes:
        master: descriptor of the master side, non-blocking.

    Raises:
        BadInputError: `link` exists and is no symbolic link, or its directory cannot be written.
    """

    def __init__(self, link: Path, *, hold_open: bool = True) -> None:
        self._link, self._hold_open = link, hold_open
        self.master = -1
        self._slave: int | None = None
        self._target = Path()

    def __enter__(self) -> PtyLink:
        if os.path.lexists(self._link) and not self._link.is_symlink():
            raise BadInputError(f"{self._link} exists and is no symbolic link: not replaced")
        self.master, self._slave = os.openpty()
        try:
            tty.setraw(self._slave)
            os.set_blocking(self.master, False)
            self._target = Path(os.ttyname(self._slave))
            self._name_it()
        except OSError as error:
            self._close()
            raise BadInputError(f"{self._link} cannot be made: {error.strerror or error}") from error
        if not self._hold_open:
            self._close_slave()
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        with contextlib.suppress(OSError):
            if self._link.readlink() == self._target:  # not that of a successor
                self._link.unlink()
        self._close()

    def _name_it(self) -> None:
        """In one step, so that nobody finds the name without a terminal."""
        fresh = self._link.with_name(f".{self._link.name}.{os.getpid()}.{threading.get_ident()}")
        try:
            fresh.symlink_to(self._target)
            fresh.replace(self._link)
        except OSError:
            fresh.unlink(missing_ok=True)
            raise

    def _close(self) -> None:
        os.close(self.master)
        self._close_slave()

    def _close_slave(self) -> None:
        if self._slave is not None:
            os.close(self._slave)
            self._slave = None
