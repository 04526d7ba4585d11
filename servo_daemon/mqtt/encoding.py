"""What an encoding has to answer: which messages tell of what happened."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from servo_daemon.disk_queue import Item
from servo_daemon.mqtt.report import Report


@dataclass(frozen=True, slots=True)
class Message:
    """A message to be published."""

    topic: str
    payload: bytes
    qos: int = 1
    retain: bool = False


class Encoding(Protocol):
    """Messages for what is told. Called by one thread, never while there is no connection but for `will`.

    What is kept in the queue has kind "state" (a body as `Report.body`) or "event" (one as `event_body`).
    """

    @property
    def topics(self) -> Sequence[str]:
        """Topics to subscribe to."""

    def will(self) -> Message:
        """What the broker tells when this connection is lost. A new connection begins."""

    def birth(self, reports: Sequence[Report]) -> list[Message]:
        """After the connection stands: all that is known."""

    def state(self, report: Report) -> list[Message]:
        """The messages of a drive's new state."""

    def kept(self, item: Item) -> list[Message]:
        """An event, or a state of the time in which there was no connection."""

    def heard(self, topic: str, payload: bytes) -> list[Message]:
        """The answer to what came on one of the topics."""

    def gone(self, drive: str) -> list[Message]:
        """There is no such drive any more."""

    def death(self) -> list[Message]:
        """Before the connection is closed."""
