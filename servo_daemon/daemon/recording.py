"""The thread that writes the history, and what it is made of."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from servo_daemon.background import Background
from servo_daemon.config import HistoryConfig
from servo_daemon.history.archive import StoreArchive
from servo_daemon.history.database import Database
from servo_daemon.history.levels import levels_of
from servo_daemon.history.recorder import Recorder, Source

#: From one turn to the next, s: with the time that a turn takes no more than 5 s are lost when the process is killed.
TURN_S: Final = 3.0
FILE: Final = "history.sqlite"


class Recording(Background):
    """The history, written from what the drives publish; what is new at the stop, too.

    Args:
        config: with `url` or `path`, unless there is a `state_dir`.
        sources: the drives.

    Raises:
        ConfigError: `[history] url` makes no sense.
    """

    def __init__(self, config: HistoryConfig, state_dir: Path | None, sources: Sequence[Source]) -> None:
        super().__init__("history")
        path = config.path if state_dir is None or config.path is not None else state_dir / FILE
        database = Database(None if config.url is not None or path is None else Path(path), config.url)
        self.recorder = Recorder(database, levels_of(config), sources, config.quota_MB * 1e6)
        self.archive = StoreArchive(self.recorder)

    @property
    def problem(self) -> str | None:
        """Why nothing is written now, in words."""
        return self.recorder.problem

    def follow(self, sources: Sequence[Source]) -> None:
        """These are the drives from now on; of those that have gone what is new is written first."""
        self.recorder.wanted = sources
        self._wake.set()

    def _run(self) -> None:
        self._go_round(lambda _: self.recorder.turn(time.time(), time.monotonic()), TURN_S)
        self.recorder.close()
