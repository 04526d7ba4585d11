"""`status` and `export-history` against a served API over a store on disk."""

from __future__ import annotations

import asyncio
import csv
import gzip
import io
import json
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

import pyarrow.parquet
import pytest
from rich.console import Console

from servo_daemon import cli
from servo_daemon.api.access.permission import Access
from servo_daemon.api.access.tokens import TokenFile
from servo_daemon.api.app import create_app
from servo_daemon.commands import export_history
from servo_daemon.commands.run.reload import Files
from servo_daemon.commands.run.serve import SWITCH_S, serve
from servo_daemon.commands.status import rendered, with_std
from servo_daemon.config import Config
from tests.fake_daemon import T0, fake_daemon
from tests.http_rig import serving
from tests.unit.history.world import World


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    made = World.in_folder(tmp_path_factory.mktemp("served"))
    made.run(402.0)  # the last row of a turn: what comes after it is lost
    made.restart()
    return made


@pytest.fixture(scope="module")
def url(world: World) -> Iterator[str]:
    daemon = fake_daemon()
    daemon.archive = world.archive
    with serving(create_app(daemon)) as found:
        yield found


def test_status_as_a_document_and_as_tables(url: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["status", url, "--json"]) == 0
    fleet = json.loads(capsys.readouterr().out)
    assert cli.main(["status", url]) == 0
    assert "axis1" in capsys.readouterr().out
    out = io.StringIO()
    fleet["problems"] = ["drive axis1: its state cannot be saved"]
    Console(file=out, width=80).print(rendered(fleet, T0 + 120))
    text = out.getvalue()
    assert "…" not in text, "nothing is cut on a terminal of 80 columns"
    for part in ("axis1 (simulated)", "119 s ago", "5 of 5", "tracking", "Ω", "problem: drive axis1: its state"):
        assert part in text, part


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [(0.63912, 0.0012, "0.6391 ± 0.0012"), (None, None, "–"), (12.3456, None, "12.35"), (1234.5, 30.0, "1234 ± 30"),
     (2.2e-9, 1e-11, "2.2e-09 ± 1e-11")],
)  # fmt: skip
def test_as_many_digits_as_are_known(value: float | None, std: float | None, text: str) -> None:
    assert with_std(value, std) == text


def test_no_daemon_and_none_of_ours(capsys: pytest.CaptureFixture[str], url: str) -> None:
    assert cli.main(["status", "http://127.0.0.1:9"]) == 1
    assert "no daemon answers at http://127.0.0.1:9" in capsys.readouterr().err
    assert cli.main(["status", "nonsense"]) == 2
    assert cli.main(["export-history", url, "--drive", "axis9", "--out", "x.csv"]) == 2
    assert "There is no drive 'axis9'" in capsys.readouterr().err


def test_a_token_comes_from_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "tokens"
    assert cli.main(["token", "new", "wall", "--scope", "read", "--file", str(file)]) == 0
    secret = capsys.readouterr().out.split()[-1]
    with serving(create_app(fake_daemon(), access=Access(tokens=TokenFile(file)))) as closed:
        assert cli.main(["status", closed]) == 1
        assert "set SERVO_DAEMON_TOKEN" in capsys.readouterr().err
        monkeypatch.setenv("SERVO_DAEMON_TOKEN", secret)
        assert cli.main(["status", closed, "--json"]) == 0


def test_the_history_as_files(
    url: str, world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In several requests, each row once."""
    monkeypatch.setattr(export_history, "_ROWS", 100)
    monkeypatch.setattr("time.time", lambda: world.now)
    plain, packed, table = tmp_path / "h.csv", tmp_path / "h.csv.gz", tmp_path / "h.parquet"
    words = ["export-history", url, "--parameter", "R,L", "--window", "30min", "--level", "1 s", "--out"]
    assert cli.main([*words, str(plain), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    rows = list(csv.DictReader(io.StringIO(plain.read_text())))
    assert told["rows"] == len(rows) == 403 == len({row["time"] for row in rows})
    assert sum(int(row["R_count"]) for row in rows) == 4020
    assert [row["time"] for row in rows] == sorted(row["time"] for row in rows)
    assert cli.main([*words, str(packed)]) == 0 and gzip.decompress(packed.read_bytes()) == plain.read_bytes()
    assert cli.main([*words, str(table)]) == 0
    assert pyarrow.parquet.read_table(table)["R"].to_pylist() == [float(row["R"]) for row in rows]
    capsys.readouterr()
    assert cli.main([*words, str(plain)]) == 2 and "--force" in capsys.readouterr().err
    assert cli.main([*words, str(plain), "--force"]) == 0
    assert cli.main([*words, str(tmp_path / "h.xls")]) == 2


def test_the_level_that_suits_in_one_request(url: str, tmp_path: Path) -> None:
    out = tmp_path / "all.csv"
    assert cli.main(["export-history", url, "--window", "1y", "--out", str(out)]) == 0
    rows = list(csv.DictReader(io.StringIO(out.read_text())))
    assert {"R", "L_std", "B_status"} <= set(rows[0]) and len(rows) in {1, 2}


def test_threads_of_a_daemon_let_each_other_on_sooner() -> None:
    """Answers would wait 5 ms for every thread that computes, each time that they let go of the interpreter."""
    before, found = sys.getswitchinterval(), []

    class StartedError(Exception):
        pass

    class Daemon:
        def start(self) -> None:
            found.append(sys.getswitchinterval())
            raise StartedError

    try:
        with socket.socket() as listener, pytest.raises(StartedError):
            asyncio.run(serve(Daemon(), listener, Files(Config, lambda _: None), ()))  # type: ignore[arg-type]
    finally:
        sys.setswitchinterval(before)
    assert found == [pytest.approx(SWITCH_S)]
