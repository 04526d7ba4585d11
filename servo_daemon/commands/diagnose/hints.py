"""Which experiment tells two causes apart that leave the same trace in a capture.

Each hint says what one of the two does and the other does not. They follow from the equations in `plant/effects/`; none
is computed from the capture.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

_DRY = ("coulomb_friction", "asymmetric_friction", "stribeck_friction")
_ANGLE = ("gravity_load", "cogging_torque", "torque_ripple", "encoder_eccentricity")
_EVENT = ("load_torque_step", "resistance_step")

_REVERSALS = "slow reversals through standstill, a few seconds each way"
#: Of a pair, whichever is named first.
_PAIRS: Mapping[frozenset[str], str] = {
    frozenset(pair): text
    for pair, text in (
        (
            ("coulomb_friction", "brush_voltage_drop"),
            "lock the shaft and step the voltage: friction leaves no trace then, a brush drop its volts. Or record "
            "the current: friction raises it, a brush drop does not.",
        ),
        (
            ("coulomb_friction", "load_dependent_friction"),
            f"{_REVERSALS}, once idle and once with a second load: load friction grows with it, Coulomb does not.",
        ),
        (
            ("coulomb_friction", "stribeck_friction"),
            f"{_REVERSALS}, so slow that the axis sticks: only Stribeck friction falls as it starts to slide.",
        ),
        (
            ("coulomb_friction", "quadratic_drag"),
            "hold several constant speeds up to the highest: drag grows with the square of the speed, Coulomb stays.",
        ),
        (
            ("coulomb_friction", "backlash"),
            "let it reverse without load and watch the angle: in a gap the motor turns freely, in friction it stands.",
        ),
        (
            ("asymmetric_friction", "constant_load_torque"),
            "turn the axis round, or take the load off: a load keeps its direction in space, friction that of motion.",
        ),
        (
            ("constant_load_torque", "current_sensor_offset"),
            "record a few seconds with the drive off: what the current sensor shows then is its offset.",
        ),
        (
            ("constant_load_torque", "voltage_sensor_offset"),
            "record a few seconds with the output shorted or off: what is shown then is an offset, not a load.",
        ),
        (
            ("current_sensor_offset", "voltage_sensor_offset"),
            "record a few seconds with the drive off: each sensor shows its own offset then.",
        ),
        (
            ("cogging_torque", "torque_ripple"),
            "turn slowly through a revolution, once idle and once under load: ripple grows with the current, cogging "
            "is there without any.",
        ),
        (
            ("cogging_torque", "encoder_eccentricity"),
            "let it coast with the drive off: cogging still pulls the speed, an eccentric encoder only seems to.",
        ),
        (
            ("gravity_load", "encoder_eccentricity"),
            "turn slowly by hand or hold several angles: gravity takes current to hold, an eccentric encoder none.",
        ),
        (
            ("gravity_load", "cogging_torque"),
            "turn slowly through whole revolutions: gravity comes once a turn, cogging as often as there are poles.",
        ),
        (
            ("cogging_torque", "periodic_disturbance"),
            "repeat it at another speed: cogging stays with the angle, a disturbance with the clock.",
        ),
        (
            ("torque_ripple", "periodic_disturbance"),
            "repeat it at another speed: ripple stays with the angle, a disturbance with the clock.",
        ),
        (
            ("brush_voltage_drop", "resistance_step"),
            "hold several currents for a second each: a brush drop is the same at all of them, R i is not.",
        ),
        (
            ("winding_heating", "resistance_step"),
            "let it cool and start again: heat comes back slowly, a bad contact comes and goes at once.",
        ),
        (
            ("winding_heating", "magnetic_saturation"),
            "short pulses of high current, with pauses: saturation follows each at once, heat does not.",
        ),
        (
            ("current_sensor_gain", "magnetic_saturation"),
            "measure the back-EMF: turn it by hand with the drive off, and hold that K against the torque's.",
        ),
        (
            ("freewheel_drive", "coulomb_friction"),
            "command zero at speed: an open bridge lets the motor coast, a closed one brakes it with its own back-EMF.",
        ),
        (
            ("drive_lag", "measurement_delay"),
            "excite higher frequencies: a lag also lowers the amplitude, a delay only turns the phase.",
        ),
        (
            ("drive_lag", "shaft_compliance"),
            "excite higher frequencies: a spring has a resonance, a lag has none.",
        ),
        (
            ("shaft_compliance", "backlash"),
            "small motions under a constant load, then about zero torque: a gap shows only where the sign changes.",
        ),
    )
}
#: Where the pair has no line of its own: by what kind of thing the two are; the first that fits.
_KINDS: tuple[tuple[Sequence[str], Sequence[str], str], ...] = (
    (_DRY, _DRY, f"{_REVERSALS}, and constant speeds over the whole range in both directions."),
    (_ANGLE, _ANGLE, "turn slowly through several revolutions, at two speeds and two loads."),
    (_EVENT, _EVENT, "hold current and speed constant over the event: only a load changes the torque balance."),
)
_ANY = "a second capture with another motion (slow reversals, several constant speeds) and a second load."


def experiment(name: str, others: Sequence[str]) -> str:
    """What to record so that the effect and what these data could not tell from it come apart."""
    base = _without_number(name)
    for other in map(_without_number, others):
        if (text := _PAIRS.get(frozenset((base, other)))) is not None:
            return text
        for mine, theirs, text in _KINDS:
            if (base in mine and other in theirs) or (base in theirs and other in mine):
                return text
    return _ANY


def _without_number(name: str) -> str:
    """`cogging_torque_2` is a cogging torque."""
    stem, _, end = name.rpartition("_")
    return stem if end.isdigit() else name
