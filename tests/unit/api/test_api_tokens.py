"""Who may ask for what, by token; and who has changed something stands in the log."""

from __future__ import annotations

import base64
import logging
import os
from pathlib import Path

import pytest

from servo_daemon import cli
from servo_daemon.api.access.permission import Access
from servo_daemon.api.access.tokens import SCOPES, TokenFile, new_token
from servo_daemon.api.app import create_app
from servo_daemon.commands.shared.exposure import check_exposure
from servo_daemon.config import ApiConfig
from servo_daemon.errors import BadInputError, ConfigError
from tests.fake_daemon import FakeDaemon, fake_daemon
from tests.http_rig import Client
from tests.unit.api.test_api_problems import AXIS1, problem


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "tokens"


def called(*words: str) -> None:
    arguments = cli._parser().parse_args(["token", *words])
    assert arguments.run(arguments) == 0


def made(file: Path, name: str, scope: str, capsys: pytest.CaptureFixture[str]) -> str:
    """The secret, as the command prints it."""
    called("new", name, "--scope", scope, "--file", str(file))
    return capsys.readouterr().out.strip()


def bearer(secret: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {secret}"}


def test_a_token_allows_what_its_scope_says(
    file: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    secrets = [made(file, scope, scope, capsys) for scope in SCOPES]
    assert not any(secret in file.read_text() for secret in secrets), "only hashes are kept"
    daemon = fake_daemon()
    client = Client(create_app(daemon, Access(TokenFile(file))))
    wanted = (("GET", AXIS1 + "/estimates"), ("POST", AXIS1 + "/reset"), ("POST", AXIS1 + "/model"))
    caplog.set_level(logging.INFO, "servo_daemon.audit")
    for holder, secret in enumerate(secrets):
        for needed, (method, path) in enumerate(wanted):
            response = client.request(method, path, headers=bearer(secret))
            assert (response.status_code == 403) == (needed > holder), (holder, path)
    assert daemon.drives["axis1"].resets == 2
    lines = [r.getMessage() for r in caplog.records if r.name == "servo_daemon.audit"]
    assert f"read from 127.0.0.1: POST {AXIS1}/reset: 403" in lines
    assert f"operate from 127.0.0.1: POST {AXIS1}/reset: 202" in lines
    assert not any(secret in line for secret in secrets for line in lines) and len(lines) == 6


@pytest.mark.parametrize("path", ["/", "/metrics", "/openapi.json", AXIS1 + "/estimates", "/assets/none.js", "/none"])
def test_without_a_token_there_is_nothing(file: Path, path: str) -> None:
    token, secret = new_token("a", "read")
    file.write_text(token.line)
    client = Client(create_app(fake_daemon(), Access(TokenFile(file))))
    for headers in ({}, bearer(secret[:-1]), bearer("é"), {"Authorization": "Basic !"}, bearer(token.sha256)):
        response = client.get(path, headers={k: v.encode() for k, v in headers.items()})
        assert problem(response, 401)["code"] == "no_token"
        assert response.headers["www-authenticate"].startswith("Basic ")
    basic = "Basic " + base64.b64encode(f"me:{secret}".encode()).decode()
    assert client.get(path, headers={"Authorization": basic}).status_code in (200, 404), "as a browser asks"


def test_metrics_may_be_open(file: Path) -> None:
    file.write_text(new_token("a", "read")[0].line)
    client = Client(create_app(fake_daemon(), Access(TokenFile(file), open_metrics=True)))
    assert client.get("/metrics").status_code == 200
    assert client.get("/api/v1/drives").status_code == 401


def test_a_token_that_is_taken_back_is_none_at_once(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    secret = made(file, "a", "read", capsys)
    made(file, "b", "read", capsys)
    tokens = TokenFile(file)
    assert tokens.find(f"Bearer {secret}") is not None
    called("revoke", "a", "--file", str(file))
    assert tokens.find(f"Bearer {secret}") is None
    called("list", "--file", str(file))
    assert capsys.readouterr().out == "b read\n"
    with pytest.raises(BadInputError, match="revoke it first"):
        called("new", "b", "--file", str(file))


@pytest.mark.skipif(os.name != "posix", reason="modes are POSIX")
def test_a_file_that_is_wrong_is_refused_and_later_kept_out(file: Path, caplog: pytest.LogCaptureFixture) -> None:
    token, secret = new_token("a", "read")
    file.write_text(token.line + "b admin 12\n")
    with pytest.raises(ConfigError, match="line 2"):
        TokenFile(file)
    file.write_text(token.line)
    file.chmod(0o666)
    with pytest.raises(ConfigError, match="may write it"):
        TokenFile(file)
    file.chmod(0o600)
    tokens = TokenFile(file)
    file.write_text("nonsense\n")
    assert tokens.find(f"Bearer {secret}") is not None
    assert "stay as they were" in caplog.text


def test_a_network_is_not_listened_to_by_accident(file: Path) -> None:
    for address in ("127.0.0.1", "::1", "127.8.0.1"):
        check_exposure(address, ApiConfig())
    for address in ("0.0.0.0", "192.168.1.5", "::", "fe80::1%eth0"):
        with pytest.raises(ConfigError, match="tokens_file"):
            check_exposure(address, ApiConfig())
        check_exposure(address, ApiConfig(behind_proxy=True))
    file.write_text(new_token("a", "read")[0].line)
    check_exposure("0.0.0.0", ApiConfig(tokens_file=str(file)))
    with pytest.raises(ConfigError, match="cannot be read"):
        check_exposure("127.0.0.1", ApiConfig(tokens_file=str(file) + "x"))
    with pytest.raises(ConfigError, match="certificate"):
        check_exposure("127.0.0.1", ApiConfig(certificate=str(file), private_key=str(file)))


def test_without_tokens_everybody_is_let_in_and_told(caplog: pytest.LogCaptureFixture) -> None:
    daemon: FakeDaemon = fake_daemon()
    caplog.set_level(logging.INFO, "servo_daemon.audit")
    assert Client(create_app(daemon)).post(AXIS1 + "/reset").status_code == 202
    assert f"anybody from 127.0.0.1: POST {AXIS1}/reset: 202" in caplog.text
