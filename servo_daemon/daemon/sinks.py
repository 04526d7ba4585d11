"""Where estimates and events are sent to, as the configuration says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from servo_daemon.config import Config
from servo_daemon.published.sinks import SinkState

if TYPE_CHECKING:
    from servo_daemon.daemon.drive import DriveRuntime


class Sink(Protocol):
    """`start` and `stop` once each; `begin_stop` asks without waiting. After `stop` `seen` has the number of each
    drive's first event that is not taken up."""

    @property
    def seen(self) -> Mapping[str, int]: ...
    @property
    def state(self) -> SinkState: ...
    def start(self) -> None: ...
    def begin_stop(self) -> None: ...
    def stop(self, timeout_s: float) -> None: ...


def sinks_of(
    config: Config,
    drives: Sequence[DriveRuntime],
    state_dir: Path | None,
    seen: Mapping[str, int] | None = None,
    before: Sequence[Sink] = (),
) -> tuple[Sink, ...]:
    """None of them is started.

    Args:
        seen: of these drives only events from this number on are sent, or those that a predecessor has not taken up.
        before: the predecessors, stopped.

    Raises:
        ConfigError: an extra is not installed, or a file cannot be read.
    """
    found: list[Sink] = []
    last = {sink.state.name: sink.seen for sink in before}

    def first(name: str) -> dict[str, int]:
        return {drive: last.get(name, {}).get(drive, number) for drive, number in (seen or {}).items()}

    if config.mqtt is not None:
        from servo_daemon.mqtt.sink import MqttSink

        found.append(MqttSink(config.mqtt, drives, state_dir, first("mqtt")))
    if config.webhook:
        from servo_daemon.webhooks.sink import WebhookSink

        for number, hook in enumerate(config.webhook, 1):
            name = f"webhook_{number}"
            found.append(WebhookSink(hook, name, drives, state_dir, first(name)))
    return tuple(found)
