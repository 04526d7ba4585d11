"""A thread that works beside the drives until it is told to stop."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

log = logging.getLogger(__name__)


class Background:
    """What a class with a thread of its own derives from; `_run` is that thread's work. `start` and `stop` once each.

    Args:
        name: of the thread, in the log.
    """

    def __init__(self, name: str) -> None:
        self._stop, self._wake = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def _run(self) -> None:
        raise NotImplementedError

    def start(self) -> None:
        self._thread.start()

    def begin_stop(self) -> None:
        """Ask it to end without waiting."""
        self._stop.set()
        self._wake.set()

    def stop(self, timeout_s: float) -> None:
        """End. Idempotent."""
        self.begin_stop()
        if self._thread.is_alive():
            self._thread.join(timeout_s)

    def _go_round(self, turn: Callable[[bool], bool | None], every_s: float) -> None:
        """Take turns until it is to stop, and then a last one.

        Args:
            turn: told whether it is the last; returns True for another one at once.
            every_s: from the end of a turn to the next, unless `_wake` is set.
        """
        last = False
        while not last:
            last, again = self._stop.is_set(), False
            try:
                again = bool(turn(last))
            except Exception:  # an error in the program must end neither the thread nor the daemon
                log.exception("%s: a turn failed", self._thread.name)
            if not (again or last):
                self._wake.wait(every_s)
                self._wake.clear()
