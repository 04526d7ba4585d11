"""What a drive keeps over a restart: laid out by the worker, written by the saver, because a disk may be slow."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

from servo_daemon.config import DriveConfig
from servo_daemon.daemon.persist import StateFile
from servo_daemon.pipeline.publish import Adopted, SavedState


class StateKeeper:
    """Keeps one drive's state file. `write` belongs to the saver, everything else to the worker.

    Args:
        directory: where state files are; None: nothing is kept.
        config: the drive's, as the user wrote it.
    """

    def __init__(self, directory: Path | None, config: DriveConfig) -> None:
        self._file = StateFile(directory, config.name)
        self._config = config
        self._writing = threading.Lock()
        self._offered: tuple[str, SavedState] | None = None
        self._refused: tuple[str, SavedState] | None = None  # by the disk; the saver's
        self._kept: DriveConfig = config  # whose model the file has, or will have

    def load(self, identity: str) -> SavedState | None:
        """What was kept of this device with the configured model, or with one adopted in its place."""
        return self._file.load(identity, self._config.model)

    def knows(self, active: DriveConfig) -> None:
        """The file has this model already."""
        self._kept = active

    def follow(self, config: DriveConfig, before: DriveConfig, active: DriveConfig) -> None:
        """The drive's configuration is another, not its model.

        Args:
            before, active: with the model as it is now, until now and from now on.
        """
        self._config = config
        if self._kept is before:
            self._kept = active

    def offer(self, identity: str, saved: SavedState | None, active: DriveConfig) -> None:
        """Lay out what is worth keeping.

        Args:
            saved: estimates; None: they are not known well enough now.
            active: the drive's configuration with the model as it is now, which is kept in any case.
        """
        if saved is None and active is not self._kept:
            saved = SavedState(active.model, (), (), ())
        if saved is not None:
            self._kept = active
            self._offered = (identity, replace(saved, adopted=Adopted.of(self._config, active)))

    def write(self) -> None:
        """Write what was laid out; what cannot be written is tried again next time, unless something newer is there."""
        with self._writing:
            offered, self._offered = self._offered or self._refused, None
            if offered is None:
                return
            if offered[1].names or offered[1].adopted is not None:
                self._refused = None if self._file.save(*offered) else offered
            else:  # an adopted model was given back, and of the configured one nothing is known yet
                self._file.forget()
                self._refused = None

    @property
    def unwritable(self) -> bool:
        """The newest state is not in the file, because that cannot be written."""
        return self._refused is not None

    def forget(self) -> None:
        """Delete the file; nothing older may be written after it."""
        with self._writing:
            self._offered = self._refused = None
            self._kept = self._config
            self._file.forget()
