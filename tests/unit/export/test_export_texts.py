"""The plant's equations in other languages, and what every file says of itself."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from servo_daemon.cli import main
from servo_daemon.commands.export.source import from_daemon, from_document
from servo_daemon.commands.shared import daemon_http
from servo_daemon.config import load_config
from servo_daemon.errors import BadInputError
from servo_daemon.export.balances import balances, expressible
from servo_daemon.export.expressions import PYTHON
from servo_daemon.export.model import ExportedModel, Value
from servo_daemon.export.targets import NAMES, target
from servo_daemon.export.words import identifier
from servo_daemon.plant.effects import dry_frictions, effects_by_name
from servo_daemon.signal_meaning import SignalMeaning
from tests.unit.export.motor import Exporting, document

COGGED = {"names": ("Tc", "Tcog", "n_cog", "phi_cog")}


def test_every_effects_terms_read_the_same_in_python() -> None:
    rng, checked = np.random.default_rng(1), 0
    for name, effect in effects_by_name().items():
        others = ("coulomb_friction",) if effect.scales_friction and name not in dry_frictions() else ()
        others += (effect.further,) if effect.further else ()
        model = ExportedModel("m", "s", "voltage", (*others, name), {}, {})
        b = balances(model)
        expressions = [b.current_rate, b.speed_rate, b.forward, b.backward, b.dry_drop, *b.states.values()]
        for _ in range(3):
            values = rng.uniform(0.1, 2.0, len(b.symbols)) * rng.choice([-1, 1], len(b.symbols))
            scope = {str(s.name()): float(v) for s, v in zip(b.symbols, values, strict=True)} | {"np": np}
            expected = ca.Function("f", [ca.vertcat(*b.symbols)], [ca.vertcat(*expressions)])(values)
            told = [eval(b.text(e, PYTHON), scope) for e in expressions]
            np.testing.assert_allclose(told, np.asarray(expected).ravel(), rtol=1e-9, err_msg=name)
        checked += expressible(name)
    assert checked > 15


def test_the_python_twin_runs_its_self_test_and_fails_it_with_another_motor(tmp_path: Path, export: Exporting) -> None:
    out = tmp_path / "twin.py"
    content = document("coulomb_friction", "cogging_torque", "freewheel_drive", **COGGED)
    assert export(content, "--to", "python", "--out", str(out))[0] == 0
    text = out.read_text()
    good = subprocess.run([sys.executable, out], capture_output=True, text=True, check=False)
    assert good.returncode == 0, good.stderr
    assert "self-test: at most" in good.stdout
    out.write_text(text.replace("\nK = 0.06\n", "\nK = 0.063\n"))
    assert subprocess.run([sys.executable, out], capture_output=True, check=False).returncode == 1


@pytest.mark.parametrize("name", [n for n in NAMES if n not in ("c", "fmu")])
def test_every_text_says_its_values_and_what_it_leaves_out(name: str, tmp_path: Path, export: Exporting) -> None:
    out = tmp_path / "out"
    names = ("Tc", "k_s", "c_s", "J_l")
    code, told = export(document("coulomb_friction", "shaft_compliance", names=names), "--to", name, "--out", str(out))
    assert code == 0, told
    text = out.read_text(encoding="utf-8")
    assert "0.06 ± 0.001 N·m/A" in text or (name == "json" and json.loads(text)["parameters"]["K"]["std"] == 1e-3)
    if name != "json":
        assert "shaft_compliance" in told
        assert "shaft_compliance" in text
        assert "J = 8e-05 kg·m² (J + J_l" in text  # no inertia is lost with the spring


def test_what_is_not_known_is_not_invented(tmp_path: Path, export: Exporting) -> None:
    lost = document("coulomb_friction", names=("Tc",), K={"value": None, "std": None, "status": "undetermined"})
    code, told = export(lost, "--to", "mujoco")
    assert code == 2
    assert "needs K" in told and "--fix K=" in told
    code, told = export(lost, "--to", "urdf", "--out", str(tmp_path / "a.urdf"))
    assert code == 0
    assert "K is not known" in told
    assert export(lost, "--to", "mujoco", "--fix", "K=0.06", "--out", str(tmp_path / "a.xml"))[0] == 0
    spring = document("shaft_compliance", names=("k_s", "c_s"))
    assert "--to urdf needs J_l" in export(spring, "--to", "urdf")[1]
    nothing = {name: {"value": None, "std": None, "status": "undetermined"} for name in ("J", "B")}
    assert "needs J, B or Tc, which" in export(document(**nothing), "--to", "urdf")[1]
    no_friction = document(B={"value": None, "std": None, "status": "undetermined"})
    assert export(no_friction, "--to", "python")[0] == 2


@pytest.mark.parametrize(
    "content",
    [
        {},
        {"verdict": "none"},
        {"model": 3, "parameters": {}, "input": "voltage"},
        {"model": [], "parameters": {"R": {"value": "x"}}, "input": "voltage"},
    ],
)
def test_what_is_no_such_document_is_refused_by_name(content: dict[str, Any], export: Exporting) -> None:
    code, told = export(content, "--to", "json")
    assert code == 2
    assert "fit.json" in told


def test_a_diagnosis_exports_the_model_it_found_with_its_gear(tmp_path: Path, export: Exporting) -> None:
    fit = document("coulomb_friction", names=("Tc",))
    extended = {"model": fit["model"], "parameters": fit["parameters"]}
    diagnosis = {"verdict": "found", "drive": "axis1", "baseline": document(), "extended": extended}
    diagnosis |= {"input": "voltage", "measured": [], "signals": fit["signals"]}
    out = tmp_path / "a.json"
    assert export(diagnosis, "--to", "json", "--out", str(out))[0] == 0
    found = json.loads(out.read_text())
    assert (found["name"], found["model"], found["gear_ratio"]) == ("axis1", ["coulomb_friction"], 5.0)


def test_a_configs_nominal_values_and_signals(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / "c.toml"
    config.write_text(
        '[[drive]]\nname = "a"\n[drive.nominal]\nR = 1.1\nL = 1e-3\nK = 0.06\nJ = 5e-5\nB = 3e-5\n'
        '[drive.signals]\nconvention = "dq"\npublish = "line"\npole_pairs = 7\ngear_ratio = 8\n'
        "[drive.limits]\nvoltage_V = 24\ncurrent_A = 10\nvelocity_rad_s = 400\n"
    )
    assert main(["export", "--config", str(config), "--to", "isaac"]) == 0
    text, _ = capsys.readouterr()
    scope: dict[str, Any] = {}
    exec(text, scope)
    assert scope["JOINT"] == pytest.approx(
        {
            "armature": 5e-5 * 64,
            "viscous_friction": 3e-5 * 64,
            "effort_limit_sim": 0.06 * 10 * 8,
            "velocity_limit_sim": 50,
        }
    )
    assert scope["DC_MOTOR"]["saturation_effort"] == pytest.approx(0.06 * 24 / 1.1 * 8)
    assert f"{np.sqrt(3):.9g} x v_q" in text
    assert "nominal, not estimated" in text


CONFIG = """
[[drive]]
name = "a"
[drive.limits]
current_A = 3.0
[[drive]]
name = "b"
[drive.limits]
current_A = 10.0
"""


def test_the_drive_of_the_config_is_the_one_that_the_source_names(
    tmp_path: Path, export: Exporting, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "c.toml").write_text(CONFIG)
    config = load_config(tmp_path / "c.toml")
    named = tmp_path / "named.json"
    named.write_text(json.dumps(document() | {"drive": "b"}))
    assert from_document(named, None, config).limits == {"current_A": 10.0}
    assert from_document(named, "a", config).limits == {"current_A": 3.0}
    code, told = export(document(), "--to", "json", "--drive", "b")
    assert code == 2
    assert "--drive b: " in told and "is of one drive" in told
    answers = {
        "/drives": {"drives": [{"name": "b"}]},
        "/drives/b": {},
        "/drives/b/estimates": {"time": None, "model": [], "parameters": document()["parameters"]},
    }
    monkeypatch.setattr(daemon_http, "document", lambda url, path: answers[path])
    assert from_daemon("http://127.0.0.1:8077", None, config).limits == {"current_A": 10.0}


@pytest.mark.parametrize(
    ("name", "written"), [("axis 1", "axis_1"), ("end", "drive_end"), ("R", "drive_R"), ("2", "drive_2")]
)
def test_a_drives_name_is_one_that_every_language_takes(name: str, written: str) -> None:
    assert identifier(name) == written


def test_a_daemons_estimates(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = {n: {**row, "status": "tracking", "reason": None} for n, row in document()["parameters"].items()}
    rows["L"] |= {"value": 2e-3, "std": None, "status": "estimating"}
    rows["B"] |= {"status": "invalid"}
    answers = {
        "/drives": {"drives": [{"name": "axis1"}]},
        "/drives/axis1": {"signals": {"convention": "dq", "publish": "line", "pole_pairs": 7, "gear_ratio": 3.0}},
        "/drives/axis1/estimates": {"time": "2026-11-21T12:45:21.103Z", "model": [], "parameters": rows},
    }
    monkeypatch.setattr(daemon_http, "document", lambda url, path: answers[path])
    model = from_daemon("http://127.0.0.1:8077", None, None)
    assert model.values["R"] == Value(1.1, 0.01, "Ω", "tracking")
    assert model.values["L"] == Value(2e-3, None, "H", "nominal, not estimated")
    assert "B" in model.missing
    assert model.gear_known
    assert model.meaning == SignalMeaning(convention="dq", publish="line", pole_pairs=7, gear_ratio=3.0)
    with pytest.raises(BadInputError, match="needs B"):
        target("mujoco").write(model)
