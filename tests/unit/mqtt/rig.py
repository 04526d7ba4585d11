"""Drives to publish from, and the sink that does it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from servo_daemon.config.sinks import MqttConfig
from servo_daemon.mqtt.sink import MqttSink
from servo_daemon.pipeline.event_log import EventLog
from tests.fake_daemon import FakeDrive, make_snapshot
from tests.mosquitto import HOST, Broker


@dataclass
class Drive(FakeDrive):
    """One that has samples."""

    log: EventLog = field(init=False)  # type: ignore[assignment]

    def __post_init__(self) -> None:
        self.log = EventLog(self.name)
        self.publish(make_snapshot(self.name))


@contextmanager
def publishing(
    broker: Broker, drives: Sequence[Drive], folder: Path | None = None, **keys: object
) -> Iterator[MqttSink]:
    """A sink that is connected or tries to be."""
    config = MqttConfig.model_validate({"host": HOST, "port": broker.port, "node": "n1", "interval_s": 0.1} | keys)
    sink = MqttSink(config, drives, folder)
    sink.start()
    try:
        yield sink
    finally:
        sink.stop(5.0)
