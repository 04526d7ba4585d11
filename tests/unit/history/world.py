"""Drives whose rows, events and diagnoses a test makes, a recorder over them, and clocks that it sets."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from servo_daemon.config import HistoryConfig
from servo_daemon.history.archive import StoreArchive
from servo_daemon.history.database import Database
from servo_daemon.history.levels import levels_of
from servo_daemon.history.recorder import Recorder
from servo_daemon.pipeline.event_log import EventLog
from servo_daemon.published.diagnosis_state import Adoption, Diagnosis, DiagnosisView
from servo_daemon.published.history import HistoryRing
from servo_daemon.published.snapshot import ParameterEstimate
from tests.fake_daemon import T0, make_estimate, make_snapshot


@dataclass
class Drive:
    """A `Source`."""

    name: str = "axis1"
    history: HistoryRing = field(default_factory=HistoryRing)
    diagnosis: DiagnosisView = field(default_factory=lambda: DiagnosisView(Diagnosis(), Adoption(False), True, None))
    model: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        self.log = EventLog(self.name)


@dataclass
class World:
    """Time goes on in `run`; rows come at 10 Hz and the recorder turns every 3 s, as in the daemon."""

    database: Database
    config: HistoryConfig = field(default_factory=HistoryConfig)
    drives: tuple[Drive, ...] = field(default_factory=lambda: (Drive(),))
    now: float = T0 + 0.05
    monotonic: float = 1000.0
    truth: dict[float, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.recorder = self.new_recorder()

    @classmethod
    def in_folder(cls, folder: Path, **config: object) -> World:
        return cls(Database(folder / "history.sqlite"), HistoryConfig(**config))  # type: ignore[arg-type]

    @property
    def archive(self) -> StoreArchive:
        return StoreArchive(self.recorder, lambda: self.now)

    def new_recorder(self) -> Recorder:
        return Recorder(self.database, levels_of(self.config), self.drives, self.config.quota_MB * 1e6)

    def row(self, drive: Drive, seconds: float) -> None:
        """One row, and the moment after it."""
        self.now, self.monotonic = round(self.now + seconds, 3), self.monotonic + seconds
        R = 0.5 + 0.1 * np.sin(self.now / 7.0)
        parameters = (ParameterEstimate("R", R, 0.01, "Ω", 0.4, "tracking"),)
        drive.history.append(make_snapshot(drive.name, time=self.now, estimate=make_estimate(1.0, parameters)))
        self.truth[self.now] = float(R)

    def run(self, seconds: float, turns: bool = True) -> None:
        """Rows of the first drive, ten a second."""
        for k in range(round(10 * seconds)):
            self.row(self.drives[0], 0.1)
            if turns and k % 30 == 29:
                self.turn()

    def turn(self) -> None:
        while self.recorder.turn(self.now, self.monotonic):
            pass

    def restart(self, drives: tuple[Drive, ...] | None = None) -> None:
        """As after a SIGKILL: memory is gone, nothing was said to the database."""
        self.drives = tuple(Drive(d.name) for d in self.drives) if drives is None else drives
        if self.database.path is not None:
            self.database = Database(self.database.path)
        self.recorder = self.new_recorder()
        self.turn()
        if self.recorder.check is not None:
            self.recorder.check.thread.join()
        self.turn()  # sets aside what is damaged,
        self.turn()  # and begins anew

    def diagnose(self, result: dict[str, object]) -> None:
        done = Diagnosis("done", "request", (), self.now - 9, self.now, result=result)
        self.drives[0].diagnosis = replace(self.drives[0].diagnosis, diagnosis=done)
