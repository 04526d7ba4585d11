"""A command imports what it uses: what `--version`, `check` and `fit` load beside the standard library."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.command_line import run_command

#: What takes more than some milliseconds to import.
_SCIPY = ("linalg", "signal", "optimize", "stats", "integrate", "interpolate")
_HEAVY = (
    *("numpy", "casadi", "pydantic", "sklearn", "pandas", "can", "serial", "sqlalchemy", "fastapi", "uvicorn"),
    *("control", "filterpy", "matplotlib", "tqdm", "rich", *(f"scipy.{part}" for part in _SCIPY)),
)
_SAY = """
import json, sys
from servo_daemon.cli import main
try:
    code = main(sys.argv[2:])
except SystemExit as end:
    code = end.code
print(json.dumps({"code": code, "loaded": [m for m in sys.argv[1].split() if m in sys.modules]}))
"""
#: The equations are CasADi's, the configuration pydantic's; the simulated drive steps with SciPy's `expm`.
_MODEL = {"numpy", "casadi", "pydantic"}


@pytest.mark.parametrize(
    ("words", "loaded"),
    [
        ("--version", set()),
        ("check --config drive.toml", _MODEL | {"scipy.linalg"}),
        ("fit short.csv", _MODEL),
        ("simulate --out short.parquet --seconds 2 --seed 1", _MODEL | {"scipy.linalg"}),
    ],
)
def test_a_command_loads_what_it_uses(
    words: str, loaded: set[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("drive.toml").write_text('[[drive]]\nname = "axis1"\ndriver = "simulated"\n')
    if "short.csv" in words:
        assert run_command("simulate", "--out", "short.csv", "--seconds", "2", "--seed", "1").code == 0
    command = [sys.executable, "-c", _SAY, " ".join(_HEAVY), *words.split()]
    said = subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout.splitlines()[-1]
    assert json.loads(said) == {"code": 0, "loaded": [m for m in _HEAVY if m in loaded]}
