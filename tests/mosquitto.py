"""A real MQTT broker on loopback, and a client that listens to it."""

from __future__ import annotations

import getpass
import socket
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import paho.mqtt.client as mqtt
from paho.mqtt.enums import CallbackAPIVersion

T = TypeVar("T")
HOST = "127.0.0.1"
PATIENCE_S = 30.0


def wait_for(probe: Callable[[], T | None], what: str) -> T:
    """The first answer of `probe` that is true; fails when there is none in time."""
    deadline = time.monotonic() + PATIENCE_S
    while not (answer := probe()):
        assert time.monotonic() < deadline, f"not within {PATIENCE_S:g} s: {what}"
        time.sleep(0.01)
    return answer


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind((HOST, 0))
        return int(listener.getsockname()[1])


class Broker:
    """Debian's mosquitto with a configuration of its own. Keeps nothing over a restart.

    Args:
        program: its path.
        lines: of the configuration, after the listener.
    """

    def __init__(self, program: str, folder: Path, *lines: str) -> None:
        self.port = free_port()
        self._config = folder / f"mosquitto-{self.port}.conf"
        general = [f"user {getpass.getuser()}", f"listener {self.port} {HOST}", *(lines or ["allow_anonymous true"])]
        self._config.write_text("\n".join(general) + "\n", encoding="utf-8")
        self._program, self._process = program, None

    _process: subprocess.Popen[bytes] | None

    def start(self) -> None:
        """Does nothing while it runs."""
        if self._process is not None:
            return
        command = [self._program, "-c", str(self._config)]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        wait_for(self._answers, "mosquitto listens")

    def kill(self) -> None:
        """As a power cut does."""
        if self._process is not None:
            self._process.kill()
            self._process.wait(PATIENCE_S)
            self._process = None

    def _answers(self) -> bool:
        assert self._process is not None
        assert self._process.poll() is None, "mosquitto has ended"
        with socket.socket() as line:
            return line.connect_ex((HOST, self.port)) == 0


class Listener:
    """A client that keeps what it hears, in order: (topic, payload, retained).

    Args:
        prepare: called with paho's client before it connects.
    """

    def __init__(self, port: int, topic: str = "#", prepare: Callable[[mqtt.Client], Any] | None = None) -> None:
        self.heard: list[tuple[str, bytes, bool]] = []
        self._subscribed = threading.Event()
        self._topic = topic
        self.client = mqtt.Client(CallbackAPIVersion.VERSION2)
        self.client.reconnect_delay_set(0.05, 0.1)  # type: ignore[arg-type]
        if prepare is not None:
            prepare(self.client)
        self.client.on_connect = lambda *_: self.client.subscribe(self._topic, 1)
        self.client.on_subscribe = lambda *_: self._subscribed.set()
        self.client.on_message = lambda _c, _d, m: self.heard.append((m.topic, m.payload, m.retain))
        self.client.connect(HOST, port)
        self.client.loop_start()

    def __enter__(self) -> Listener:
        assert self._subscribed.wait(PATIENCE_S)
        return self

    def __exit__(self, *_: object) -> None:
        self.client.disconnect()
        self.client.loop_stop()

    def forget(self) -> None:
        """What was heard; and a new subscription is waited for."""
        self.heard.clear()
        self._subscribed.clear()

    def resubscribed(self) -> None:
        assert self._subscribed.wait(PATIENCE_S)

    def of(self, topic: str) -> list[bytes]:
        """What came on a topic so far."""
        return [payload for t, payload, _ in list(self.heard) if t == topic]

    def wait(self, topic: str, count: int = 1) -> list[bytes]:
        """The first messages of a topic."""
        wait_for(lambda: len(self.of(topic)) >= count, f"{count} messages on {topic}: {len(self.of(topic))} came")
        return self.of(topic)
