"""`[mqtt]` and `[[webhook]]`: what is wrong is told in one line, and the examples hold."""

from __future__ import annotations

import argparse
import re
import sys
import tomllib
from pathlib import Path

import pytest

from servo_daemon.commands import check
from servo_daemon.config import parse_config
from servo_daemon.errors import ConfigError
from servo_daemon.mqtt import sparkplug_payload
from servo_daemon.mqtt.sink import MqttSink


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('[mqtt]\nhots = "b"', r"unknown key 'mqtt\.hots', line 2 \(did you mean 'host'\?\)"),
        ('[mqtt]\nhost = "b"\npassword_file = "p"', "mqtt: 'password_file' needs 'username'"),
        ('[mqtt]\nhost = "b"\nca_file = "c"', "mqtt: 'ca_file' and 'certificate' need tls = true"),
        ('[mqtt]\nhost = "b"\nprefix = "servo/#"', r"mqtt\.prefix: 'servo/#' must be text without \+, #"),
        ('[mqtt]\nhost = "b"\nnode = "a/b"', r"mqtt\.node: 'a/b' must be text without \+, # and /"),
        ('[mqtt]\nhost = "b"\nencoding = "sparkplug"\nhome_assistant = true', "'home_assistant' needs encoding"),
        ('[[webhook]]\nurl = "file:///etc/passwd"', r"webhook\[0\]\.url: .* is not an address such as https"),
        ('[[webhook]]\nurl = "https://a:b@c/"', r"webhook\[0\]\.url: a password does not belong into the address"),
        ('[[webhook]]\nurl = "https://c/"\ndrives = ["axis2"]', r"for the drive 'axis2' \(did you mean 'axis1'\?\)"),
    ],
)
def test_what_is_wrong_is_told(text: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says) as caught:
        parse_config(tomllib.loads(text), "c.toml", text)
    assert "\n" not in str(caught.value)


def test_the_examples_in_comments_hold(repo_root: Path) -> None:
    example = (repo_root / "deploy" / "example.toml").read_text(encoding="utf-8")
    blocks = re.findall(r"^# \[+(?:mqtt|webhook)\]+\n(?:# .*\n)+", example, re.MULTILINE)
    text = "\n".join(re.sub(r"^# ", "", block, flags=re.MULTILINE) for block in blocks)
    config = parse_config(tomllib.loads(text), "example", text)
    assert config.mqtt is not None
    assert (config.mqtt.port_number, config.mqtt.home_assistant, len(config.webhook)) == (1883, True, 1)
    assert config.model_dump()["mqtt"]["host"] == "broker.local"


def test_without_a_prefix_two_machines_do_not_meet() -> None:
    prefixes = [parse_config({"mqtt": {"host": "b", "node": n}}).mqtt.topic_prefix for n in ("a", "b")]  # type: ignore[union-attr]
    assert prefixes == ["servo-daemon/a", "servo-daemon/b"]
    assert parse_config({"mqtt": {"host": "b", "tls": True}}).mqtt.port_number == 8883  # type: ignore[union-attr]
    assert parse_config({}).mqtt is None


@pytest.mark.parametrize(
    ("module", "encoding", "says"),
    [("paho.mqtt.client", "json", "needs paho-mqtt"), ("google.protobuf", "sparkplug", "needs protobuf")],
)
def test_an_extra_that_is_missing_is_told_at_the_start(
    module: str, encoding: str, says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    sparkplug_payload.messages.cache_clear()
    config = parse_config({"mqtt": {"host": "b", "encoding": encoding}}).mqtt
    assert config is not None
    with pytest.raises(ConfigError, match=rf"{says}: pip install 'servo-daemon\[mqtt\]'"):
        MqttSink(config, (), None)


def test_a_credential_that_there_is_not_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CREDENTIALS_DIRECTORY", raising=False)
    config = parse_config({"mqtt": {"host": "b", "username": "u", "password_file": "credential:mqtt"}}).mqtt
    assert config is not None
    with pytest.raises(ConfigError, match=r'\[mqtt\] password_file = "credential:mqtt": there is no \$CRED'):
        MqttSink(config, (), None)


def test_a_password_file_that_cannot_be_read_is_told_at_the_start(tmp_path: Path) -> None:
    """`check` tells it, too, before it opens a device."""
    file = tmp_path / "c.toml"
    file.write_text(f'[mqtt]\nhost = "b"\nusername = "u"\npassword_file = "{tmp_path}/nothing"\n[[drive]]\n')
    arguments = argparse.Namespace(config=file, listen=1.0, json=False)
    with pytest.raises(ConfigError, match=r"password_file .*nothing: cannot be read"):
        check.run(arguments)
