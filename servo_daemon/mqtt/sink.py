"""Everything `[mqtt]` asks for: collects what is new of the drives, and publishes it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from servo_daemon.background import Background
from servo_daemon.config.sinks import MqttConfig
from servo_daemon.disk_queue import DiskQueue
from servo_daemon.mqtt.encoding import Encoding
from servo_daemon.mqtt.home_assistant import Discovery
from servo_daemon.mqtt.link import Link
from servo_daemon.mqtt.outbox import Outbox
from servo_daemon.mqtt.plain import Plain
from servo_daemon.mqtt.report import Source, report_of
from servo_daemon.mqtt.sparkplug import Sparkplug
from servo_daemon.published.sinks import Followed, SinkState, event_body
from servo_daemon.published.snapshot import Snapshot

FILE: Final = "mqtt.sqlite"


class MqttSink(Background):
    """Two threads: this one reads what is published, `Link` has the network; no drive
    waits for either.

    Args:
        state_dir: where is kept what cannot be sent; None: in memory.

    Raises:
        ConfigError: an extra is not installed, or a file cannot be read.
    """

    def __init__(self, config: MqttConfig, sources: Sequence[Source], state_dir: Path | None) -> None:
        super().__init__("mqtt-collect")
        queue = DiskQueue(None if state_dir is None else state_dir / FILE, config.buffer_MB * 1e6)
        self._outbox = Outbox(queue)
        self._link = Link(config, f"servo-daemon-{config.node_name}", encoding_of(config), self._outbox)
        self._drives, self._interval_s = Followed(sources), config.interval_s
        self._told: dict[str, Snapshot] = {}

    @property
    def state(self) -> SinkState:
        link, queue = self._link, self._outbox.queue
        again = max(0, link.connections - 1)
        return SinkState(
            "mqtt", link.connected, len(queue), link.sent, queue.dropped, again, link.reason, queue.problem
        )

    def start(self) -> None:
        super().start()
        self._link.start()

    def follow(self, sources: Sequence[Source]) -> None:
        """These are the drives from now on."""
        self._drives.wanted = sources

    def begin_stop(self) -> None:
        """Ask both threads to end without waiting."""
        super().begin_stop()
        self._link.begin_stop()

    def stop(self, timeout_s: float) -> None:
        """End. Idempotent."""
        deadline = time.monotonic() + timeout_s
        super().stop(timeout_s)
        self._link.stop(max(0.05, deadline - time.monotonic()))
        self._outbox.flush()
        self._outbox.queue.close()

    def _run(self) -> None:
        self._go_round(lambda _: self.collect(time.time()), self._interval_s)

    def collect(self, now: float) -> None:
        """Take up what is new.

        Args:
            now: UTC seconds since the epoch.
        """
        for name, event in self._drives.take():
            self._outbox.keep_event(name, event_body(name, event))
        names = {source.name for source in self._drives.sources}
        for name in [name for name in self._told if name not in names]:
            del self._told[name]
            self._outbox.dismiss(name)
        reports = []
        for source in self._drives.sources:
            snapshot = source.snapshot()
            if self._told.get(source.name) is not snapshot:
                self._told[source.name] = snapshot
                reports.append(report_of(source, snapshot, now))
        self._outbox.offer(reports)


def encoding_of(config: MqttConfig) -> Encoding:
    """As configured.

    Raises:
        ConfigError: its extra is not installed.
    """
    prefix, node = config.topic_prefix, config.node_name
    if config.encoding == "sparkplug":
        return Sparkplug(config.group, node)
    discovery = Discovery(config.discovery_prefix, prefix, node) if config.home_assistant else None
    return Plain(prefix, discovery)
