"""How large the drive's signals are: the units in which noise, offsets and small torques are measured."""

from __future__ import annotations

import math
from collections.abc import Mapping

from servo_daemon.estimators.stretch import Stretch
from servo_daemon.plant.build import PlantModel
from servo_daemon.samples import F64

#: A level falls by this factor a tick when the signal does: a rest of some seconds is no smaller motor.
_FALL = 0.99
#: Used where neither data nor nominal values say anything yet.
_R, _K = 1.0, 0.1


class Levels:
    """Mean squares of input and current over the last ticks, the larger ones remembered.

    Args:
        plant: whose input it is.
    """

    def __init__(self, plant: PlantModel) -> None:
        self._plant = plant
        self.input_square = 0.0  # V², A² or (N·m)²
        self.input_step_square = 0.0  # of the change from one sample to the next
        self.current_step_square = 0.0  # the same of the current, of the last tick
        self._current_square: float | None = None

    def take(self, tick: Stretch) -> None:
        """A tick's samples."""
        held = {"voltage": tick.voltage, "current": tick.current, "torque": tick.torque}[self._plant.drive]
        if held is not None and len(held):
            self.input_square = max(float(held @ held) / len(held), _FALL * self.input_square)
            self.input_step_square = max(_step_square(held), _FALL * self.input_step_square)
        if tick.current is not None and len(tick.current):
            self.current_step_square = _step_square(tick.current)
            square = float(tick.current @ tick.current) / len(tick.current)
            self._current_square = max(square, _FALL * (self._current_square or 0.0))

    def current_A(self, values: Mapping[str, float]) -> float:
        """Typical current: as measured, or what the rms voltage drives through the winding."""
        if self._current_square is not None:
            return math.sqrt(self._current_square)
        return math.sqrt(self.input_square) / values.get("R", _R)

    def torque_Nm(self, values: Mapping[str, float]) -> float:
        """Typical motor torque."""
        if self._plant.drive == "torque":
            return math.sqrt(self.input_square)
        return values.get("K", _K) * self.current_A(values)

    def scales(self, values: Mapping[str, float]) -> list[float]:
        """One unit of each parameter's coordinate, in the plant's order: 1 for logarithms and angles, else what is
        typical of its unit; never zero."""
        typical = {
            "N·m": self.torque_Nm(values),
            "A": self.current_A(values),
            "V": math.sqrt(self.input_square),
        }
        return [1.0 if p.transform == "log" else max(typical.get(p.unit, 1.0), 1e-12) for p in self._plant.parameters]


def _step_square(values: F64) -> float:
    """Mean square of the change from one sample to the next."""
    steps = values[1:] - values[:-1]
    return float(steps @ steps) / max(len(steps), 1)
