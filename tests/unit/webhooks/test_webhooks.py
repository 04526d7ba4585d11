"""Webhooks against a server on loopback."""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from email.message import Message
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from servo_daemon.config.sinks import WebhookConfig
from servo_daemon.errors import ConfigError
from servo_daemon.published.sinks import SinkState
from servo_daemon.webhooks import sink as module
from servo_daemon.webhooks.sink import WebhookSink
from tests.mosquitto import wait_for
from tests.unit.mqtt.rig import Drive


class Receiver(ThreadingHTTPServer):
    """Keeps requests; answers with what `answers` says, then 204."""

    def __init__(self, port: int = 0) -> None:
        super().__init__(("127.0.0.1", port), Handler)
        self.requests: list[tuple[Message, bytes]] = []
        self.answers: list[int] = []
        threading.Thread(target=self.serve_forever, args=(0.01,), daemon=True).start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}/hook"

    def close(self) -> None:
        self.shutdown()
        self.server_close()


class Handler(BaseHTTPRequestHandler):
    server: Receiver

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.server.requests.append((self.headers, body))
        self.send_response(self.server.answers.pop(0) if self.server.answers else 204)
        self.send_header("Location", "http://127.0.0.1:1/")
        self.end_headers()

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    receiver = Receiver()
    yield receiver
    receiver.close()


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_RETRY_S", (0.01, 0.05))
    monkeypatch.setattr(module, "_EVERY_S", 0.01)


@contextmanager
def sending(url: str, *drives: Drive, folder: Path | None = None, **keys: object) -> Iterator[WebhookSink]:
    sink = WebhookSink(WebhookConfig.model_validate({"url": url} | keys), "webhook_1", drives, folder)
    sink.start()
    try:
        yield sink
    finally:
        sink.stop(5.0)


def messages(receiver: Receiver) -> list[str]:
    return [json.loads(body)["message"] for _, body in receiver.requests]


def test_chosen_events_are_sent_and_signed(receiver: Receiver, tmp_path: Path) -> None:
    key = b"a key of some bytes"
    (tmp_path / "secret").write_text("whsec_" + base64.b64encode(key).decode() + "\n")
    one, two = Drive(), Drive("axis2")
    chosen = {"secret_file": str(tmp_path / "secret"), "kinds": ["alarm"], "drives": ["axis1"]}
    with sending(receiver.url, one, two, **chosen) as sink:
        two.log.add("alarm", "of another drive")
        one.log.add("speaking", "of another kind")
        one.log.add("alarm", "R ist zu groß", {"value": 1.5, "std": float("nan")})
        wait_for(lambda: sink.state.sent, "the event is sent")
    ((headers, body),) = receiver.requests
    event = json.loads(body)
    assert (event["drive"], event["kind"], event["message"]) == ("axis1", "alarm", "R ist zu groß")
    assert event["data"] == {"value": 1.5, "std": None}
    signed = f"{headers['webhook-id']}.{headers['webhook-timestamp']}.".encode() + body
    expected = base64.b64encode(hmac.new(key, signed, hashlib.sha256).digest()).decode()
    assert headers["webhook-signature"] == f"v1,{expected}"
    assert abs(int(headers["webhook-timestamp"]) - time.time()) < 60
    assert sink.state == SinkState("webhook_1", True, 0, 1)


def test_it_is_tried_again_under_the_same_id_until_it_is_taken(receiver: Receiver) -> None:
    drive = Drive()
    receiver.answers = [503, 429]
    with sending(receiver.url, drive) as sink:
        drive.log.add("alarm", "first")
        drive.log.add("alarm", "second")
        wait_for(lambda: sink.state.sent == 2, "both are sent")
    assert messages(receiver) == ["first", "first", "first", "second"]
    ids = [headers["webhook-id"] for headers, _ in receiver.requests]
    assert (len(set(ids[:3])), len(set(ids))) == (1, 2)
    assert (sink.state.reconnects, sink.state.dropped, sink.state.reason) == (1, 0, None)


@pytest.mark.parametrize("answer", [400, 302])  # 302: what is signed for one address goes to no other
def test_what_is_refused_is_dropped_and_counted(receiver: Receiver, answer: int) -> None:
    drive = Drive()
    receiver.answers = [answer]
    with sending(receiver.url, drive) as sink:
        drive.log.add("alarm", "first")
        drive.log.add("alarm", "second")
        wait_for(lambda: sink.state.sent == 1, "the second is sent")
    assert messages(receiver) == ["first", "second"]
    assert sink.state.dropped == 1


def test_what_waits_survives_a_restart(tmp_path: Path) -> None:
    away = Receiver()
    port, url = away.server_port, away.url
    away.close()
    drive = Drive()
    with sending(url, drive, folder=tmp_path) as sink:
        drive.log.add("alarm", "first")
        wait_for(lambda: sink.state.reason, "nobody is there")
        assert (sink.state.connected, sink.state.waiting) == (False, 1)
        drive.log.add("alarm", "second, at the end")
    receiver = Receiver(port)
    with sending(url, Drive(), folder=tmp_path) as sink:
        wait_for(lambda: sink.state.sent == 2, "both are sent")
    receiver.close()
    assert messages(receiver) == ["first", "second, at the end"]


@pytest.mark.parametrize(("text", "says"), [("", "is empty"), ("whsec_%", "no base64"), (None, "cannot be read")])
def test_a_secret_that_is_none_is_told_at_the_start(text: str | None, says: str, tmp_path: Path) -> None:
    if text is not None:
        (tmp_path / "secret").write_text(text)
    config = WebhookConfig(url="https://example.com/", secret_file=str(tmp_path / "secret"))
    with pytest.raises(ConfigError, match=f"secret_file .*{says}"):
        WebhookSink(config, "webhook_1", (), None)
