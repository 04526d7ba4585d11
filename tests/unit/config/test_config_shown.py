"""`config show` gives back what was written, but for secrets; `config schema` takes what the program takes."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator

from drivers.registry import available
from servo_daemon.config import Config, load_config, parse_config
from servo_daemon.config.schema import DIALECT, json_schema
from servo_daemon.config.shown import HIDDEN, shown, toml
from servo_daemon.errors import ConfigError
from tests.command_line import run_command

ROOT = Path(__file__).resolve().parents[3]
EXAMPLE = ROOT / "deploy" / "example.toml"

SECRETS = """
[history]
url = "postgresql://servo:hunter2@db.local/servo?sslmode=require&sslpassword=hunter3"
[[drive]]
name = "a"
[drive.limits]
R_max = "+30 %"
[drive.options]
"odd key" = "quotes \\" and \\u007f"
password = "hunter4"
password_file = "/etc/secret"
nested = { api_key = "hunter5", list = [{ token = "hunter6" }, { n = 1 }] }
"""


def test_the_example_comes_back_whole() -> None:
    config = load_config(EXAMPLE, {})
    assert parse_config(tomllib.loads(toml(shown(config)))) == config
    assert parse_config(tomllib.loads(toml(shown(config, defaults=True)))) == config
    assert "port" not in toml(shown(parse_config({"drive": [{}]})))
    assert 'host = "127.0.0.1"' in toml(shown(parse_config({"drive": [{}]}), defaults=True))


def test_no_secret_is_shown(tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    file.write_text(SECRETS)
    for words in ((), ("--defaults",), ("--json",)):
        text = run_command("config", "show", "--config", str(file), *words).out
        assert "hunter" not in text
        document = json.loads(text) if "--json" in words else tomllib.loads(text)
        options = document["drive"][0]["options"]
        assert (
            document["history"]["url"]
            == f"postgresql://servo:{HIDDEN}@db.local/servo?sslmode=require&sslpassword={HIDDEN}"
        )
        assert (options["password"], options["password_file"]) == (HIDDEN, "/etc/secret")
        assert options["nested"] == {"api_key": HIDDEN, "list": [{"token": HIDDEN}, {"n": 1}]}
        assert options["odd key"] == 'quotes " and \x7f' and document["drive"][0]["limits"]["R_max"] == "+30 %"


@pytest.fixture(scope="module")
def validator() -> Draft202012Validator:
    schema = json_schema(available())
    assert Draft202012Validator.META_SCHEMA["$schema"] == DIALECT
    Draft202012Validator.check_schema(schema)
    return Draft202012Validator(schema)


def test_every_example_is_valid_by_the_schema(validator: Draft202012Validator) -> None:
    text = EXAMPLE.read_text(encoding="utf-8")
    commented = re.sub(r"^# ?(?=\[|[\w\"]+ = )", "", text, flags=re.MULTILINE)
    drives = [block for block in re.split(r"^(?=\[\[drive\]\])", commented, flags=re.MULTILINE) if "driver" in block]
    documents = [tomllib.loads(text), *(tomllib.loads(block) for block in drives[1:])]
    documents.append(shown(parse_config({"drive": [{}]}), defaults=True))
    for fence in re.findall(
        r"```toml\n(.*?)```", "".join(p.read_text() for p in sorted((ROOT / "docs").glob("*.md"))), re.DOTALL
    ):
        document = tomllib.loads(fence.replace("…", "1"))
        if "drive" in document and isinstance(document["drive"], list):
            documents.append(document)
    assert len(documents) > 6
    for document in documents:
        assert [e.message for e in validator.iter_errors(document)] == []


@pytest.mark.parametrize(
    "text",
    [
        "colour = 1",
        "[api]\nprot = 1",
        "[api]\nport = 70000",
        "[[drive]]\nname = 'a/b'",
        "[[drive]]\nmodel = ['warp']",
        "[[drive]]\n[drive.nominal]\nR = -1",
        "[[drive]]\n[drive.nominal]\nKt = 1",
        "[[drive]]\n[drive.nominal]\nchannel = 'tacho'",
        "[[drive]]\n[drive.drift]\nR = '10 parsec/h'",
        "[[drive]]\n[drive.limits]\nRmax = 1",
        "[[drive]]\n[drive.limits]\nR_max = 'much'",
        "[[drive]]\n[drive.limits]\nwarn_before = 'soon'",
        "[[drive]]\n[drive.estimation]\nadopt = 'perhaps'",
    ],
)
def test_what_the_program_refuses_the_schema_refuses(validator: Draft202012Validator, text: str) -> None:
    document: dict[str, Any] = tomllib.loads(text)
    assert list(validator.iter_errors(document))
    with pytest.raises(ConfigError):
        parse_config(document)


def test_the_schema_knows_every_key(validator: Draft202012Validator) -> None:
    """A section that is added to the configuration is in the schema with the test that names its keys."""
    schema = json.loads(run_command("config", "schema").out)
    assert set(schema["properties"]) == set(Config.model_fields)
    assert "null" not in json.dumps(schema)
    assert not [e.message for e in validator.iter_errors({"drive": [{"nominal": {"channel": "current_A"}}]})]
