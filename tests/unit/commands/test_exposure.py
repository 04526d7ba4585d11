"""Files of `[api]` that the daemon follows while it runs, and those that systemd hands to it."""

from __future__ import annotations

import socket
import ssl
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from servo_daemon.api.access.tokens import new_token
from servo_daemon.commands.shared.exposure import ServedCertificate, check_exposure, known_tokens
from servo_daemon.config import ApiConfig
from servo_daemon.errors import ConfigError
from tests.certificates import make_certificate


def seen_by_a_new_client(context: ssl.SSLContext) -> str:
    """The certificate that a server with this context shows on the loopback interface, PEM."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def answer() -> None:
            with listener.accept()[0] as line, context.wrap_socket(line, server_side=True):
                pass

        server = threading.Thread(target=answer)
        server.start()
        seen = ssl.get_server_certificate(listener.getsockname()[:2], timeout=30)
        server.join(30)
        return seen


def test_new_connections_see_the_certificate_of_now(
    tmp_path: Path, program: Callable[..., str], caplog: pytest.LogCaptureFixture
) -> None:
    openssl = program("openssl")
    files = make_certificate(openssl, tmp_path, "first")
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(*files)
    served = ServedCertificate(context, files)
    first = files[0].read_text()
    assert seen_by_a_new_client(context) == first
    make_certificate(openssl, tmp_path, "second")
    assert seen_by_a_new_client(context) == first, "nobody has looked yet"
    served.look()
    second = files[0].read_text()
    assert seen_by_a_new_client(context) == second != first
    (tmp_path / "other").mkdir()
    other = make_certificate(openssl, tmp_path / "other", "third")
    served.look(other)
    assert seen_by_a_new_client(context) == other[0].read_text()
    served.look((other[0], files[1]))
    assert "stays as it was" in caplog.text and seen_by_a_new_client(context) == other[0].read_text()


def test_credentials_of_systemd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    token, secret = new_token("a", "read")
    (tmp_path / "mine").write_text(token.line)
    api = ApiConfig(tokens_file="credential:mine")
    monkeypatch.delenv("CREDENTIALS_DIRECTORY", raising=False)
    with pytest.raises(ConfigError, match="LoadCredential"):
        known_tokens(api)
    assert known_tokens(ApiConfig()) is None
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path))
    tokens = known_tokens(api)
    assert tokens is not None and tokens.find(f"Bearer {secret}") == token
    assert known_tokens(ApiConfig()) is None, "a credential of another name is nobody's tokens"
    for wrong in ("credential:other", "credential:../mine", "credential:"):
        with pytest.raises(ConfigError, match="no such credential; there are: mine"):
            known_tokens(ApiConfig(tokens_file=wrong))
    (tmp_path / "mine").rename(tmp_path / "servo-daemon.tokens")
    assert known_tokens(ApiConfig()) is not None
    check_exposure("0.0.0.0", ApiConfig())
    with pytest.raises(ConfigError, match=r"\[api\] certificate"):
        check_exposure("127.0.0.1", ApiConfig(certificate="credential:crt", private_key="credential:key"))
