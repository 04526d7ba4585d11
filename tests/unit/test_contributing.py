"""The example effect of CONTRIBUTING.md, exactly as it stands there: one file in a copy of the source, then every
command from outside, on data of another integrator."""

from __future__ import annotations

import csv
import json
import math
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

MOTOR = {"R": 0.5, "L": 2.3e-3, "K": 0.3, "J": 0.01, "B": 0.2}
TRUE = {**MOTOR, "Teddy": 0.9, "weddy": 4.0}
RATE_HZ, SECONDS = 1000, 6.0
#: Of a value: the plant's step is of second order in the sample period. Without noise L is 0.03 % off at 1 kHz, a
#: quarter of that at 2 kHz.
STEP_ERROR = 1e-3
#: White noise of a laboratory drive: current, A; angle, rad (8192 counts a turn over √12).
NOISE = (0.06, 2.2e-4)
#: Runge–Kutta steps a sample: h·|λ| = 0.05 at the fastest pole, an error of 1e-8 a step.
_SUBSTEPS = 4


#: Another effect, with the least that a file needs, and linear in its parameter.
CUBIC = """
from servo_daemon.parameters import Parameter
from servo_daemon.plant.effects.base import Effect, Terms

C3 = Parameter("c3", "c_3", "N·m·s³/rad³", 1e-3, 1e-12, 1e3, "log", "drag over the cube of the speed", "start value")
EFFECT = Effect("cubic_drag", "A stirrer.", r"c_3\\omega^3", (C3,), lambda s: Terms(viscous=s.p["c3"] * s.omega**2))
"""
TRUE_C3 = 4e-3


#: The motor and what it may do, for a plan.
EXCITE = """
[[drive]]
nominal = { R = 0.5, L = 2.3e-3, K = 0.3, J = 0.01, B = 0.2 }
[drive.limits]
voltage_V = 24.0
current_A = 20.0
"""


def code_block(repo_root: Path) -> str:
    """The Python of the section on effects."""
    text = (repo_root / "CONTRIBUTING.md").read_text(encoding="utf-8")
    section = text.split("\n## An effect\n", 1)[1].split("\n## ", 1)[0]
    (code,) = re.findall(r"^```python\n(.*?)^```", section, re.MULTILINE | re.DOTALL)
    return str(code)


@pytest.fixture(scope="module")
def stranger(repo_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the source with two effects more, a file each, and a capture of each."""
    folder = tmp_path_factory.mktemp("stranger")
    for package in ("servo_daemon", "drivers"):
        shutil.copytree(repo_root / package, folder / package)
    path, code = code_block(repo_root).split("\n", 1)
    target = folder / path.removeprefix("# ")
    assert not target.exists()
    target.write_text(code, encoding="utf-8")
    target.with_name("cubic_drag.py").write_text(CUBIC, encoding="utf-8")
    write_capture(folder / "brake.csv", brake)
    write_capture(folder / "cubic.csv", lambda w: TRUE_C3 * w**3)
    return folder


def run(folder: Path, *words: str) -> str:
    """What `servo-daemon WORDS…` of that copy prints."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("SERVO_DAEMON_")}
    command = [sys.executable, "-m", "servo_daemon", *words]
    environment["PYTHONPATH"] = str(folder)
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def brake(w: float) -> float:
    """The printed equation, N·m at a speed in rad/s."""
    ratio = w / TRUE["weddy"]
    return 2 * TRUE["Teddy"] * ratio / (1 + ratio * ratio)


def write_capture(path: Path, load: Callable[[float], float]) -> None:
    """Steps of voltage held for 0.1 s, integrated by Runge–Kutta; white noise of current and angle."""

    def slope(x: tuple[float, float, float], v: float) -> tuple[float, float, float]:
        """d/dt of current, speed and angle."""
        i, w, _ = x
        di = (v - TRUE["R"] * i - TRUE["K"] * w) / TRUE["L"]
        return di, (TRUE["K"] * i - TRUE["B"] * w - load(w)) / TRUE["J"], w

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


@pytest.mark.parametrize("words", [("check",), ("format", "--check")])
def test_the_example_passes_the_lint(repo_root: Path, words: tuple[str, ...]) -> None:
    path, code = code_block(repo_root).split("\n", 1)
    command = [sys.executable, "-m", "ruff", *words, "--stdin-filename", path.removeprefix("# "), "-"]
    done = subprocess.run(command, cwd=repo_root, input=code, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_an_effect_of_a_stranger_is_fitted(stranger: Path) -> None:
    found = json.loads(run(stranger, "fit", "brake.csv", "--effect", "eddy_current_brake", "--json"))
    for name, true in TRUE.items():
        estimate = found["parameters"][name]
        assert estimate["std"] < 0.02 * true, name
        assert abs(estimate["value"] - true) < 4 * estimate["std"] + STEP_ERROR * true, (name, estimate)
    without = json.loads(run(stranger, "fit", "brake.csv", "--json"))
    assert without["residual"]["rmse"]["position_rad"] > 10 * found["residual"]["rmse"]["position_rad"]


def test_an_effect_of_a_stranger_is_simulated_and_filtered(stranger: Path) -> None:
    run(stranger, "simulate", "--out", "c.csv", "--seconds", "3", "--effect", "eddy_current_brake:Teddy=1,weddy=4")
    assert tracked(stranger, "c.csv", "eddy_current_brake").keys() >= {"Teddy", "weddy"}


def tracked(folder: Path, capture: str, effect: str) -> dict[str, tuple[float | None, float | None, str]]:
    """What the daemon's estimators with a model say at a capture's end: value, std and status by parameter."""
    (folder / "c.toml").write_text(f'[[drive]]\nmodel = ["{effect}"]\n', encoding="utf-8")
    run(folder, "replay", capture, "--config", "c.toml", "--out", "e.csv")
    with (folder / "e.csv").open(encoding="utf-8", newline="") as file:
        last = list(csv.DictReader(file))[-1]
    names = [name.removesuffix("_status") for name in last if name.endswith("_status") and not name.startswith("ekf_")]
    numbers = {n: [float(x) if x else None for x in (last[n], last[f"{n}_std"])] for n in names}
    return {n: (*numbers[n], last[f"{n}_status"]) for n in names}  # type: ignore[misc]


@pytest.mark.first_is_fast
@pytest.mark.parametrize(
    ("capture", "effect", "true"),
    [("brake.csv", "eddy_current_brake", TRUE), ("cubic.csv", "cubic_drag", {"c3": TRUE_C3})],
)
def test_beside_an_effect_of_a_stranger_the_motor_becomes_known(
    stranger: Path, capture: str, effect: str, true: dict[str, float]
) -> None:
    found = tracked(stranger, capture, effect)
    for name, value in {**MOTOR, **true}.items():
        estimate, std, status = found[name]
        assert status == "tracking", (name, found[name])
        assert estimate is not None
        assert std is not None
        assert abs(estimate - value) < 4 * std + STEP_ERROR * value, (name, found[name])
        assert std < 0.05 * value, name


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    ("capture", "effect", "true"),
    [("brake.csv", "eddy_current_brake", TRUE), ("cubic.csv", "cubic_drag", {"c3": TRUE_C3})],
)
def test_an_effect_of_a_stranger_is_diagnosed(
    stranger: Path, capture: str, effect: str, true: dict[str, float]
) -> None:
    found = json.loads(run(stranger, "diagnose", capture, "--json"))
    assert [named["name"] for named in found["effects"]] == [effect]
    for name, estimate in found["effects"][0]["parameters"].items():
        assert abs(estimate["value"] - true[name]) < 4 * estimate["std"] + STEP_ERROR * true[name], (name, estimate)


@pytest.mark.slow
def test_an_effect_of_a_stranger_is_excited(stranger: Path) -> None:
    (stranger / "x.toml").write_text(EXCITE, encoding="utf-8")
    words = ("--between", "eddy_current_brake", "cubic_drag", "--seconds", "4", "--json")
    plan = json.loads(run(stranger, "excite", "--config", "x.toml", "--out", "plan.csv", *words))
    told = {tuple(pair["truth"]) for pair in plan["separation"]}
    assert told == {("eddy_current_brake",), ("cubic_drag",)}
