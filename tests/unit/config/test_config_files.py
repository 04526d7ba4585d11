"""Several files as one configuration: what drop-ins add, what they replace, and where a complaint points."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from servo_daemon.config import load_config
from servo_daemon.errors import ConfigError


@pytest.fixture
def base(tmp_path: Path) -> Path:
    (tmp_path / "conf.d").mkdir()
    return tmp_path / "servo-daemon.toml"


def written(base: Path, text: str, **more: str) -> Path:
    base.write_text(text, encoding="utf-8")
    for name, own in more.items():
        (base.parent / "conf.d" / f"{name}.toml").write_text(own, encoding="utf-8")
    return base


def test_tables_are_merged_drives_added_and_the_later_word_counts(base: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    written(
        base,
        '[api]\nport = 1\nallowed_hosts = ["a.example"]\n[[drive]]\nname = "a"\n',
        b20='[api]\nport = 3\n[[drive]]\nname = "c"\n[drive.limits]\nR_max = 2.0\n',
        b10='[api]\nport = 2\nmetrics = "open"\n[[drive]]\nname = "b"\n',
    )
    (base.parent / "conf.d" / "b30.toml.off").write_text("nonsense")
    config = load_config(base, {})
    assert [d.name for d in config.drive] == ["a", "b", "c"], "in the order of the files' names"
    assert (config.api.port, config.api.metrics, config.api.allowed_hosts) == (3, "open", ("a.example",))
    assert config.drive[2].limits.alarms == {"R_max": 2.0} and not config.drive[1].limits.alarms
    folder = base.parent / "conf.d"
    assert [r.getMessage() for r in caplog.records] == [
        f"{folder}/b10.toml, line 2: api.port takes the place of that of {base}, line 2",
        f"{folder}/b20.toml, line 2: api.port takes the place of that of {folder}/b10.toml, line 2",
    ]
    assert load_config(base, {"SERVO_DAEMON_API_PORT": "9"}).api.port == 9, "the environment stands above all files"


def test_drives_may_all_be_in_drop_ins(base: Path) -> None:
    with pytest.raises(ConfigError, match=r"no \[\[drive\]\] \(nor in conf\.d\)"):
        load_config(written(base, "", a="[api]\nport = 2"), {})
    assert load_config(written(base, "", a="[[drive]]\nname = 'x'"), {}).drive_named("x")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (
            "[[drive]]\n[[drive]]\nname = 'a'",
            r"b\.toml, line 2: two drives are named 'a': .*servo-daemon\.toml, line 2$",
        ),
        ("\n[[drive]]\nname = 'b'\n[drive.limits]\nR_maxx = 1", r"b\.toml: drive\[0\]\.limits: .*'R_maxx'"),
        ("[[drive]]\nname = 'b'\nmodl = []", r"b\.toml: unknown key 'drive\[0\]\.modl', line 3 \(did you mean 'model'"),
        ("[api]\nprot = 1", r"b\.toml: unknown key 'api\.prot', line 2 \(did you mean 'port'"),
        ("[api]\nport = 70000", r"b\.toml: api\.port: "),
        ("api = 5", r"b\.toml: api: "),
        ("drive = 5", r"b\.toml: drive: must be a list"),
        ("[api", r"b\.toml: not valid TOML"),
        ("a = " + "[" * 5000, r"b\.toml: not valid TOML: .* nested too deeply"),
    ],
)
def test_a_complaint_names_the_file_and_the_place_in_it(base: Path, text: str, says: str) -> None:
    written(base, "[api]\n[[drive]]\nname = 'a'\n", b=text)
    with pytest.raises(ConfigError, match=says) as error:
        load_config(base, {})
    assert "\n" not in str(error.value)
