"""JSON topics.

<prefix>/status           "online" or "offline" (last will), retained
<prefix>/<drive>/state    a drive's state, retained
<prefix>/<drive>/event    events, each once at least
<prefix>/<drive>/history  states from while the broker was away: apart, so that none is taken for the present
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from servo_daemon.disk_queue import Item
from servo_daemon.mqtt.encoding import Message
from servo_daemon.mqtt.home_assistant import Discovery
from servo_daemon.mqtt.report import Report

ONLINE: Final = b"online"
OFFLINE: Final = b"offline"
#: The last level of the topic, by what is kept.
_KEPT: Final = {"event": "event", "state": "history"}


class Plain:
    """See `Encoding`.

    Args:
        discovery: None: Home Assistant is not told what there is.
    """

    def __init__(self, prefix: str, discovery: Discovery | None) -> None:
        self._prefix, self._discovery = prefix, discovery

    @property
    def topics(self) -> Sequence[str]:
        return () if self._discovery is None else (self._discovery.topics,)

    def will(self) -> Message:
        return self._status(OFFLINE)

    def birth(self, reports: Sequence[Report]) -> list[Message]:
        told = [m for report in reports for m in self._state(report, True)]
        return [*told, self._status(ONLINE)]

    def state(self, report: Report) -> list[Message]:
        return self._state(report, False)

    def kept(self, item: Item) -> list[Message]:
        return [Message(f"{self._prefix}/{item.drive}/{_KEPT[item.kind]}", item.body)]

    def heard(self, topic: str, payload: bytes) -> list[Message]:
        return [] if self._discovery is None else self._discovery.heard(topic, payload)

    def gone(self, drive: str) -> list[Message]:
        forgotten = [] if self._discovery is None else self._discovery.gone(drive)
        return [*forgotten, Message(f"{self._prefix}/{drive}/state", b"", retain=True)]

    def death(self) -> list[Message]:
        return [self._status(OFFLINE)]

    def _status(self, payload: bytes) -> Message:
        return Message(f"{self._prefix}/status", payload, retain=True)

    def _state(self, report: Report, again: bool) -> list[Message]:
        discovered = [] if self._discovery is None else self._discovery.of(report, again)
        return [*discovered, Message(f"{self._prefix}/{report.drive}/state", report.body(), retain=True)]
