"""The example effect of CONTRIBUTING.md, exactly as it stands there: two edits to a copy of the source, as a stranger
makes them, then `simulate` and `fit` from outside, on data of another integrator."""

from __future__ import annotations

import ast
import json
import math
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

TRUE = {"R": 0.5, "L": 2.3e-3, "K": 0.3, "J": 0.01, "B": 0.2, "Teddy": 0.9, "weddy": 4.0}
RATE_HZ, SECONDS = 1000, 6.0
#: Of a value: the plant's step is of second order in the sample period. Without noise L is 0.03 % off at 1 kHz, a
#: quarter of that at 2 kHz.
STEP_ERROR = 1e-3
#: White noise of a laboratory drive: current, A; angle, rad (8192 counts a turn over √12).
NOISE = (0.06, 2.2e-4)
#: Runge–Kutta steps a sample: h·|λ| = 0.05 at the fastest pole, an error of 1e-8 a step.
_SUBSTEPS = 4


def code_blocks(repo_root: Path) -> list[str]:
    """The Python of the section on effects."""
    text = (repo_root / "CONTRIBUTING.md").read_text(encoding="utf-8")
    section = text.split("\n## An effect\n", 1)[1].split("\n## ", 1)[0]
    return re.findall(r"^```python\n(.*?)^```", section, re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def stranger(repo_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the source with the two edits."""
    folder = tmp_path_factory.mktemp("stranger")
    for package in ("servo_daemon", "drivers"):
        shutil.copytree(repo_root / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    effect, name = code_blocks(repo_root)
    path, code = effect.split("\n", 1)
    target = folder / path.removeprefix("# ")
    assert not target.exists()
    target.write_text(code, encoding="utf-8")
    table = target.with_name("__init__.py")
    text = table.read_text(encoding="utf-8")
    names = re.search(r"^NAMES = \(\n(?:    \"\w+\",\n)+", text, re.MULTILINE)
    assert names is not None
    (added,) = ast.literal_eval(name)
    table.write_text(f'{text[: names.end()]}    "{added}",\n{text[names.end() :]}', encoding="utf-8")
    return folder


def run(folder: Path, *words: str) -> str:
    """What `servo-daemon WORDS…` of that copy prints."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("SERVO_DAEMON_")}
    command = [sys.executable, "-m", "servo_daemon", *words]
    environment["PYTHONPATH"] = str(folder)
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def slope(x: tuple[float, float, float], v: float) -> tuple[float, float, float]:
    """The motor with the printed equation of the brake: d/dt of current, speed and angle."""
    i, w, _ = x
    ratio = w / TRUE["weddy"]
    brake = 2 * TRUE["Teddy"] * ratio / (1 + ratio * ratio)
    di = (v - TRUE["R"] * i - TRUE["K"] * w) / TRUE["L"]
    return di, (TRUE["K"] * i - TRUE["B"] * w - brake) / TRUE["J"], w


def write_capture(path: Path) -> None:
    """Steps of voltage held for 0.1 s, integrated by Runge–Kutta; white noise of current and angle."""
    rng = np.random.default_rng(3)
    n = int(SECONDS * RATE_HZ)
    voltage = np.repeat(rng.uniform(-12.0, 12.0, math.ceil(n / 100)), 100)[:n]
    h = 1.0 / (RATE_HZ * _SUBSTEPS)
    x, rows = (0.0, 0.0, 0.0), []
    for k in range(n):
        v = float(voltage[k])
        rows.append((k / RATE_HZ, v, x[0], x[2]))
        for _ in range(_SUBSTEPS):
            k1 = slope(x, v)
            k2 = slope(tuple(a + h / 2 * b for a, b in zip(x, k1, strict=True)), v)  # type: ignore[arg-type]
            k3 = slope(tuple(a + h / 2 * b for a, b in zip(x, k2, strict=True)), v)  # type: ignore[arg-type]
            k4 = slope(tuple(a + h * b for a, b in zip(x, k3, strict=True)), v)  # type: ignore[arg-type]
            x = tuple(  # type: ignore[assignment]
                a + h / 6 * (b + 2 * c + 2 * d + e) for a, b, c, d, e in zip(x, k1, k2, k3, k4, strict=True)
            )
    data = np.array(rows)
    data[:, 2] += rng.normal(0.0, NOISE[0], n)
    data[:, 3] += rng.normal(0.0, NOISE[1], n)
    np.savetxt(path, data, delimiter=",", header="time_s,voltage_V,current_A,position_rad", comments="")


def test_an_effect_of_a_stranger_is_fitted(stranger: Path) -> None:
    write_capture(stranger / "brake.csv")
    found = json.loads(run(stranger, "fit", "brake.csv", "--effect", "eddy_current_brake", "--json"))
    for name, true in TRUE.items():
        estimate = found["parameters"][name]
        assert estimate["std"] < 0.02 * true, name
        assert abs(estimate["value"] - true) < 4 * estimate["std"] + STEP_ERROR * true, (name, estimate)
    without = json.loads(run(stranger, "fit", "brake.csv", "--json"))
    assert without["residual"]["rmse"]["position_rad"] > 10 * found["residual"]["rmse"]["position_rad"]


def test_an_effect_of_a_stranger_is_simulated_and_filtered(stranger: Path) -> None:
    run(stranger, "simulate", "--out", "c.csv", "--seconds", "3", "--effect", "eddy_current_brake:Teddy=1,weddy=4")
    (stranger / "c.toml").write_text('[[drive]]\nmodel = ["eddy_current_brake"]\n', encoding="utf-8")
    run(stranger, "replay", "c.csv", "--config", "c.toml", "--out", "e.csv")
    assert "ekf_weddy" in (stranger / "e.csv").read_text(encoding="utf-8").split("\n", 1)[0].split(",")
