"""sd_notify(3) in the standard library: tells systemd that the daemon is ready, alive and stopping.

Outside systemd (no NOTIFY_SOCKET) every message goes nowhere, so callers need no condition. A message that cannot
be delivered is logged once and forgotten: telling the supervisor must never stop what it supervises.
"""

from __future__ import annotations

import logging
import os
import socket
import time
from collections.abc import Mapping
from dataclasses import dataclass, field

log = logging.getLogger(__name__)

#: A full socket of a service manager that does not read may hold a caller this long, no longer.
SEND_TIMEOUT_S = 1.0


def socket_address(text: str) -> str:
    """The address behind NOTIFY_SOCKET: a path, or `@name` for the abstract socket of that name.

    Raises:
        ValueError: neither; sd_notify(3) also knows `vsock:`, which only virtual machines use.
    """
    if text.startswith("/"):
        return text
    if text.startswith("@") and len(text) > 1:
        return "\0" + text[1:]
    raise ValueError(f"NOTIFY_SOCKET {text!r} is neither an absolute path nor an abstract name '@...'")


def watchdog_timeout_s(environ: Mapping[str, str], pid: int) -> float | None:
    """The time after which systemd takes the process for hung, s; None where nobody watches this process.

    WATCHDOG_USEC counts only for the process WATCHDOG_PID names, as in sd_watchdog_enabled(3): a child that
    inherits the environment is not watched.
    """
    usec, watched = environ.get("WATCHDOG_USEC", ""), environ.get("WATCHDOG_PID")
    if watched is not None and watched.strip() != str(pid):
        return None
    if not usec.strip().isdecimal() or int(usec) == 0:
        return None
    return int(usec) * 1e-6


@dataclass(slots=True)
class Notifier:
    """The line to the service manager. Its methods may be called from any thread.

    Attributes:
        address: socket address in the form of `socket.sendto`, None: nobody listens.
        watchdog_s: systemd's limit between two `watchdog` calls, s; None: none is asked for.
    """

    address: str | None = None
    watchdog_s: float | None = None
    _failed: bool = field(default=False, init=False, repr=False)

    @classmethod
    def from_environment(cls, environ: Mapping[str, str] = os.environ) -> Notifier:
        """As systemd describes it in NOTIFY_SOCKET, WATCHDOG_USEC and WATCHDOG_PID."""
        text = environ.get("NOTIFY_SOCKET")
        if not text:
            return cls()
        try:
            address = socket_address(text)
        except ValueError as error:
            log.warning("systemd is not told anything: %s", error)
            return cls()
        return cls(address, watchdog_timeout_s(environ, os.getpid()))

    @property
    def watchdog_interval_s(self) -> float | None:
        """How often to call `watchdog`: half the limit, as sd_watchdog_enabled(3) advises. None: not at all."""
        return None if self.watchdog_s is None else self.watchdog_s / 2

    def ready(self, status: str) -> None:
        """Start-up is finished; `status` is the line that `systemctl status` shows."""
        self._send("READY=1", f"STATUS={status}")

    def status(self, text: str) -> None:
        """A new line for `systemctl status`."""
        self._send(f"STATUS={text}")

    def reloading(self) -> None:
        """The configuration is being read again; `ready` tells that it is done."""
        self._send("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def watchdog(self) -> None:
        """The pipeline loop turns."""
        self._send("WATCHDOG=1")

    def stopping(self) -> None:
        """A clean stop has begun."""
        self._send("STOPPING=1", "STATUS=stopping")

    def _send(self, *assignments: str) -> None:
        if self.address is None:
            return
        message = "\n".join(" ".join(text.splitlines()) for text in assignments).encode()
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as line:
                line.settimeout(SEND_TIMEOUT_S)
                line.sendto(message, self.address)
        except OSError as error:
            if not self._failed:
                log.warning("systemd cannot be told %r: %s (said once)", assignments[0], error)
            self._failed = True
        else:
            self._failed = False
