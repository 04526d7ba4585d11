"""The daemon: the workers over all drives, reader threads, a saver, and what systemd wants to hear."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from drivers.base import Driver
from drivers.registry import make_driver
from servo_daemon import __version__
from servo_daemon.config import Config, DriveConfig
from servo_daemon.config.changes import Change, How, at_work, drives_of
from servo_daemon.daemon.captures.coordinator import CaptureCoordinator
from servo_daemon.daemon.captures.folder import CaptureFolder
from servo_daemon.daemon.diagnosis.runner import DiagnosisRunner
from servo_daemon.daemon.drive import DriveRuntime
from servo_daemon.daemon.learning_coordinator import LearningCoordinator
from servo_daemon.daemon.lines.ports import Ports
from servo_daemon.daemon.notify import Notifier
from servo_daemon.daemon.slot import DriveSlot
from servo_daemon.daemon.state_lock import StateLocks
from servo_daemon.daemon.supervision import Supervision
from servo_daemon.daemon.trends.coordinator import TrendCoordinator
from servo_daemon.daemon.worker import Workers
from servo_daemon.published.sinks import SinkState
from servo_daemon.sinks import sinks_of

if TYPE_CHECKING:
    from servo_daemon.daemon.recording import Recording
    from servo_daemon.history.archive import StoreArchive

log = logging.getLogger(__name__)

#: The workers are looked after this often, s.
_WATCH_S = 0.02
#: A stop waits so long for threads that are busy (with the first model's equations, say), s: of the 2 s that a stop may
#: take the end of the server and of the interpreter need 0.5 on a slow machine.
_STOP_S = 1.2
#: A drive that goes has so long to work off what came before, s: an estimator that is being made may take ten.
_LEAVE_S = 15.0
#: The longest cycle in which a drive's samples are judged, s: of each calm one the balances are asked so often
#: (`regression/motor_rls.py`). Drives that begin spread over it have that work one after the other. (Six that began
#: together had 60 ms of it at once, every two seconds.)
_CYCLE_S = 2.0
_BY_DRIVE: tuple[How, ...] = ("again", "new", "gone")


class Daemon:
    """All drives of a configuration. `start` and `stop` once each.

    Args:
        config: checked configuration.
        state_dir: where knowledge is kept over a restart; None: nowhere.
        locks: of that of its drives, which are held already; None: it needs none.

    Raises:
        ConfigError: a driver's options are wrong.
    """

    def __init__(
        self,
        config: Config,
        state_dir: Path | None = None,
        notifier: Notifier | None = None,
        locks: StateLocks | None = None,
    ) -> None:
        self.config, self._state_dir, self._locks = config, state_dir, locks or StateLocks(None)
        self.version = __version__
        self.started = time.time()
        self._stop = threading.Event()
        self._save_now = threading.Event()
        self._notifier = Notifier.from_environment() if notifier is None else notifier
        self._supervision = Supervision(self._notifier, time.monotonic())
        d = config.diagnosis
        home = None if state_dir is None else state_dir / "diagnosis"
        self._diagnoses = DiagnosisRunner(d.command, d.budget_s, d.time_limit_s, d.nice, home)
        self._learning = LearningCoordinator(config.learning)
        self._ports = Ports()
        self._workers = Workers(self._stop, self._ports)
        self._slots = {d.name: self._slot_for(d, _driver_for(d)) for d in config.drive}
        self._recording = self._recorded(state_dir)
        self._sinks = sinks_of(config, tuple(slot.runtime for slot in self._slots.values()), state_dir)
        self._trends = TrendCoordinator(self.archive, [slot.runtime for slot in self._slots.values()])
        self.captures = self._kept_captures(state_dir)
        beside = (self._trends, self.captures, self._recording, *self._sinks)
        self._beside = [b for b in beside if b is not None]
        self._watcher = threading.Thread(target=self._watch, name="watch", daemon=True)
        self._saver = threading.Thread(target=self._save, name="saver", daemon=True)

    def _recorded(self, state_dir: Path | None) -> Recording | None:
        """What writes the history, if one is kept."""
        h = self.config.history
        if not h.enabled or (h.path is None and h.url is None and state_dir is None):
            return None
        from servo_daemon.daemon.recording import Recording  # SQLAlchemy takes its time to load

        return Recording(h, state_dir, [slot.runtime for slot in self._slots.values()])

    def _kept_captures(self, state_dir: Path | None) -> CaptureCoordinator | None:
        """What keeps samples around events, if they are to be kept."""
        quota = self.config.history.captures_quota_MB
        if state_dir is None or not self.config.history.enabled or quota <= 0:
            return None
        folder = CaptureFolder(state_dir / "captures", quota * 1e6)
        return CaptureCoordinator(folder, [slot.runtime for slot in self._slots.values()])

    def _slot_for(self, config: DriveConfig, driver: Driver) -> DriveSlot:
        model = self._learning.subscribe(config.name) if config.estimation.refresh else None

        def make(wake: Callable[[], None]) -> DriveRuntime:
            return DriveRuntime(config, driver, self._state_dir, wake, self._diagnoses, model, self._ports)

        return DriveSlot(make, self._workers.call, self.config.storage.save_interval_s, self._save_now.set)

    @property
    def drives(self) -> Mapping[str, DriveRuntime]:
        """Drives by name, in the order of the configuration."""
        return {name: slot.runtime for name, slot in self._slots.items()}

    @property
    def archive(self) -> StoreArchive | None:
        """What was published, for years; None: only the last minutes are kept."""
        return None if self._recording is None else self._recording.archive

    @property
    def sinks(self) -> Sequence[SinkState]:
        """The broker and the webhooks, in the order of the configuration."""
        return [sink.state for sink in self._sinks]

    def stopping(self) -> bool:
        """The daemon has been told to stop."""
        return self._stop.is_set()

    def problems(self) -> Sequence[str]:
        """What is wrong with the daemon itself, in words; empty when healthy."""
        found = [slot.runtime.problem for slot in self._slots.values()]
        found += [slot.problem for slot in self._slots.values() if self._workers.started]
        found += [None if self._recording is None else self._recording.problem]
        found += [None if self.captures is None else self.captures.problem]
        found += [sink.problem for sink in self.sinks]
        return [p for p in found if p is not None]

    def start(self) -> None:
        self._workers.start(tuple(self._slots.values()))
        self._watcher.start()
        self._saver.start()
        self._learning.start()
        for other in self._beside:
            other.start()
        for number, runtime in enumerate(self.drives.values()):
            runtime.reader.start(after_s=number * _CYCLE_S / len(self._slots))

    def begin_stop(self) -> None:
        """Ask everything to end without waiting: open streams see it at once."""
        if not self._stop.is_set():
            self._notifier.stopping()
            self._stop.set()
            self._diagnoses.kill()
            self._learning.begin_stop()
            for other in self._beside:
                if other is not self._recording:  # that ends after the workers: with their last rows
                    other.begin_stop()
            for slot in self._slots.values():
                slot.runtime.reader.request_stop()
                slot.call()

    def stop(self, timeout_s: float = _STOP_S) -> None:
        """End readers, workers and saver; what was learned is saved once more. Idempotent."""
        self.begin_stop()
        deadline = time.monotonic() + timeout_s
        for runtime in self.drives.values():
            runtime.reader.stop(max(0.05, deadline - time.monotonic()))
        for thread in (self._workers, self._watcher, self._saver):
            if thread.is_alive():
                thread.join(max(0.05, deadline - time.monotonic()))
        for other in (*self._beside, self._diagnoses, self._learning):
            other.stop(max(0.05, deadline - time.monotonic()))

    # -- another configuration -------------------------------------------------------------------------------

    def follow(self, config: Config, changed: Sequence[Change]) -> None:
        """Go over to another configuration, as far as that is possible without a restart; all of it or nothing.

        Args:
            changed: what is different.

        Raises:
            ServoDaemonError: a driver's options are wrong, or another process has the state of a new drive. Nothing has
                changed then.
        """
        again, new, gone = (drives_of(changed, how) for how in _BY_DRIVE)
        begin = again | new
        drivers = {d.name: _driver_for(d) for d in config.drive if d.name in begin}
        self._locks.take(new)
        self._dismiss([self._slots[name] for name in again | gone])
        self._locks.release(gone)
        if self._stop.is_set():
            return
        slots = {}
        for drive in config.drive:
            if drive.name in begin:
                slots[drive.name] = self._slot_for(drive, drivers[drive.name])
            else:
                slots[drive.name] = self._slots[drive.name]
                slots[drive.name].runtime.reconfigure(drive)
        self._slots, self.config = slots, at_work(self.config, config)
        self._drives_changed()
        for name in begin:
            slots[name].runtime.reader.start()
        self._tell(changed)

    def _drives_changed(self) -> None:
        """Tell everybody who works for them all."""
        runtimes = list(self.drives.values())
        self._workers.slots = tuple(self._slots.values())
        for other in self._beside:
            other.follow(runtimes)
        self._learning.start()

    def _dismiss(self, slots: Sequence[DriveSlot]) -> None:
        """End these drives: what has come is worked off, what was learned is saved."""
        for slot in slots:
            slot.runtime.reader.request_stop()
        deadline = time.monotonic() + _LEAVE_S
        for slot in slots:
            slot.runtime.reader.stop()
            slot.leave()
            while not (slot.left.wait(_WATCH_S) or self._stop.is_set()):
                if time.monotonic() > deadline:
                    log.warning("drive %s: its last samples are left out: they take too long", slot.runtime.name)
                    break
            slot.runtime.save_offered()
            if slot.runtime.subscription is not None:
                self._learning.unsubscribe(slot.runtime.subscription)

    def _tell(self, changed: Sequence[Change]) -> None:
        """Each drive of what concerns it; the log has it already."""
        for name, runtime in self.drives.items():
            own = [c.text.removeprefix(f"drive {name}: ") for c in changed if c.drive in (None, name)]
            if own:
                text = f"the configuration was read again: {'; '.join(own)}"
                runtime.log.add("reloaded", text, {"changes": len(own)}, logged=False)

    def begin_reload(self) -> None:
        """Tell systemd that the configuration is being read again; `end_reload` must follow."""
        self._supervision.reloading()

    def end_reload(self) -> None:
        """A reload of the configuration is over."""
        if not self._stop.is_set():
            self._supervision.reloaded(tuple(self._slots.values()))

    # -- threads ---------------------------------------------------------------------------------------------

    def _save(self) -> None:
        last = False
        while not last:
            last = self._stop.is_set() and not self._workers.is_alive()
            self._save_now.wait(0.2)
            self._save_now.clear()
            for runtime in self.drives.values():
                runtime.save_offered()

    def _watch(self) -> None:
        while not self._stop.wait(_WATCH_S):
            self._workers.look()
            self._supervision.look(tuple(self._slots.values()))


def _driver_for(config: DriveConfig) -> Driver:
    """Raises: ConfigError: its options are wrong."""
    return make_driver(config.driver, config.name, config.options)
