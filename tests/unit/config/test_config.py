"""Configuration: everything is checked before anything starts, and every complaint is one line that names the place."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from servo_daemon.config import Config, load_config, parse_config
from servo_daemon.config_texts import parse_drift
from servo_daemon.errors import ConfigError
from servo_daemon.parameters import LINEAR

ROOT = Path(__file__).resolve().parents[3]


def load(path: Path, text: str, **environment: str) -> Config:
    path.write_text(text, encoding="utf-8")
    return load_config(path, environment)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "c.toml"


def test_without_anything_there_is_one_simulated_drive() -> None:
    config = load_config(None, {})
    assert (config.api.host, config.api.port) == ("127.0.0.1", 8077)
    assert [(d.name, d.driver, d.model, d.nominal) for d in config.drive] == [("axis1", "simulated", (), {})]
    assert config.storage.state_dir is None


def test_every_section_of_the_contract_is_read(file: Path) -> None:
    config = load(
        file,
        """
        [api]
        host = "::1"
        port = 0
        [storage]
        state_dir = "/var/lib/x"
        save_interval_s = 2.5
        [[drive]]
        name = "axis-1.b"
        driver = "serial"
        model = ["coulomb_friction"]
        [drive.nominal]
        R = 0.4937
        J = 0.009751
        J_m = 0.0081
        Tc = 0.02
        [drive.estimation]
        engine = "filterpy"
        skew_s = 0.0
        refresh = false
        adopt = "never"
        [drive.drift]
        R = "10 %/h"
        [drive.load]
        mass_kg = 0.5
        arm_length_m = 0.1
        counts_per_rev = 8192
        [drive.limits]
        voltage_V = 24
        R_max = "+30 %"
        J_d_min = 0.001
        [drive.controller]
        position_kp_1_s = 20
        [drive.options]
        port = "/dev/ttyUSB0"
        anything = { goes = ["here"] }
        [[drive]]
        name = "axis2"
        """,
    )
    first = config.drive_named(None)
    assert config.drive_named("axis2").driver == "simulated"
    assert first.model == ("coulomb_friction",) and first.nominal["Tc"] == 0.02
    assert first.limits.alarms == {"R_max": "+30 %", "J_d_min": 0.001}
    assert first.options == {"port": "/dev/ttyUSB0", "anything": {"goes": ["here"]}}
    assert first.drift_per_sqrt_s("R") == pytest.approx(0.1 / 60)
    assert first.drift_per_sqrt_s("K") is None
    with pytest.raises(ConfigError, match=r"'axis3'.*axis-1\.b, axis2"):
        config.drive_named("axis3")


@pytest.mark.parametrize("section", ["api", "storage", "drive.estimation", "drive.load", "drive.controller"])
def test_an_unknown_key_is_refused_by_name_in_every_section(file: Path, section: str) -> None:
    head = "[[drive]]\n" if section.startswith("drive.") else ""
    where = section.replace("drive.", r"drive\[0\]\.")
    line = 3 if head else 2
    meant = r" \(did you mean 'port'\?\)" if section == "api" else ""
    with pytest.raises(ConfigError, match=rf"c\.toml: unknown key '{where}\.prot', line {line}{meant}$"):
        load(file, f"{head}[{section}]\nprot = 1\n")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("colour = 1", "unknown key 'colour'"),
        ("[[drive]]\nnmae = 'x'\nname = 5", r"unknown key 'drive\[0\]\.nmae'"),
        ("[[drive]]\n[drive.limits]\nQ_max = 1", "unknown key 'Q_max'"),
        ("[[drive]]\n[drive.limits]\nRmax = 1", r"unknown key 'Rmax', line 3 \(did you mean 'R_max'\?\)"),
        ("[[drive]]\n[drive.nominal]\nKt = 1", r"unknown key 'Kt', line 3 \(did you mean 'K'\?\): parameters are"),
        ("[[drive]]\n[drive.drift]\nk_e = '1 %/h'", r"unknown key 'k_e', line 3 \(did you mean 'K'\?\)"),
        (
            "[[drive]]\nname = 'a'\n[drive.estimation] # a\nring_s = 1\n[[drive]]\n[drive.estimation]\nenigne = 1",
            r"unknown key 'drive\[1\]\.estimation\.enigne', line 7 \(did you mean 'engine'\?\)",
        ),
        ("[drives]\nname = 'a'", r"unknown key 'drives', line 1 \(did you mean 'drive'\?\)"),
        ("[[drive]]\n[drive.limits]\nR_max = 'much'", "R_max"),
        ("[[drive]]\n[drive.limits]\nR_max = '1.2.3 %'", r"R_max.*not '1\.2\.3 %'"),
        ("[[drive]]\n[drive.limits]\nR_max = '+1e999 %'", "R_max"),
        ("[[drive]]\n[drive.limits]\nR_max = nan", "R_max.*not nan"),
        ("[[drive]]\n[drive.limits]\nR_max = true", "R_max.*not True"),
        ("[[drive]]\n[drive.limits]\nvoltage_V = -1", "voltage_V"),
        ("[[drive]]\n[drive.nominal]\nr = 1", "unknown key 'r'"),
        ("[[drive]]\n[drive.nominal]\nR = -1", "R = -1 Ω is outside"),
        ("[[drive]]\n[drive.nominal]\nR = nan", "nominal"),
        ("[[drive]]\n[drive.nominal]\nR = inf", "nominal"),
        ("[[drive]]\n[drive.nominal]\nR = 'one'", "nominal"),
        ("[[drive]]\n[drive.nominal]\nR = true", "R = True is not a number"),
        ("[[drive]]\n[drive.nominal]\nchannel = 'tacho'", "channel = 'tacho' is none of current_A, position_rad"),
        ("[[drive]]\n[drive.nominal]\nchannel = 0.5", "channel = 0.5 is none of current_A, position_rad"),
        ("[[drive]]\n[drive.nominal]\nJ = 0.01\nJ_m = 0.02", "J_m = 0.02 .* is more than J = 0.01"),
        ("[[drive]]\n[drive.drift]\nR = '10 parsec'", "10 parsec"),
        ("[[drive]]\n[drive.drift]\nK = '1.2.3 %/h'", r"K: '1\.2\.3 %/h' is not a drift"),
        ("[[drive]]\n[drive.drift]\nK = '10 %/(h'", "K: .* is not a drift"),
        ("[[drive]]\n[drive.drift]\nQ = '10 %/h'", "unknown key 'Q'"),
        ("[[drive]]\nmodel = ['warp']", "unknown effect 'warp': known are"),
        ("[[drive]]\nmodel = ['gravity']", r"unknown effect 'gravity' \(did you mean 'gravity_load'\?\): known are"),
        ("[[drive]]\nmodel = ['gravity_load', 'gravity_load']", "named twice"),
        ("[[drive]]\nname = 'a/b'", "must be letters"),
        ("[[drive]]\nname = ''", "must be letters"),
        ("[[drive]]\n[[drive]]", "two drives are named 'axis1'"),
        ("drive = []", "at least one"),
        ("[api]\nport = 70000", "api.port"),
        ("[api]\nport = 'http'", "api.port"),
        ("[storage]\nsave_interval_s = 0", "save_interval_s"),
        ("[[drive]]\n[drive.estimation]\nengine = 'magic'", "engine"),
        ("[[drive]]\n[drive.estimation]\nskew_s = -1e-6", "skew_s"),
        ('[[drive]]\nname = "a\\n"', "must be letters"),
        ("drive = 5", "drive"),
        ("[drive]\nname = 'a'", r"drive: must be a list, \[\[drive\]\]"),
        ("[[drive]]\nmodel = 'coulomb_friction'", r"drive\[0\]\.model: must be a list, in brackets"),
        ("[api", "not valid TOML"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(file: Path, text: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says) as error:
        load(file, text)
    assert "\n" not in str(error.value)
    assert str(error.value).startswith(str(file))
    assert error.value.exit_code == 2


def test_several_mistakes_are_counted(file: Path) -> None:
    with pytest.raises(ConfigError, match=r"\(and 1 more\)"):
        load(file, "[api]\nport = -1\n[storage]\nsave_interval_s = -1")


def test_a_byte_order_mark_is_no_part_of_the_text(file: Path) -> None:
    assert load(file, "\ufeff[api]\nport = 1\n[[drive]]\n").api.port == 1


def test_a_file_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.toml: cannot be read: No such file"):
        load_config(tmp_path / "none.toml", {})
    with pytest.raises(ConfigError, match="cannot be read: Is a directory"):
        load_config(tmp_path, {})
    latin = tmp_path / "latin.toml"
    latin.write_bytes(b"# \xe9t\xe9\n")
    with pytest.raises(ConfigError, match=r"latin\.toml: not UTF-8"):
        load_config(latin, {})


@pytest.mark.parametrize("text", ["", "[api]\nport = 1\n"])
def test_a_file_without_a_drive_is_refused(file: Path, text: str) -> None:
    """Nobody who writes a file means a motor that is not there."""
    with pytest.raises(ConfigError, match=r"c\.toml: no \[\[drive\]\]: add .*driver = .*servo-daemon scan"):
        load(file, text)


def test_a_misspelt_drive_is_told_before_the_one_that_is_missing(file: Path) -> None:
    with pytest.raises(ConfigError, match=r"unknown key 'drives', line 1 \(did you mean 'drive'\?\)"):
        load(file, "[[drives]]\n")


def test_the_environment_overrides_the_file(file: Path) -> None:
    text = "[api]\nport = 1\nhost = 'a'\n[storage]\nstate_dir = '/a'\n[[drive]]\n"
    names = {"API_PORT": "2", "API_HOST": "b", "STATE_DIR": "/b", "STORAGE_SAVE_INTERVAL_S": "7"}
    config = load(file, text, **{f"SERVO_DAEMON_{k}": v for k, v in names.items()})
    assert (config.api.port, config.api.host) == (2, "b")
    assert (config.storage.state_dir, config.storage.save_interval_s) == ("/b", 7.0)
    with pytest.raises(ConfigError, match=r"api\.port"):
        load(file, text, SERVO_DAEMON_API_PORT="many")
    assert load(file, text, API_PORT="2").api.port == 1


def test_a_configuration_cannot_be_changed() -> None:
    config = parse_config({})
    with pytest.raises(ValueError, match="frozen"):
        config.api.port = 1  # type: ignore[misc]


@pytest.mark.parametrize(
    ("text", "one_sigma", "after_s"),
    [("10 %/h", 0.1, 3600), ("5%/sqrt(min)", 0.05, 60), ("1e-2 % / s", 1e-4, 1), ("3 %/(d)", 0.03, 86400)],
)
def test_a_drift_is_one_sigma_after_its_unit_of_time(text: str, one_sigma: float, after_s: float) -> None:
    assert parse_drift(text) * math.sqrt(after_s) == pytest.approx(one_sigma)


@pytest.mark.parametrize("text", ["", "10", "10 %", "%/h", "-1 %/h", "1..2 %/h", "10 %/year", "1e999 %/h"])
def test_what_is_no_drift_is_refused(text: str) -> None:
    with pytest.raises(ValueError):
        parse_drift(text)


def test_the_example_is_valid_and_names_every_parameter() -> None:
    config = load_config(ROOT / "deploy" / "example.toml", {})
    assert config.drive
    assert {p.name for p in LINEAR} <= set().union(*(d.nominal for d in config.drive))
