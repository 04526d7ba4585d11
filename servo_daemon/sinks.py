"""Where estimates and events are sent to, as the configuration says."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from servo_daemon.config import Config
from servo_daemon.published.sinks import SinkState

if TYPE_CHECKING:
    from servo_daemon.mqtt.report import Source


class Sink(Protocol):
    """`start` and `stop` once each; `follow` takes other drives; `begin_stop` asks without waiting."""

    @property
    def state(self) -> SinkState: ...
    def start(self) -> None: ...
    def follow(self, sources: Sequence[Source]) -> None: ...
    def begin_stop(self) -> None: ...
    def stop(self, timeout_s: float) -> None: ...


def sinks_of(config: Config, drives: Sequence[Source], state_dir: Path | None) -> tuple[Sink, ...]:
    """None of them is started.

    Raises:
        ConfigError: an extra is not installed, or a file cannot be read.
    """
    found: list[Sink] = []
    if config.mqtt is not None:
        from servo_daemon.mqtt.sink import MqttSink

        found.append(MqttSink(config.mqtt, drives, state_dir))
    if config.webhook:
        from servo_daemon.webhooks.sink import WebhookSink

        found += [WebhookSink(hook, f"webhook_{n}", drives, state_dir) for n, hook in enumerate(config.webhook, 1)]
    return tuple(found)
