"""Causes that the fitted model lacks, and the same with the cause in the model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from tests.recovery.field.draws import Draw, pulses
from tests.recovery.field.dressed import Dressed
from tests.recovery.field.readings import written
from tests.recovery.generator import Motion, typical

_WITH = ("voltage_V", "current_A", "position_rad")
_WITHOUT = ("voltage_V", "position_rad")
#: Shares of the working torque or voltage.
_LEAST, _MOST = 0.05, 0.25


def _cause(
    name: str, columns: tuple[str, ...] = _WITH, *, motion: Motion | None = None, modelled: bool = False
) -> Callable[[Draw], Dressed]:
    def dressed(d: Draw) -> Dressed:
        share = float(d.rng.uniform(_LEAST, _MOST))
        effects = {name: {}} if name == "freewheel_drive" else typical(name, d.motor, share, seconds=8.0, rng=d.rng)
        made = written(d.run(motion, effects=effects), *columns, hidden=(name,))
        return replace(made, words=("--effect", name)) if modelled else made

    return dressed


DRESSINGS: Mapping[str, Callable[[Draw], Dressed]] = {
    "bridge open at zero": _cause("freewheel_drive", motion=pulses),
    "bridge open at zero, no current": _cause("freewheel_drive", _WITHOUT, motion=pulses),
    "bridge open at zero, no current, in the model": _cause("freewheel_drive", _WITHOUT, motion=pulses, modelled=True),
    "constant load": _cause("constant_load_torque"),
    "constant load, in the model": _cause("constant_load_torque", modelled=True),
    "constant load, no current": _cause("constant_load_torque", _WITHOUT),
    "dry friction": _cause("coulomb_friction"),
    "dry friction, in the model": _cause("coulomb_friction", modelled=True),
    "dry friction, no current": _cause("coulomb_friction", _WITHOUT),
    "dry friction, no voltage": _cause("coulomb_friction", ("current_A", "position_rad")),
    "drag": _cause("quadratic_drag"),
    "drag, no voltage": _cause("quadratic_drag", ("current_A", "position_rad")),
    "brush drop": _cause("brush_voltage_drop"),
}
