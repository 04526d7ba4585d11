"""The thread that writes the history, and what it is made of."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from servo_daemon.config import HistoryConfig
from servo_daemon.history.archive import StoreArchive
from servo_daemon.history.database import Database
from servo_daemon.history.levels import levels_of
from servo_daemon.history.recorder import Recorder, Source

log = logging.getLogger(__name__)

#: From one turn to the next, s: with the time that a turn takes no more than 5 s are lost when the process is killed.
TURN_S: Final = 3.0
FILE: Final = "history.sqlite"


class Recording:
    """`start` and `stop` once each.

    Args:
        config: with `url` or `path`, unless there is a `state_dir`.
        sources: the drives.

    Raises:
        ConfigError: `[history] url` makes no sense.
    """

    def __init__(self, config: HistoryConfig, state_dir: Path | None, sources: Sequence[Source]) -> None:
        path = config.path if state_dir is None or config.path is not None else state_dir / FILE
        database = Database(None if config.url is not None or path is None else Path(path), config.url)
        self.recorder = Recorder(database, levels_of(config), sources, config.quota_MB * 1e6)
        self.archive = StoreArchive(self.recorder)
        self._stop, self._wake = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="history", daemon=True)

    @property
    def problem(self) -> str | None:
        """Why nothing is written now, in words."""
        return self.recorder.problem

    def start(self) -> None:
        self._thread.start()

    def follow(self, sources: Sequence[Source]) -> None:
        """These are the drives from now on; of those that have gone what is new is written first."""
        self.recorder.wanted = sources
        self._wake.set()

    def stop(self, timeout_s: float) -> None:
        """Write what is new once more, and end."""
        self._stop.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(timeout_s)

    def _run(self) -> None:
        last = False
        while not last:
            last = self._stop.is_set()
            try:
                more = self.recorder.turn(time.time(), time.monotonic())
            except Exception:  # an error in the program must end neither the thread nor the daemon
                log.exception("history: a turn failed")
                more = False
            if not (more or last):
                self._wake.wait(TURN_S)
                self._wake.clear()
        self.recorder.close()
