"""What the temperature does to a parameter: taken out where it is known, found from the series where it is not."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from servo_daemon.plant.effects.winding_heating import ALPHA_COPPER_1_K
from servo_daemon.samples import F64

#: Values are compared at this temperature, °C.
REFERENCE_C: Final = 25.0
#: `ALPHA_COPPER_1_K` is of 20 °C; of 25 °C, 1/K.
COPPER_1_K: Final = ALPHA_COPPER_1_K / (1.0 + ALPHA_COPPER_1_K * (REFERENCE_C - 20.0))


@dataclass(frozen=True, slots=True)
class TemperatureEffect:
    """On one parameter.

    Attributes:
        known_1_K: relative change a kelvin at 25 °C that is taken out; 0: none is known.
        further_1_K: standard deviation of what there may be beside it, found from the series.
        season: of each half of the yearly wave that remains where the temperature is known, and where it is not.
        remark: for the user, where nothing is taken out.
    """

    known_1_K: float
    further_1_K: float
    season: tuple[float, float]
    remark: str | None = None


#: A year's swing of the ambient is 5 to 15 K (monthly means of a workshop that is not heated, central Europe), so
#: that a coefficient of c a kelvin makes waves of about 10 c.
_SWING_K: Final = 10.0
#: Where the temperature is known a tenth of the wave may be left: the sensor is not where the copper is.
_LEFT: Final = 0.1


def _effect(known: float, further: float, remark: str | None = None) -> TemperatureEffect:
    wave = _SWING_K * max(known, further)
    return TemperatureEffect(known, further, (_LEFT * wave, wave), remark)


_MAGNETS: Final = (
    "the magnets' temperature coefficient is not known (ferrite -0.2 %/K, NdFeB -0.1 %/K); what follows the "
    "temperature is found from the data and is no ageing"
)
_ELSEWHERE: Final = (
    "the temperature is not said to be the winding's ([drive.signals] temperature): what follows it is found from the "
    "data and is no ageing, and R is not given at 25 °C"
)
_FRICTION: Final = "what follows the temperature (grease) is found from the data and is no ageing"
_BY_PARAMETER: Final = {
    "R": _effect(COPPER_1_K, 0.25 * COPPER_1_K),  # a sensor beside the winding shows some three quarters of its swing
    "K": _effect(0.0, 0.002, _MAGNETS),
    "B": _effect(0.0, 0.02, _FRICTION),  # base oils halve their viscosity in 15 to 35 K (ISO 2909)
    "Tc": _effect(0.0, 0.01, _FRICTION),
}
_OTHER: Final = _effect(0.0, 0.001)
#: Of a sensor elsewhere (power stage, housing) copper may follow as much as all of its swing, or nothing.
_COPPER_ELSEWHERE: Final = _effect(0.0, COPPER_1_K, _ELSEWHERE)


def effect_on(parameter: str, *, of_winding: bool) -> TemperatureEffect:
    """What is known of a parameter by its name.

    Args:
        of_winding: whether it is the winding's temperature.
    """
    if parameter == "R" and not of_winding:
        return _COPPER_ELSEWHERE
    return _BY_PARAMETER.get(parameter, _OTHER)


def at_reference(effect: TemperatureEffect, value: F64, temperature_C: F64) -> F64:
    """Values as they would be at 25 °C, by what is known."""
    return value / (1.0 + effect.known_1_K * (temperature_C - REFERENCE_C))
