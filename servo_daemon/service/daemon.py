"""The daemon: one worker thread over all drives, reader threads, a saver, and what systemd wants to hear.

The worker is woken by the readers' blocks, which come some 25 times a second, and takes whatever has queued up for
each drive in one go: the cost of a turn is shared by its samples, and what the reader has just touched is still warm.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from drivers.registry import make_driver
from servo_daemon import __version__
from servo_daemon.config import Config
from servo_daemon.service.diagnosis_runner import DiagnosisRunner
from servo_daemon.service.drive import DriveRuntime
from servo_daemon.service.learned_desk import LearnedDesk
from servo_daemon.service.notify import Notifier

log = logging.getLogger(__name__)

#: With several drives the worker waits so long for the others' blocks once one has come, s: fewer turns.
_GATHER_S = 0.015
#: Without any block it turns all the same, to see that a drive has fallen silent and to feed the watchdog, s.
_IDLE_TURN_S = 0.1
#: READY is told to systemd after the first fresh samples, or this long after the start, s.
START_TIMEOUT_S = 10.0
#: The watchdog is not fed while more than this many samples wait: the pipeline does not keep up.
_BACKLOG_SAMPLES = 50_000
#: A worker that has not turned for this long is a problem the API reports, s.
_STUCK_S = 5.0
#: A stop waits so long for threads that are busy (with the first model's equations, say), s: of the 2 s that a stop may
#: take the end of the server and of the interpreter need 0.5 on a slow machine.
_STOP_S = 1.2


class Daemon:
    """All drives of a configuration. `start` and `stop` once each.

    Args:
        config: checked configuration.
        state_dir: where knowledge is kept over a restart; None: nowhere.

    Raises:
        ConfigError: a driver's options are wrong.
    """

    def __init__(self, config: Config, state_dir: Path | None = None, notifier: Notifier | None = None) -> None:
        self.config = config
        self.version = __version__
        self.started = time.time()
        self._wake = threading.Event()
        self._stop = threading.Event()
        self._save_now = threading.Event()
        self._notifier = Notifier.from_environment() if notifier is None else notifier
        self._ready, self._said, self._tell_next = False, "", 0.0
        self._turned = time.monotonic()
        d = config.diagnosis
        home = None if state_dir is None else state_dir / "diagnosis"
        self._diagnoses = DiagnosisRunner(d.command, d.time_limit_s, d.nice, home)
        self._learned = LearnedDesk(config.learning)
        self._runtimes = {
            d.name: DriveRuntime(
                d,
                make_driver(d.driver, d.name, d.options),
                state_dir,
                self._wake.set,
                self._diagnoses,
                self._learned.seat(d.name) if d.estimation.refresh else None,
            )
            for d in config.drive
        }
        self._worker = threading.Thread(target=self._work, name="pipeline", daemon=True)
        self._saver = threading.Thread(target=self._save, name="saver", daemon=True)

    @property
    def drives(self) -> Mapping[str, DriveRuntime]:
        """Drives by name, in the order of the configuration."""
        return self._runtimes

    def stopping(self) -> bool:
        """The daemon has been told to stop."""
        return self._stop.is_set()

    def problems(self) -> Sequence[str]:
        """What is wrong with the daemon itself, in words; empty when healthy."""
        problems = [p for r in self._runtimes.values() if (p := r.problem) is not None]
        if self._worker.ident is not None and time.monotonic() - self._turned > _STUCK_S:
            problems.append(f"the pipeline has not turned for {time.monotonic() - self._turned:.0f} s")
        return problems

    def start(self) -> None:
        self._worker.start()
        self._saver.start()
        self._learned.start()
        for runtime in self._runtimes.values():
            runtime.reader.start()

    def begin_stop(self) -> None:
        """Ask everything to end without waiting: open streams see it at once."""
        if not self._stop.is_set():
            self._notifier.stopping()
            self._stop.set()
            self._wake.set()
            self._diagnoses.kill()
            self._learned.begin_stop()
            for runtime in self._runtimes.values():
                runtime.reader.request_stop()

    def stop(self, timeout_s: float = _STOP_S) -> None:
        """End readers, worker and saver; what was learned is saved once more. Idempotent."""
        self.begin_stop()
        deadline = time.monotonic() + timeout_s
        for runtime in self._runtimes.values():
            runtime.reader.stop(max(0.05, deadline - time.monotonic()))
        for thread in (self._worker, self._saver):
            if thread.is_alive():
                thread.join(max(0.05, deadline - time.monotonic()))
        self._diagnoses.stop(max(0.05, deadline - time.monotonic()))
        self._learned.stop(max(0.05, deadline - time.monotonic()))

    # -- threads ---------------------------------------------------------------------------------------------

    def _work(self) -> None:
        began = next_save = time.monotonic()
        while not self._stop.is_set():
            self._wake.wait(_IDLE_TURN_S)
            if len(self._runtimes) > 1:
                self._stop.wait(_GATHER_S)
            self._wake.clear()
            fresh = [runtime.work() for runtime in self._runtimes.values()]
            self._turned = now = time.monotonic()
            self._tell_systemd(any(fresh), now - began)
            if now >= next_save:
                next_save = now + self.config.storage.save_interval_s
                self._hand_to_saver()
        self._hand_to_saver()

    def _hand_to_saver(self) -> None:
        """The pipelines belong to this thread; writing to a disk that may be slow does not."""
        for runtime in self._runtimes.values():
            runtime.offer_state()
        self._save_now.set()

    def _save(self) -> None:
        last = False
        while not last:
            last = self._stop.is_set() and not self._worker.is_alive()
            self._save_now.wait(0.2)
            self._save_now.clear()
            for runtime in self._runtimes.values():
                runtime.save_offered()

    def _tell_systemd(self, fresh: bool, running_s: float) -> None:
        if not self._ready and (fresh or running_s > START_TIMEOUT_S):
            self._ready = True
            self._notifier.ready(self._summary())
        if self._turned < self._tell_next:
            return
        self._tell_next = self._turned + min(1.0, self._notifier.watchdog_interval_s or 1.0)
        if sum(r.reader.queue.samples for r in self._runtimes.values()) < _BACKLOG_SAMPLES:
            self._notifier.watchdog()
        if (summary := self._summary()) != self._said:
            self._said = summary
            self._notifier.status(summary)

    def _summary(self) -> str:
        """One line for `systemctl status`."""
        parts = []
        for name, runtime in self._runtimes.items():
            snapshot = runtime.snapshot()
            parameters = snapshot.estimate.parameters if snapshot.estimate is not None else ()
            tracking = sum(p.status == "tracking" for p in parameters)
            parts.append(f"{name} {snapshot.connection}, {tracking} of {len(parameters)} parameters tracking")
        return "; ".join(parts)
