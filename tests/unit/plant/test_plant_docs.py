"""docs/model.md keeps up with the code: every parameter, effect and gain it lists is as the code has it."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from servo_daemon.parameters import LINEAR, Parameter
from servo_daemon.plant.effects import effects_by_name
from servo_daemon.plant.servo_loop import ServoGains

TEXT = (Path(__file__).parents[3] / "docs" / "model.md").read_text(encoding="utf-8")


def row(name: str) -> str:
    match = re.search(rf"^\| `{name}` \|.*$", TEXT, re.MULTILINE)
    assert match, f"docs/model.md has no row for {name}"
    return match[0]


@pytest.mark.parametrize("parameter", LINEAR, ids=lambda p: p.name)
def test_parameter_table(parameter: Parameter) -> None:
    _, symbol, unit, nominal, description = (cell.strip() for cell in row(parameter.name).strip("|").split("|"))
    assert (symbol, unit, description) == (parameter.symbol, parameter.unit, parameter.description)
    assert float(nominal) == parameter.nominal


@pytest.mark.parametrize("name", list(effects_by_name()))
def test_effect_table(name: str) -> None:
    line = row(name)
    for p in effects_by_name()[name].parameters:
        assert f"`{p.name}`" in line
        assert p.unit in line


def test_gains() -> None:
    gains = ServoGains()
    assert f"{gains.k_io:.3f} V/rad" in TEXT
    assert f"{gains.k_g:.4f} V·s/rad" in TEXT
    assert f"{gains.k_op:g} · {gains.k_au:g} · {gains.k_pu:g} · {gains.k_su:g} = {gains.k_s:g}" in TEXT


def test_poles_of_the_nominal_motor() -> None:
    R, L, K, J, B = (p.nominal for p in LINEAR)
    poles = np.linalg.eigvals(np.array([[-R / L, -K / L], [K / J, -B / J]]))
    assert f"poles at −{min(-poles):.0f} and −{max(-poles):.0f} 1/s" in TEXT
