"""sd_notify against real datagram sockets, by path and by abstract name, as systemd binds them."""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from servo_daemon.daemon.notify import Notifier, socket_address, watchdog_timeout_s

Receive = Callable[[], list[str]]


@pytest.fixture(params=["path", "abstract"])
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[dict[str, str], Receive]]:
    """A service manager's end: the environment it gives, and a call that returns the next message's lines."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        name = str(tmp_path / "notify") if request.param == "path" else f"@servo-daemon-test-{os.getpid()}"
        listener.bind(socket_address(name))
        listener.settimeout(5.0)
        yield {"NOTIFY_SOCKET": name}, lambda: listener.recv(4096).decode().split("\n")


def test_a_whole_life_arrives_message_by_message(manager: tuple[dict[str, str], Receive]) -> None:
    environ, receive = manager
    notifier = Notifier.from_environment(environ)
    notifier.ready("axis1 connected")
    notifier.watchdog()
    notifier.status("axis1 silent")
    notifier.stopping()
    assert [receive() for _ in range(4)] == [
        ["READY=1", "STATUS=axis1 connected"],
        ["WATCHDOG=1"],
        ["STATUS=axis1 silent"],
        ["STOPPING=1", "STATUS=stopping"],
    ]


def test_a_status_of_several_lines_cannot_smuggle_in_an_assignment(manager: tuple[dict[str, str], Receive]) -> None:
    environ, receive = manager
    Notifier.from_environment(environ).status("port lost\nSTOPPING=1\r\nµ ok")
    assert receive() == ["STATUS=port lost STOPPING=1 µ ok"]


@pytest.mark.parametrize("environ", [{}, {"NOTIFY_SOCKET": ""}])
def test_without_systemd_messages_go_nowhere(environ: dict[str, str], caplog: pytest.LogCaptureFixture) -> None:
    notifier = Notifier.from_environment({**environ, "WATCHDOG_USEC": "1000000"})
    notifier.ready("running")
    assert (notifier.address, notifier.watchdog_interval_s, caplog.records) == (None, None, [])


@pytest.mark.parametrize("text", ["relative/path", "@", "vsock:2:1234"])
def test_an_address_of_another_kind_is_told_and_not_used(text: str, caplog: pytest.LogCaptureFixture) -> None:
    assert Notifier.from_environment({"NOTIFY_SOCKET": text}).address is None
    assert text in caplog.text


def test_a_manager_that_is_gone_is_logged_once_and_a_new_one_is_found(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "notify"
    notifier = Notifier(str(path))
    with caplog.at_level(logging.WARNING):
        notifier.watchdog()
        notifier.watchdog()
    assert len(caplog.records) == 1
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(path))
        listener.settimeout(5.0)
        notifier.watchdog()
        assert listener.recv(64) == b"WATCHDOG=1"


def test_a_manager_that_does_not_read_holds_nobody_for_long(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("servo_daemon.daemon.notify.SEND_TIMEOUT_S", 0.01)
    path = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(path))
        filler = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        with filler:
            filler.setblocking(False)
            with pytest.raises(BlockingIOError):
                for _ in range(100_000):
                    filler.sendto(b"WATCHDOG=1", str(path))
        Notifier(str(path)).watchdog()  # returns: pytest's own timeout is the judge


@pytest.mark.parametrize(
    ("environ", "expected"),
    [
        ({"WATCHDOG_USEC": "10000000"}, 10.0),
        ({"WATCHDOG_USEC": "10000000", "WATCHDOG_PID": "42"}, 10.0),
        ({"WATCHDOG_USEC": "10000000", "WATCHDOG_PID": "43"}, None),
        ({"WATCHDOG_USEC": "0"}, None),
        ({"WATCHDOG_USEC": "soon"}, None),
        ({"WATCHDOG_USEC": "-5"}, None),
        ({"WATCHDOG_USEC": ""}, None),
        ({}, None),
    ],
)
def test_the_watchdog_is_for_the_process_it_names(environ: dict[str, str], expected: float | None) -> None:
    assert watchdog_timeout_s(environ, 42) == expected


def test_the_watchdog_is_fed_at_half_its_limit(tmp_path: Path) -> None:
    environ = {"NOTIFY_SOCKET": str(tmp_path / "n"), "WATCHDOG_USEC": "3000000", "WATCHDOG_PID": str(os.getpid())}
    assert Notifier.from_environment(environ).watchdog_interval_s == 1.5
