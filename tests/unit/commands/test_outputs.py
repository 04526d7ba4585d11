"""What is there already is written over only where somebody says so."""

from __future__ import annotations

import gzip
import io
from pathlib import Path

import pytest

from servo_daemon.commands.replay.estimates_csv import EstimatesWriter, is_estimates
from servo_daemon.commands.shared.common import may_overwrite
from servo_daemon.errors import BadInputError
from tests.command_line import run_command

CONFIG = '[[drive]]\ndriver = "simulated"\n[drive.nominal]\nR = 0.5\nL = 2e-3\nK = 0.3\nJ = 0.01\nB = 0.5\n'
PRECIOUS = "measured once\n"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("words", "names"),
    [
        (("simulate", "--seconds", "0.1", "--out", "x.csv"), "x.csv"),
        (("record", "--config", "c.toml", "--seconds", "0.1", "--out", "x.csv"), "x.csv"),
        (("replay", "none.csv", "--out", "x.csv"), "x.csv"),
        (("excite", "--config", "c.toml", "--out", "x.csv"), "x.csv"),
        (("train", "--config", "c.toml", "--motors", "1", "--out", "x.csv"), "x.csv"),
        (("fit", "none.csv", "--out", "."), "fit.json"),
        (("compare", "--paper", "--out", "."), "compare.json"),
        (("diagnose", "none.csv", "--out", "."), "diagnosis.json and report.html"),
        (("tune", "--config", "c.toml", "--out", "."), "controller.toml"),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else "",
)
def test_a_file_that_is_there_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], names: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("c.toml").write_text(CONFIG)
    for name in names.split(" and "):
        Path(name).write_text(PRECIOUS)
    result = run_command(*words)
    said = f"{names} {'exist' if ' and ' in names else 'exists'}: choose another --out, or --force to overwrite"
    assert result.code == 2 and said in result.err
    assert {Path(name).read_text() for name in names.split(" and ")} == {PRECIOUS}
    assert len([*tmp_path.iterdir()]) == 1 + len(names.split(" and "))


def test_force_overwrites(tmp_path: Path) -> None:
    out = tmp_path / "x.csv"
    out.write_text(PRECIOUS)
    assert run_command("simulate", "--seconds", "0.1", "--out", out, "--force").code == 0
    assert out.read_text().startswith("# ")


def test_a_diagnosis_that_goes_on_writes_its_report_anew(tmp_path: Path) -> None:
    """The same command once more is how it goes on (`--journal`)."""
    (tmp_path / "report.html").write_text("unfinished")
    words = ("diagnose", tmp_path / "none.csv", "--out", tmp_path, "--journal", tmp_path / "journal")
    assert "--force" in run_command(*words).err
    (tmp_path / "journal").write_text("")
    said = run_command(*words).err
    assert "--force" not in said and "none.csv" in said


@pytest.mark.parametrize("ending", ["csv", "csv.gz"])
def test_estimates_are_written_anew_where_there_were_estimates(tmp_path: Path, ending: str) -> None:
    out = tmp_path / f"e.{ending}"
    with EstimatesWriter(out, ("R", "L")):
        pass
    assert is_estimates(out)
    capture = b"time_s,voltage_V,current_A\n0,1,2\n"
    out.write_bytes(gzip.compress(capture) if ending.endswith("gz") else capture)
    assert not is_estimates(out)
    out.write_bytes(b"\x1f\x8b no gzip at all")
    assert not is_estimates(out)
    assert not is_estimates(tmp_path / "none.csv")


@pytest.mark.parametrize(("answer", "goes_on"), [("y\n", True), ("n\n", False), ("\n", False), ("", False)])
def test_on_a_terminal_it_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answer: str, goes_on: bool
) -> None:
    (tmp_path / "x.csv").write_text(PRECIOUS)
    shown = Terminal()
    monkeypatch.setattr("sys.stdin", Terminal(answer))
    monkeypatch.setattr("sys.stderr", shown)
    if goes_on:
        may_overwrite(False, tmp_path / "x.csv")
    else:
        with pytest.raises(BadInputError, match="--force"):
            may_overwrite(False, tmp_path / "x.csv")
    assert shown.getvalue() == f"{tmp_path / 'x.csv'} exists: overwrite? [y/N] "


def test_nothing_is_asked_where_nothing_is_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown = Terminal()
    monkeypatch.setattr("sys.stdin", Terminal(""))
    monkeypatch.setattr("sys.stderr", shown)
    may_overwrite(False, tmp_path / "x.csv", tmp_path, Path("/dev/null"))
    assert shown.getvalue() == ""
