"""Sparkplug B (Eclipse Sparkplug 3.0): the daemon is an edge node, its drives are the devices.

A device is born when its drive delivers samples and dies when it does not. Only what changed is told (DDATA, by alias);
states from while the broker was away come as historical values. Events are metrics of the node, `event`, as JSON.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Final

from servo_daemon.disk_queue import Item
from servo_daemon.mqtt import sparkplug_payload as payload
from servo_daemon.mqtt.encoding import Message
from servo_daemon.mqtt.outbox import EVENT
from servo_daemon.mqtt.report import Report, event_time, report_from
from servo_daemon.mqtt.sparkplug_payload import BOOLEAN, DOUBLE, STRING, UINT64, Metric, Value

_REBIRTH: Final = "Node Control/Rebirth"
_BIRTHS: Final = "bdSeq"
_EVENT: Final = "event"
#: seq and bdSeq go from 0 to 255 and begin anew (6.4.4, 6.4.21).
_ROUND: Final = 256


class Sparkplug:
    """See `Encoding`. Everything but the will has QoS 0, as the specification demands.

    Args:
        group, node: of the topics.
        clock: UTC seconds since the epoch.
    """

    def __init__(self, group: str, node: str, clock: Callable[[], float] = time.time) -> None:
        self._group, self._node, self._clock = group, node, clock
        self._bd_seq, self._seq = -1, 0
        self._aliases: dict[str, dict[str, int]] = {}  # by device; "": the node's own
        self._latest: dict[str, Report] = {}
        self._told: dict[str, dict[str, Value]] = {}  # of devices that are alive: the last value of each metric
        payload.messages()  # an extra that is missing is told at the start

    @property
    def topics(self) -> Sequence[str]:
        return (self._topic("NCMD"),)

    def will(self) -> Message:
        self._bd_seq = (self._bd_seq + 1) % _ROUND
        return self._node_death()

    def birth(self, reports: Sequence[Report]) -> list[Message]:
        self._seq, self._told = 0, {}
        now = self._clock()
        node = [self._births(now), Metric(_REBIRTH, BOOLEAN, False, now), Metric(_EVENT, STRING, None, now)]
        aliases = self._aliases_of("", node[2:])  # the first two must have none
        born = self._message("NBIRTH", None, payload.encode(node, aliases, now, self._next(), birth=True))
        return [born, *(m for report in reports for m in self.state(report))]

    def state(self, report: Report) -> list[Message]:
        device, metrics = report.drive, metrics_of(report)
        self._latest[device] = report
        if report.connection != "connected":
            return self._device_death(device)
        told = self._told.get(device)
        if told is None or told.keys() != {m.name for m in metrics}:
            return [self._device_birth(report)]
        changed = [m for m in metrics if told[m.name] != m.value]
        told.update({m.name: m.value for m in changed})
        return [self._data(device, changed)] if changed else []

    def kept(self, item: Item) -> list[Message]:
        if item.kind == EVENT:
            event = Metric(_EVENT, STRING, item.body.decode("utf-8"), event_time(item.body))
            return [self._data(None, [event])]
        report = report_from(item.body)
        if report.connection != "connected":
            return []
        alive = item.drive in self._told
        born = [] if alive else [self._device_birth(self._latest.get(item.drive, report.unknown()))]
        metrics = [m for m in metrics_of(report) if m.name in self._told[item.drive] and m.value is not None]
        past = [self._data(item.drive, metrics, historical=True)] if metrics else []
        return [*born, *past, *([] if alive else self._device_death(item.drive))]

    def heard(self, topic: str, body: bytes) -> list[Message]:
        """A host application that has lost the thread asks for everything again."""
        asked = topic == self._topic("NCMD") and payload.is_true(body, _REBIRTH)
        return self.birth(list(self._latest.values())) if asked else []

    def gone(self, drive: str) -> list[Message]:
        self._latest.pop(drive, None)
        return self._device_death(drive)

    def death(self) -> list[Message]:
        return [*(m for device in list(self._told) for m in self._device_death(device)), self._node_death()]

    def _births(self, now: float) -> Metric:
        return Metric(_BIRTHS, UINT64, self._bd_seq, now)

    def _node_death(self) -> Message:
        now = self._clock()
        return Message(self._topic("NDEATH"), payload.encode([self._births(now)], {}, now), qos=1)

    def _device_birth(self, report: Report) -> Message:
        device, metrics = report.drive, metrics_of(report)
        self._told[device] = {m.name: m.value for m in metrics}
        aliases = self._aliases_of(device, metrics)
        body = payload.encode(metrics, aliases, self._clock(), self._next(), birth=True)
        return self._message("DBIRTH", device, body)

    def _device_death(self, device: str) -> list[Message]:
        """None of a device that is not alive."""
        if self._told.pop(device, None) is None:
            return []
        return [self._message("DDEATH", device, payload.encode([], {}, self._clock(), self._next()))]

    def _data(self, device: str | None, metrics: Sequence[Metric], *, historical: bool = False) -> Message:
        kind = "NDATA" if device is None else "DDATA"
        aliases, now = self._aliases[device or ""], self._clock()
        return self._message(kind, device, payload.encode(metrics, aliases, now, self._next(), historical=historical))

    def _aliases_of(self, device: str, metrics: Sequence[Metric]) -> dict[str, int]:
        """Numbers that no other metric of the node has; each keeps its own."""
        known = self._aliases.setdefault(device, {})
        for metric in metrics:
            if metric.name not in known:
                known[metric.name] = 1 + sum(map(len, self._aliases.values()))
        return known

    def _next(self) -> int:
        number, self._seq = self._seq, (self._seq + 1) % _ROUND
        return number

    def _topic(self, kind: str, device: str | None = None) -> str:
        return "/".join(("spBv1.0", self._group, kind, self._node, *([] if device is None else [device])))

    def _message(self, kind: str, device: str | None, body: bytes) -> Message:
        return Message(self._topic(kind, device), body, qos=0)


def metrics_of(report: Report) -> list[Metric]:
    """A drive's metrics, always in the same order."""
    t = report.time
    found = [Metric("connection", STRING, report.connection, t)]
    for p in report.parameters:
        unit = p.unit if p.unit != "1" else None
        found.append(Metric(f"parameters/{p.name}/value", DOUBLE, p.value, t, unit))
        found.append(Metric(f"parameters/{p.name}/std", DOUBLE, p.std, t, unit))
        found.append(Metric(f"parameters/{p.name}/status", STRING, p.status, t))
    found += [Metric(f"state/{name}", DOUBLE, value, t) for name, value in report.state.items()]
    found += [Metric(f"alarms/{name}", BOOLEAN, rings, t) for name, rings in report.alarms.items()]
    return found
