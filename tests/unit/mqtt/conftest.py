"""One broker a file."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

import pytest

from servo_daemon.mqtt import link
from tests.mosquitto import PATIENCE_S, Broker


@pytest.fixture(scope="module")
def only_broker(program: Callable[..., str], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Broker]:
    broker = Broker(program("mosquitto", "/usr/sbin/mosquitto"), tmp_path_factory.mktemp("broker"))
    yield broker
    broker.kill()


@pytest.fixture
def broker(only_broker: Broker) -> Broker:
    """It runs."""
    only_broker.start()
    return only_broker


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Attempts follow each other quickly."""
    monkeypatch.setattr(link, "_RETRY_S", (0.02, 0.1))


class Gate:
    """Attempts to connect wait while it is shut."""

    def __init__(self) -> None:
        self._open, self._waiting = threading.Event(), threading.Event()
        self._open.set()

    def shut(self) -> None:
        """Returns when the next attempt waits."""
        self._open.clear()
        assert self._waiting.wait(PATIENCE_S)

    def open(self) -> None:
        self._open.set()

    def passing(self) -> None:
        if not self._open.is_set():
            self._waiting.set()
            assert self._open.wait(PATIENCE_S)
            self._waiting.clear()


@pytest.fixture
def gate(monkeypatch: pytest.MonkeyPatch) -> Gate:
    """So that a listener is back at a broker before the messages come that were kept for it."""
    gate, session = Gate(), link.Link._session

    def attempt(self: link.Link) -> None:
        gate.passing()
        session(self)

    monkeypatch.setattr(link.Link, "_session", attempt)
    return gate
