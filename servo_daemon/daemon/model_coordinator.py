"""Requests for another model, one at a time: prepared in a thread of their own, carried out by the worker.

Compiling a plant that this machine has not seen yet takes up to ten seconds, in which samples must go on being worked
off. So the caller gets a future at once, a thread of the coordinator makes the tracker, and the worker takes it from
there between two blocks (`Pipeline.change_model`).
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field

from servo_daemon.config import DriveConfig
from servo_daemon.errors import BusyError, ServoDaemonError
from servo_daemon.pipeline.model_change import ModelRequest
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.published.view import ModelChange
from servo_daemon.tracking.tracker import Tracker

log = logging.getLogger(__name__)


@dataclass(slots=True)
class Pending:
    """A change that was asked for.

    Attributes:
        config: the drive's with that model.
        tracker: made for the channels of the moment; None: not made.
        ready: the worker may begin.
    """

    request: ModelRequest
    config: DriveConfig
    future: Future[ModelChange] = field(default_factory=Future)
    tracker: Tracker | None = None
    ready: bool = False
    begun: bool = False


class ModelCoordinator:
    """Carries out one drive's requests for another model.

    Args:
        wake: called when there is work for the worker.
    """

    def __init__(self, drive: str, wake: Callable[[], None]) -> None:
        self._drive, self._wake = drive, wake
        self._lock = threading.Lock()
        self._pending: Pending | None = None

    def ask(self, request: ModelRequest, config: DriveConfig, pipeline: Pipeline | None) -> Future[ModelChange]:
        """Have it done. The future gives the change when the first estimate of the new model is published.

        Args:
            config: the drive's with that model.
            pipeline: whose model it is to be; None: there have been no samples yet.

        Raises:
            BusyError: the last one is not done yet.
        """
        with self._lock:
            if self._pending is not None:
                raise BusyError("another change of this drive's model is under way")
            self._pending = pending = Pending(request, config)
        threading.Thread(
            target=self._prepare, args=(pending, pipeline), name=f"model-{self._drive}", daemon=True
        ).start()
        return pending.future

    def _prepare(self, pending: Pending, pipeline: Pipeline | None) -> None:
        try:
            if pipeline is not None:
                pending.tracker = pipeline.prepare(pending.config)
        except ServoDaemonError as error:
            self._end(pending, error)
            return
        except Exception as error:  # a plant that cannot be built must not leave the coordinator closed for ever
            log.exception("drive %s: the model cannot be made", self._drive)
            self._end(pending, ServoDaemonError(f"the model cannot be made: {error}"))
            return
        pending.ready = True
        self._wake()

    # -- worker thread ---------------------------------------------------------------------------------------

    def take(self) -> Pending | None:
        """The change to begin now, once."""
        pending = self._pending
        if pending is None or not pending.ready or pending.begun:
            return None
        pending.begun = True
        return pending

    def done(self, time_s: float | None) -> None:
        """The model is exchanged.

        Args:
            time_s: of the first estimate, UTC; None: there are no samples yet.
        """
        pending = self._pending
        if pending is not None and pending.begun:
            change = ModelChange(pending.config.model, time_s)
            self._end(pending, None, change)

    def fail(self, why: str) -> None:
        """A change that was begun will not be done."""
        pending = self._pending
        if pending is not None and pending.begun:
            self._end(pending, ServoDaemonError(why))

    def _end(self, pending: Pending, error: ServoDaemonError | None, change: ModelChange | None = None) -> None:
        with self._lock:
            if self._pending is pending:
                self._pending = None
        if not pending.future.set_running_or_notify_cancel():
            return
        if error is not None:
            pending.future.set_exception(error)
        elif change is not None:
            pending.future.set_result(change)
