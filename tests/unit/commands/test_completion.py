"""Completion in a shell, and the list of effects."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from servo_daemon.cli import COMMANDS, _parser
from servo_daemon.commands.shared.effect_flag import effect_list
from servo_daemon.plant.effects import effects_by_name
from tests.command_line import run_command


@pytest.fixture(scope="module")
def script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("completion") / "servo-daemon.bash"
    path.write_text(run_command("completion", "bash").out)
    return path


def completed(script: Path, folder: Path, *words: str) -> set[str]:
    """What a real bash offers for the last of the words."""
    asks = (
        'source "$1"; shift; COMP_WORDS=(servo-daemon "$@"); COMP_CWORD=$#; '
        "handler=$(complete -p servo-daemon | sed 's/.*-F \\([^ ]*\\) .*/\\1/'); "
        '$handler; printf "%s\\n" "${COMPREPLY[@]}"'
    )
    arguments = ["bash", "--norc", "-c", asks, "bash", str(script), *words]
    return set(subprocess.run(arguments, cwd=folder, check=True, capture_output=True, text=True).stdout.split())


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (("exc",), {"excite"}),
        (("fit", "--effect", "cou"), {"coulomb_friction"}),
        (("excite", "--between", "back"), {"backlash"}),
        (("fit", "--method", ""), {"output-error", "idim"}),
        (("replay", "ben"), {"bench.csv"}),
        (("check", "--config", "ser"), {"servo.toml"}),
    ],
    ids=lambda value: value[-2] if isinstance(value, tuple) and len(value) > 1 else "",
)
def test_bash_completes(script: Path, tmp_path: Path, words: tuple[str, ...], offered: set[str]) -> None:
    for name in ("bench.csv", "servo.toml"):
        (tmp_path / name).touch()
    assert completed(script, tmp_path, *words) == offered


def test_zsh_has_every_effect() -> None:
    script = run_command("completion", "zsh").out
    assert script.startswith("#compdef servo-daemon")
    assert all(f" {name}" in script or f"({name}" in script for name in effects_by_name())


def test_what_completes_is_loaded_for_completion_only(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [m for m in sys.modules if m.partition(".")[0] == "shtab" or m == COMMANDS["completion"]]:
        monkeypatch.delitem(sys.modules, name)
    _parser()
    assert COMMANDS["completion"] in sys.modules and "shtab" not in sys.modules


def test_every_effect_is_listed_with_a_sentence() -> None:
    listings = {
        run_command(name, "--effect", "help") for name in ("fit", "diagnose", "simulate", "compare", "sim-drive")
    }
    (result,) = listings | {run_command("fit", "--effect", "list")}
    assert result.code == 0 and result.err == ""
    said = " ".join(result.out.split())
    for name, effect in effects_by_name().items():
        parameters = ", ".join(p.name for p in effect.parameters)
        what = effect.cause if not effect.further else f"A further harmonic of {effect.further}."
        assert f"{name} ({parameters}) {what}" in said


def test_the_list_fits_the_terminal() -> None:
    assert max(len(line) for line in effect_list(80).splitlines()) <= 80


def test_the_help_says_how_to_list_them() -> None:
    assert "'help' lists them" in " ".join(run_command("fit", "--help").out.split())
