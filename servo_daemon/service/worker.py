"""The thread of one drive's pipeline.

Each drive has one: whatever takes long for one drive (a plant that is compiled, the first samples gone over again, a
slow engine) takes that drive's time. Compiled code and CasADi release the interpreter, and plain Python gives it up
every few milliseconds, so that the others turn meanwhile.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from servo_daemon.service.drive import DriveRuntime

#: Without any block it turns all the same, to see that a drive has fallen silent and to carry out requests, s.
_IDLE_TURN_S = 0.1
#: A worker that has not turned for this long is a problem the API reports, s.
STUCK_S = 5.0


class Worker(threading.Thread):
    """See the module.

    Args:
        runtime: the drive.
        wake: set when there is work.
        stop: set when it is to end.
        save_interval_s: between two times that what was learned is laid out to be saved.
        save: called then.

    Attributes:
        turned: when it last did, host monotonic, s.
        has_worked: samples have been worked off.
    """

    def __init__(
        self,
        runtime: DriveRuntime,
        wake: threading.Event,
        stop: threading.Event,
        save_interval_s: float,
        save: Callable[[], None],
    ) -> None:
        super().__init__(name=f"pipeline-{runtime.name}", daemon=True)
        self.runtime = runtime
        self._wake, self._end = wake, stop
        self._save_interval_s, self._save = save_interval_s, save
        self.turned, self.has_worked = time.monotonic(), False

    def wake(self) -> None:
        self._wake.set()

    def has_turned_since(self, then_s: float) -> bool:
        """Whether it has turned, or makes an estimator, which may take ten seconds.

        Args:
            then_s: host monotonic.
        """
        return self.turned >= then_s or self.runtime.preparing

    @property
    def problem(self) -> str | None:
        """What is wrong with it, in words."""
        since_s = time.monotonic() - self.turned
        if self.ident is None or since_s <= STUCK_S or self.runtime.preparing:
            return None
        return f"drive {self.runtime.name}: the pipeline has not turned for {since_s:.0f} s"

    def run(self) -> None:
        next_save = time.monotonic()
        while not self._end.is_set():
            self._wake.wait(_IDLE_TURN_S)
            self._wake.clear()
            self.has_worked |= self.runtime.work()
            if self.runtime.reader.queue.samples:
                self._wake.set()
            self.turned = time.monotonic()
            if self.turned >= next_save:
                next_save = self.turned + self._save_interval_s
                self._offer()
        self._offer()

    def _offer(self) -> None:
        """The pipeline belongs to this thread; writing to a disk that may be slow does not."""
        self.runtime.offer_state()
        self._save()
