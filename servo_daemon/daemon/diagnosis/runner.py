"""Runs the diagnosis program: a process of its own at low priority, one at a time for the whole daemon.

A thread writes the recording, starts the program, follows its stderr (a JSON line for each step) and reads what it
left. The process never outlives the daemon, nor its time limit. It shares the daemon's session, so that its priority
counts against the daemon where the kernel groups processes by session (autogroup), and has a process group of its own,
so that what it starts is ended with it.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any, Final, Protocol

from servo_daemon.daemon.diagnosis import low_priority
from servo_daemon.daemon.diagnosis.files import (
    CAPTURE,
    DOCUMENT,
    DRIVE,
    JOURNAL,
    REPORT,
    put_by,
    read_document,
    take_up,
    write_inputs,
)
from servo_daemon.errors import BusyError, DiagnosisError, ServoDaemonError
from servo_daemon.samples import SampleBlock

log = logging.getLogger(__name__)

#: This program's own.
OWN_COMMAND: Final = (sys.executable, "-m", "servo_daemon", "diagnose")
#: What the daemon's service manager has told the daemon is not for its children.
_NOT_FOR_CHILDREN: Final = ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")
#: Of what a failing diagnosis has said: its last lines, and characters of the reason (an event is read on one screen).
_LINES_KEPT, _LONGEST_REASON = 20, 500
_SCRATCH: Final = "run-"


@dataclass(frozen=True, slots=True)
class Job:
    """What is to be diagnosed.

    Attributes:
        drive: its name.
        folder: where the result is left: `diagnosis.json`, `report.html`.
        blocks, metadata: the recording.
        toml: the drive's configuration as it is now.
        goes_on: with the recording that was not finished, if it is still there.
    """

    drive: str
    folder: Path
    blocks: tuple[SampleBlock, ...]
    metadata: Mapping[str, str]
    toml: str
    goes_on: bool = False


class Listener(Protocol):
    """Who wants to know how a job goes; called from the runner's thread."""

    def on_progress(self, progress: float | None, step: str | None) -> None: ...

    def on_result(self, document: Mapping[str, Any], report: Path | None) -> None: ...

    def on_failure(self, reason: str) -> None: ...


class DiagnosisRunner:
    """The daemon's.

    Args:
        command: the program and its first arguments; empty: `OWN_COMMAND`.
        budget_s: processor time after which the program gives the best so far.
        limit_s: by the clock: after so long it is ended.
        nice: added to the daemon's.
        home: where results are kept, a folder for each drive; None: only as long as the daemon runs.
    """

    def __init__(
        self,
        command: tuple[str, ...] = (),
        budget_s: float = 900.0,
        limit_s: float = 7200.0,
        nice: int = 15,
        home: Path | None = None,
    ) -> None:
        self._command, self._budget_s, self._limit_s, self._nice = command or OWN_COMMAND, budget_s, limit_s, nice
        self.home = home
        self._temporary: tempfile.TemporaryDirectory[str] | None = None
        self._lock = threading.Lock()
        self._job: Job | None = None
        self._process: subprocess.Popen[str] | None = None
        self._thread: threading.Thread | None = None
        self._stopping = self._timed_out = False

    @property
    def busy_with(self) -> str | None:
        """The drive that is being diagnosed."""
        job = self._job
        return None if job is None else job.drive

    def folder(self, drive: str) -> Path:
        """Where the result of this drive is left."""
        if self.home is not None:
            return self.home / drive
        with self._lock:
            if self._temporary is None:
                self._temporary = tempfile.TemporaryDirectory(prefix="servo-daemon-", ignore_cleanup_errors=True)
        return Path(self._temporary.name) / drive

    def start(self, job: Job, listener: Listener) -> None:
        """Begin; returns at once.

        Raises:
            BusyError: one is running, or the daemon stops.
        """
        with self._lock:
            if self._stopping:
                raise BusyError("the daemon is stopping")
            if self._job is not None:
                raise BusyError(f"a diagnosis of drive {self._job.drive} is running; there is one at a time")
            self._job = job
        self._thread = threading.Thread(target=self._run, args=(job, listener), name="diagnosis", daemon=True)
        self._thread.start()

    def kill(self) -> None:
        """End what is running without waiting, and start nothing more."""
        with self._lock:
            self._stopping = True
            self._kill()

    def stop(self, timeout_s: float = 1.0) -> None:
        """The same, and wait for it at most so long. Idempotent."""
        self.kill()
        if self._thread is not None:
            self._thread.join(timeout_s)
        if self._temporary is not None:
            self._temporary.cleanup()

    # -- the runner's thread ---------------------------------------------------------------------------------

    def _run(self, job: Job, listener: Listener) -> None:
        try:
            document, report = self._diagnose(job, listener)
            tell = partial(listener.on_result, document, report)
        except ServoDaemonError as error:
            tell = partial(listener.on_failure, str(error))
        except Exception as error:  # whatever happens, the next diagnosis must be possible
            log.exception("drive %s: the diagnosis failed", job.drive)
            tell = partial(listener.on_failure, f"{type(error).__name__}: {error}")
        with self._lock:
            self._job = None  # first: who sees a verdict may begin the next
        if not self._stopping:
            tell()

    def _diagnose(self, job: Job, listener: Listener) -> tuple[Mapping[str, Any], Path | None]:
        """Raises: ServoDaemonError: it came to nothing."""
        try:
            job.folder.mkdir(parents=True, exist_ok=True)
            for left in job.folder.glob(f"{_SCRATCH}*"):  # by a daemon that was killed
                shutil.rmtree(left, ignore_errors=True)
            scratch = Path(tempfile.mkdtemp(dir=job.folder, prefix=_SCRATCH))
        except OSError as error:
            raise DiagnosisError(f"{job.folder}: {error.strerror or error}") from error
        try:
            listener.on_progress(0.0, "writing the recording")
            if not (job.goes_on and take_up(job.folder, scratch)):
                write_inputs(scratch, job.blocks, job.metadata, job.toml)
            self._call(job, scratch, listener)
            document = read_document(scratch / "out" / DOCUMENT)
            put_by(scratch, job.folder, unfinished=document.get("unfinished") is not None)
            return document, _keep(scratch / "out", job.folder)
        finally:
            shutil.rmtree(scratch, ignore_errors=True)

    def _call(self, job: Job, scratch: Path, listener: Listener) -> None:
        """Raises: DiagnosisError: the program fails, or takes too long, or the daemon is stopping."""
        process = self._start_program(job, scratch)
        timer = threading.Timer(self._limit_s, self._time_out)
        timer.daemon = True
        timer.start()
        try:
            assert process.stderr is not None
            said = _follow(process.stderr, listener)
            code = process.wait()
        finally:
            timer.cancel()
            with self._lock:
                self._kill()
                self._process = None
            process.wait()
            if process.stderr is not None:
                process.stderr.close()
        if self._timed_out:
            raise DiagnosisError(f"ended after its time limit of {self._limit_s:g} s")
        if code != 0:
            why = said[-1] if said else "without a word"
            raise DiagnosisError(f"the diagnosis program ended with {_exit_text(code)}: {why}"[:_LONGEST_REASON])

    def _start_program(self, job: Job, scratch: Path) -> subprocess.Popen[str]:
        """Raises: DiagnosisError: the daemon is stopping."""
        arguments = (
            str(scratch / CAPTURE), "--out", str(scratch / "out"), "--config", str(scratch / DRIVE),
            "--drive", job.drive, "--json", "--progress-json", "--budget", f"{self._budget_s:g}",
            "--journal", str(scratch / JOURNAL),
        )  # fmt: skip
        guard = (sys.executable, "-I", "-S", low_priority.__file__, str(os.getpid()), str(self._nice))
        environment = {k: v for k, v in os.environ.items() if k not in _NOT_FOR_CHILDREN}
        with self._lock:
            if self._stopping:
                raise DiagnosisError("the daemon is stopping")
            self._timed_out = False
            self._process = subprocess.Popen(
                (*guard, *self._command, *arguments),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                env=environment,
                encoding="utf-8",
                errors="replace",
                process_group=0,
            )
            return self._process

    def _time_out(self) -> None:
        with self._lock:
            self._timed_out = True
            self._kill()

    def _kill(self) -> None:
        """The program and what it has started; with the lock held."""
        if self._process is not None:
            with contextlib.suppress(ProcessLookupError, PermissionError):  # everything in the group has ended
                os.killpg(self._process.pid, signal.SIGKILL)


def _follow(stderr: IO[str], listener: Listener) -> list[str]:
    """Its progress as it comes. Returns the last other lines."""
    said: deque[str] = deque(maxlen=_LINES_KEPT)
    for line in stderr:
        text = line.strip()
        step = _progress(text)
        if step is not None:
            listener.on_progress(*step)
        elif text:
            said.append(text)
            log.debug("diagnosis: %s", text)
    return list(said)


def _progress(line: str) -> tuple[float | None, str | None] | None:
    """`{"progress": 0.35, "step": "…"}` as a pair; None: the line is something else."""
    if not line.startswith("{"):
        return None
    try:
        data = json.loads(line)
    except ValueError:
        return None
    if not isinstance(data, dict) or not ({"progress", "step"} & data.keys()):
        return None
    share, step = data.get("progress"), data.get("step")
    known = float(share) if isinstance(share, int | float) and 0 <= share <= 1 else None
    return known, None if step is None else str(step)[:_LONGEST_REASON]


def _keep(out: Path, folder: Path) -> Path | None:
    """Document and report in the place of the last ones. Returns the report, if there is one."""
    try:
        (out / DOCUMENT).replace(folder / DOCUMENT)
        if (out / REPORT).exists():
            return (out / REPORT).replace(folder / REPORT)
        (folder / REPORT).unlink(missing_ok=True)
    except OSError as error:
        raise DiagnosisError(f"{folder}: {error.strerror or error}") from error
    return None


def _exit_text(code: int) -> str:
    if code >= 0:
        return f"exit code {code}"
    try:
        return signal.Signals(-code).name
    except ValueError:
        return f"signal {-code}"
