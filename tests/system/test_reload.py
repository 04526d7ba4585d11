"""SIGHUP makes the real program read its configuration again; in a terminal it ends it."""

from __future__ import annotations

import os
import signal
import ssl
from collections.abc import Callable
from pathlib import Path

import httpx
import pytest

from servo_daemon.api.access.tokens import new_token
from tests.certificates import make_certificate
from tests.system.harness import STOP_S, daemon, environment, nominal_table, wait_for, write_config

pytestmark = pytest.mark.slow


def test_everything_is_read_again(tmp_path: Path, program: Callable[..., str]) -> None:
    """Drives, tokens, certificate and limits change; the port needs a restart; a broken file changes nothing."""
    openssl = program("openssl")
    files = make_certificate(openssl, tmp_path, "first")
    tokens = {name: new_token(name, "read") for name in ("first", "second")}
    (tmp_path / "tokens").write_text(tokens["first"][0].line)
    drop_ins = tmp_path / "conf.d"
    drop_ins.mkdir()
    head = (
        f'[api]\nport = 1\ntokens_file = "credential:tokens"\ncertificate = "{files[0]}"\nprivate_key = "{files[1]}"\n'
    )
    drive = f'name = "a"\n{nominal_table()}'
    config = write_config(tmp_path / "c.toml", drive, head=head)
    env = environment(CREDENTIALS_DIRECTORY=str(tmp_path))
    with daemon("--config", config, "--state-dir", tmp_path / "state", env=env) as running:
        address = httpx.URL(running.url)

        def shown() -> str:
            return ssl.get_server_certificate((address.host, address.port or 443))

        def asked(name: str, path: str = "/drives") -> httpx.Response:
            return running.client.get(f"/api/v1{path}", headers={"Authorization": f"Bearer {tokens[name][1]}"})

        assert shown() == files[0].read_text() and asked("first").status_code == 200
        make_certificate(openssl, tmp_path, "second")
        (tmp_path / "tokens").write_text(tokens["second"][0].line)
        (drop_ins / "b.toml").write_text(f'[history]\nquota_MB = 100.0\n[[drive]]\nname = "b"\n{nominal_table()}')
        write_config(config, drive + "[drive.limits]\nR_max = 0.1\n", head=head)
        running.send(signal.SIGHUP)
        wait_for(lambda: running.said("tls.crt: read again"), "the certificate is read again")
        assert shown() == files[0].read_text()
        assert asked("first").status_code == 401
        assert [d["name"] for d in asked("second").json()["drives"]] == ["a", "b"]
        for line in ("drive a: limits.R_max: absent → 0.1", "drive b: new, with driver simulated"):
            assert running.said(f"INFO reload: {line}") == 1
        assert running.said("WARNING reload: history.quota_MB: 2000.0 → 100.0: needs a restart") == 1
        wait_for(
            lambda: asked("second", "/drives/b/estimates").json()["health"]["samples"] > 0, "the new drive has samples"
        )
        events = asked("second", "/drives/a/events").json()["events"]
        assert "limits.R_max" in next(e["message"] for e in events if e["kind"] == "reloaded")
        (drop_ins / "c.toml").write_text("[api]\nprot = 1\n[[drive]]\nname = 'c'")
        running.send(signal.SIGHUP)
        refused = (
            f"reload refused, the configuration stays as it was: {drop_ins}/c.toml: unknown key 'api.prot', line 2"
        )
        wait_for(lambda: running.said(refused), "the broken file is refused")
        assert [d["name"] for d in asked("second").json()["drives"]] == ["a", "b"]
        (drop_ins / "c.toml").unlink()
        (drop_ins / "b.toml").unlink()
        running.send(signal.SIGHUP)
        wait_for(lambda: running.said("drive b: removed"), "a drive goes")
        assert asked("second", "/drives/b").status_code == 404
        assert running.stop() < STOP_S, running.log


def test_the_end_of_its_terminal_is_its_own(tmp_path: Path) -> None:
    master, terminal = os.openpty()
    try:
        with daemon("--state-dir", tmp_path, stdin=terminal) as running:
            assert running.stop(signal.SIGHUP) < STOP_S
            assert running.said("SIGHUP: stopping") == 1
    finally:
        os.close(master)
        os.close(terminal)
