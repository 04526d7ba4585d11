"""What can go wrong between a client and a daemon."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from servo_daemon.errors import ServoDaemonError


class UnreachableError(ServoDaemonError):
    """No answer: the daemon does not run, or not there."""


class DaemonError(ServoDaemonError):
    """The daemon refused; its text is the problem's `detail`.

    Attributes:
        status: HTTP status.
        code: short machine name: "unknown_drive", "not_now", …
        document: the problem document (RFC 9457).
    """

    def __init__(self, status: int, document: Mapping[str, Any]) -> None:
        super().__init__(str(document.get("detail") or f"the daemon answered with status {status}"))
        self.status, self.document = status, document
        self.code = str(document.get("code", "http_error"))
