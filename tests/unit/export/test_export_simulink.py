"""The m-file runs: GNU Octave, which reads MATLAB's language, has the plant's equations from it."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from servo_daemon.export import simulink
from servo_daemon.export.balances import balances
from servo_daemon.export.model import ExportedModel, Value
from servo_daemon.plant.effects import dry_frictions, effects_by_name


def models(rng: np.random.Generator) -> list[ExportedModel]:
    """One of each effect, with values of its own."""
    found = []
    for name, effect in effects_by_name().items():
        others = ("coulomb_friction",) if effect.scales_friction and name not in dry_frictions() else ()
        others += (effect.further,) if effect.further else ()
        bare = ExportedModel(f"m_{name}", "s", "voltage", (*others, name), {}, {})
        # Nine digits are written: none is lost of these. J_l: a second inertia is exported as on a stiff shaft.
        values = {n: Value(round(float(rng.uniform(0.1, 2.0)), 6), None, "", "x") for n in (*bare.needed, "J_l")}
        found.append(ExportedModel(bare.name, "s", "voltage", bare.effects, values, {}))
    return found


@pytest.mark.system
def test_octave_computes_the_plants_rates(tmp_path: Path, program: Callable[..., str]) -> None:
    rng = np.random.default_rng(5)
    expected, lines = [], ["format long;"]
    for model in models(rng):
        shown = balances(simulink.rigid(model, "simulink"))
        values = {n: v.value for n, v in simulink.rigid(model, "simulink").values.items()}
        at = {"t": 0.3, "u": 2.0} | {n: float(rng.uniform(-2.0, 2.0)) for n in ("i", "omega", "theta", *shown.states)}
        rates = ca.vertcat(shown.current_rate, shown.speed_rate, at["omega"], *shown.states.values())
        f = ca.Function(
            "f", [ca.vertcat(*shown.symbols)], [ca.vertcat(rates, shown.forward, shown.backward, shown.dry_drop)]
        )
        told = f([{**values, **at}[str(s.name())] for s in shown.symbols])
        expected.append([*np.asarray(told).ravel(), values["R"]])
        (tmp_path / f"{model.name}.m").write_bytes(simulink.write(model).content)
        states = [at[n] for n in ("i", "omega", "theta", *shown.states)]
        column = "; ".join(map(repr, states))
        arguments = ", ".join(map(repr, (0.3, 2.0, *states)))
        lines += [
            f'source("{tmp_path / model.name}.m");',
            f"y = [{model.name}.rates(0.3, [{column}], 2.0); {model.name}.dry_friction({arguments})'; "
            f"{model.name}.dry_drop({arguments}); {model.name}.R];",
            'printf("%.12g ", y); printf("\\n");',
        ]
    script = tmp_path / "all.m"
    script.write_text("\n".join(lines), encoding="utf-8")
    run = subprocess.run(
        [program("octave-cli", "octave"), "--norc", script], capture_output=True, text=True, check=False
    )
    rows = [[float(word) for word in line.split()] for line in run.stdout.splitlines()]
    assert len(rows) == len(expected), run.stderr
    for name, row, right in zip(effects_by_name(), rows, expected, strict=True):
        np.testing.assert_allclose(row, right, rtol=1e-8, err_msg=name)
