"""A Modelica compiler loads what is written for it, and moves the motor as the plant does."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rumoca

from servo_daemon.export import modelica
from servo_daemon.export.model import ExportedModel
from servo_daemon.export.reference import simulated
from tests.unit.export.motor import VALUES, document

V = {name: value for name, (value, _, _) in VALUES.items()}
#: The compiler comes without Modelica's standard library: the parts of it that the export uses, by their interfaces.
LIBRARY = Path(__file__).with_name("Modelica.mo").read_text(encoding="utf-8")
#: Both ways, and let go: V, held for `HELD_S`.
STEPS = (3.0, -2.0, 0.0, 4.0)
HELD_S = 0.08
PERIOD_S = 5e-4
#: Of each signal's range: friction is smooth in the library, and the solver's own error.
TOLERANCE = 2e-3
BENCH = """
model Supply
  Modelica.Electrical.Analog.Interfaces.PositivePin p;
  Modelica.Electrical.Analog.Interfaces.NegativePin n;
equation
  n.v = 0;
  p.v = {voltage};
end Supply;
model Bench
  fit motor;
  Supply supply;
equation
  connect(supply.p, motor.p);
  connect(supply.n, motor.n);
end Bench;
"""


def compiled(model: ExportedModel, bench: str, name: str) -> rumoca.Model:
    text = modelica.write(model).content.decode()
    return rumoca.Session().loads("\n".join((LIBRARY, text, bench)), model=name)


def held(values: tuple[float, ...]) -> str:
    text = f"{values[-1]}"
    for k in reversed(range(len(values) - 1)):
        text = f"if time < {(k + 1) * HELD_S} then {values[k]} else {text}"
    return text


@pytest.mark.parametrize(
    ("effects", "names"),
    [
        ((), ()),
        (("coulomb_friction", "cogging_torque"), ("Tc", "Tcog", "n_cog", "phi_cog")),
        (("stribeck_friction",), ("Tc", "Ts", "ws")),
        (("gravity_load", "quadratic_drag", "winding_heating"), ("Tg", "phi_g", "c2", "R_th", "C_th")),
    ],
    ids=["linear motor", "friction and cogging", "stribeck", "gravity, drag and heat"],
)
def test_a_compiler_moves_it_as_the_plant(
    effects: tuple[str, ...], names: tuple[str, ...], model_of: Callable[..., ExportedModel]
) -> None:
    model = model_of(document(*effects, names=names))
    sim = compiled(model, BENCH.format(voltage=held(STEPS)), "Bench")
    for name in ("R", "L", "K", "J", "B"):
        assert sim.parameters[f"motor.{name}"].value == pytest.approx(V[name])
    steps = round(HELD_S / PERIOD_S)
    told = sim.simulate(t=(0.0, len(STEPS) * HELD_S), dt=PERIOD_S)
    at = np.arange(steps * len(STEPS)) * PERIOD_S  # an event of the solver is a sample of its own
    states = ("motor.i", "motor.rotor.w", "motor.rotor.phi", "motor.gear.flange_b.phi")
    signals = np.array([np.interp(at, told.time, told[name]) for name in states]).T
    expected = simulated(model, np.repeat(STEPS, steps), PERIOD_S).x[:-1, :3]
    error = np.sqrt(np.mean((signals[:, :3] - expected) ** 2, axis=0)) / np.ptp(expected, axis=0)
    assert np.all(error < TOLERANCE), error
    np.testing.assert_allclose(signals[:, 3], signals[:, 2] / 5.0)
