"""A pseudo-terminal under a name of its own, for programs that expect a serial port."""

from __future__ import annotations

import contextlib
import os
import tty
from pathlib import Path
from types import TracebackType

from servo_daemon.errors import BadInputError


class PtyLink:
    """A pseudo-terminal whose slave side `link` points to. Used with `with`; the link is gone afterwards.

    The slave side is kept open here too, so that a reader that comes and goes leaves the master side usable.

    Args:
        link: replaced if it is a symbolic link (of a process that died), never if it is anything else.

    Raises:
        BadInputError: `link` exists and is no symbolic link, or its directory cannot be written.
    """

    def __init__(self, link: Path) -> None:
        self._link = link
        self.master = -1
        self._slave = -1

    def __enter__(self) -> PtyLink:
        if os.path.lexists(self._link) and not self._link.is_symlink():
            raise BadInputError(f"{self._link} exists and is no symbolic link: not replaced")
        self.master, self._slave = os.openpty()
        try:
            tty.setraw(self._slave)
            os.set_blocking(self.master, False)
            fresh = self._link.with_name(f".{self._link.name}.{os.getpid()}")
            fresh.symlink_to(os.ttyname(self._slave))
            fresh.replace(self._link)
        except OSError as error:
            self._close()
            raise BadInputError(f"{self._link} cannot be made: {error.strerror}") from error
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        with contextlib.suppress(OSError):
            if self._link.readlink() == Path(os.ttyname(self._slave)):  # not that of a successor
                self._link.unlink()
        self._close()

    def _close(self) -> None:
        os.close(self.master)
        os.close(self._slave)
