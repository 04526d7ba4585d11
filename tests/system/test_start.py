"""What is wrong at the start is one clear line and an exit code; what may come right later does not stop it."""

from __future__ import annotations

import json
import socket
from pathlib import Path

import pytest

from tests.system.harness import all_tracking, daemon, nominal_table, run_once, write_config

ROOT = Path(__file__).resolve().parents[2]

DBC = """VERSION ""
BU_: Drive
BO_ 256 Status1: 8 Drive
 SG_ MotorCurrent : 0|16@1- (0.01,0) [0|0] "A" Vector__XXX
"""


def assert_refused(*words: str | Path, code: int, says: tuple[str, ...]) -> None:
    done = run_once(*words)
    assert done.returncode == code, done.stderr
    assert done.stdout == ""
    lines = [line for line in done.stderr.splitlines() if line]
    assert len(lines) == 1, lines
    for text in says:
        assert text in lines[0], lines[0]


def test_a_port_that_is_taken() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert_refused("run", "--port", str(port), code=1, says=(str(port), "in use", "--port 0"))


def test_an_address_that_is_not_ours() -> None:
    assert_refused("run", "--host", "192.0.2.1", "--port", "0", code=1, says=("192.0.2.1",))


def test_a_network_without_tokens() -> None:
    assert_refused("run", "--host", "0.0.0.0", "--port", "0", code=2, says=("0.0.0.0", "tokens_file", "behind_proxy"))


@pytest.mark.first_is_fast
@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[api]\nprot = 1\n", ("unknown key 'api.prot'",)),
        ("[api]\nhost = '127.0.0.1'\n", ("c.toml: no [[drive]]",)),
        ("[[drive]]\ndriver = 'morse'\n", ("unknown driver 'morse'", "serial")),
        ("[[drive]]\ndriver = 'serial'\n[drive.options]\nprot = 1\n", ("axis1", "unknown option 'prot'")),
    ],
)
def test_a_wrong_configuration(tmp_path: Path, text: str, says: tuple[str, ...]) -> None:
    config = tmp_path / "c.toml"
    config.write_text(text)
    assert_refused("run", "--port", "0", "--config", config, code=2, says=says)


def test_a_dbc_without_the_mapped_signal(tmp_path: Path) -> None:
    (tmp_path / "other.dbc").write_text(DBC)
    config = write_config(
        tmp_path / "c.toml",
        f'driver = "can"\n[drive.options]\ninterface = "virtual"\nchannel = "x"\ndbc = "{tmp_path / "other.dbc"}"\n'
        '[drive.options.signals]\ncurrent_A = "Status1.MotorCurent"\nvelocity_rad_s = "Status1.Speed"',
    )
    assert_refused("run", "--port", "0", "--config", config, code=2, says=("other.dbc", "MotorCurent"))
    done = run_once("check", "--json", "--config", config)
    assert done.returncode == 2 and "MotorCurent" in json.loads(done.stdout)["error"]


@pytest.mark.first_is_fast
@pytest.mark.parametrize("where", ["below a file", "/proc/servo-daemon"])
def test_a_data_directory_that_cannot_be_written(tmp_path: Path, where: str) -> None:
    """Works as ever, says so once, and the API says what is wrong. (Root may write everywhere but in such places.)"""
    file = tmp_path / "file"
    file.write_text("")
    state = file / "state" if where == "below a file" else Path(where)
    config = write_config(tmp_path / "c.toml", nominal_table(), head="[storage]\nsave_interval_s = 0.2\n")
    with daemon("--config", config, "--state-dir", state) as program:
        program.until(all_tracking, "tracks all the same")
        unsaved = "drive axis1: its state cannot be saved"
        told = program.until(lambda d: unsaved in program.get("/health")["problems"], "told")
        assert told["health"]["connection"] == "connected"
        answer = program.client.get("/api/v1/health")
        assert answer.status_code == 503
        others = set(answer.json()["problems"]) - {unsaved}
        assert all(p.startswith("the history cannot be written") for p in others)
        samples = program.estimates()["samples"]
        program.until(lambda d: d["samples"] > samples + 1000, "a second, and several attempts, later")
        assert program.said("state cannot be kept") == 1
        assert not [line for line in program.log if "ERROR" in line or "Traceback" in line]
        program.stop()
        assert program.said("state cannot be kept") == 1
