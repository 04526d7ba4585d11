"""Gazebo's own library loads what is written for it, with the numbers of the output."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

import pytest

from servo_daemon.export import sdf
from servo_daemon.export.model import ExportedModel
from tests.unit.export.motor import VALUES, document

GEAR = 5.0
LIMITS = {"current_A": 10.0, "velocity_rad_s": 400.0}
V = {name: value for name, (value, _, _) in VALUES.items()}
pytestmark = [pytest.mark.slow, pytest.mark.system]  # the compiler takes 3 s over the library's headers

CHECKER = Path(__file__).with_name("sdf_joint.cpp")

Loaded = Callable[[ExportedModel], dict[str, float]]


@pytest.fixture(scope="module")
def loaded(
    tmp_path_factory: pytest.TempPathFactory, program: Callable[..., str], missing: Callable[[str], NoReturn]
) -> Loaded:
    """What libsdformat makes of a model's file."""
    folder = tmp_path_factory.mktemp("sdf")
    compiler, config = program("g++"), program("pkg-config")
    for version in range(20, 11, -1):  # Debian 12 has 12; a package carries its major version in its name
        said = subprocess.run(
            [config, "--cflags", "--libs", f"sdformat{version}"], capture_output=True, text=True, check=False
        )
        if said.returncode == 0:
            break
    else:
        missing("libsdformat-dev")
    checker = folder / "sdf_joint"
    subprocess.run([compiler, "-std=c++17", str(CHECKER), "-o", str(checker), *said.stdout.split()], check=True)

    def load(model: ExportedModel) -> dict[str, float]:
        path = folder / "joint.sdf"
        path.write_bytes(sdf.write(model).content)
        told = subprocess.run([checker, path], capture_output=True, text=True, check=False)
        assert told.returncode == 0 and not told.stderr, told.stderr
        return {name: float(value) for name, value in (line.split() for line in told.stdout.splitlines())}

    return load


@pytest.mark.parametrize(
    ("effects", "names", "friction"),
    [
        ((), (), 0.0),
        (("coulomb_friction", "cogging_torque"), ("Tc", "Tcog", "n_cog", "phi_cog"), V["Tc"]),
        (("stribeck_friction",), ("Tc", "Ts", "ws"), V["Tc"]),
    ],
    ids=["linear motor", "friction and cogging", "stribeck"],
)
def test_gazebos_library_reads_the_joint(
    effects: tuple[str, ...], names: tuple[str, ...], friction: float,
    loaded: Loaded, model_of: Callable[..., ExportedModel],
) -> None:  # fmt: skip
    joint = loaded(replace(model_of(document(*effects, names=names, gear=GEAR)), limits=LIMITS))
    assert joint == pytest.approx(
        {
            "prismatic": 0.0,
            "damping": V["B"] * GEAR**2,
            "friction": friction * GEAR,
            "effort": V["K"] * LIMITS["current_A"] * GEAR,
            "velocity": LIMITS["velocity_rad_s"] / GEAR,
            "mass": 1.0,
            "inertia": V["J"] * GEAR**2,
        }
    )


def test_an_axis_along_a_line_is_a_mass_on_a_prismatic_joint(
    loaded: Loaded, model_of: Callable[..., ExportedModel]
) -> None:
    content = document("coulomb_friction", names=("Tc",), gear=1.0) | {"measured": ["current_A", "position_m"]}
    joint = loaded(model_of(content))
    assert (joint["prismatic"], joint["friction"]) == (1.0, V["Tc"])
    assert joint["mass"] == pytest.approx(V["J"])
    assert not 0.0 < joint["effort"] < 1e15  # no limit is known, none is set
