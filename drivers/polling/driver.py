"""The base of drivers that ask: a subclass says over which link, what, and what the answers mean."""

from __future__ import annotations

import threading
import time
from abc import abstractmethod
from typing import Any, Generic

from drivers.base import Driver, disconnected
from drivers.polling.link import Link
from drivers.polling.poller import Answer, Dialogue, Pace, Poller, V
from servo_daemon.samples import SampleBlock

#: Answers are gathered so long after the first: what comes after a block costs the same for one sample as for ten.
GATHER_S = 0.1


class PollingDriver(Driver, Generic[V]):
    """One drive that answers requests. `read` asks while it waits; nothing is asked between reads."""

    def __init__(self, name: str, options: dict[str, Any]) -> None:
        super().__init__(name, options)
        self._link: Link | None = None
        self._poller: Poller[V] | None = None
        self._io = threading.Lock()  # held by whoever uses the link: `close` waits for `read` to leave it

    @property
    @abstractmethod
    def _pace(self) -> Pace:
        """Hook: how often, how many together, how patiently."""

    @abstractmethod
    def _open_link(self) -> Link:
        """Hook: the line, as `open` raises."""

    @abstractmethod
    def _new_dialogue(self) -> Dialogue[V]:
        """Hook: what is asked, from the beginning: another device may have been attached."""

    @abstractmethod
    def _samples(self, answers: list[Answer[V]]) -> SampleBlock | None:
        """Hook: the block of these answers, at least one; None where they hold no sample."""

    def _open(self) -> None:
        self._link = self._open_link()
        self._poller = Poller(self._link, self._new_dialogue(), self._pace, self.counters.extra)

    def _read(self, timeout_s: float) -> SampleBlock | None:
        until_s = time.monotonic() + max(timeout_s, 0.0)
        answers: list[Answer[V]] = []
        with self._io:
            poller = self._poller
            while self._is_open and poller is not None:
                try:
                    fresh = poller.step(until_s)
                except OSError as error:  # SerialException is one
                    raise disconnected(self.name, error) from error
                if fresh and not answers:
                    until_s = min(until_s, fresh[0].received_s + GATHER_S)
                answers += fresh
                if not fresh and time.monotonic() >= until_s:
                    return self._samples(answers) if answers else None
        return None

    def _close(self) -> None:
        link, self._link = self._link, None
        if link is None:
            return
        link.wake()
        with self._io:
            self._poller = None
            link.close()
