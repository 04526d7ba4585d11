"""What the voltage and the current of a drive are, and how they become those of a DC motor.

The drives that people own are brushless motors under field-oriented control. They report the q axis of the
amplitude-invariant dq frame, whose power is 1.5 v i, as values of one instant or as means over what passed. The plant
knows a DC motor (power v i). So samples are converted once, where they come in: v and i each take a factor, and the
two together 1.5. Three choices are in use; which one the published R, L and K are in is `publish`:

    publish   v factor    i factor     R          L        K                  as in
    phase     √1.5        √1.5         R_phase    L_q      √1.5 p λ           the drive's own calibration
    line      √3          √3/2         2 R_phase  2 L_q    √3 p λ = 1/KV      the datasheet: terminal to terminal
    kt        1.5         1            1.5 R      1.5 L_q  1.5 p λ = Kt       a torque constant per ampere of i_q

p pole pairs, λ the rotor's flux. J, B and every torque are the same in all three.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from servo_daemon.errors import BadInputError
from servo_daemon.samples import SampleBlock

VOLTAGES = ("held", "instant", "mean")
CURRENTS = ("instant", "mean")
CONVENTIONS = ("dc", "dq")
PUBLISHED = ("phase", "line", "kt")
#: A period at 20 kHz: drives under FOC run at 8 to 40 kHz.
CONTROL_PERIOD_S = 5e-5
#: Fields that are numbers from 0 on.
_FROM_ZERO = ("truncated_A", "truncated_V", "current_late_s", "voltage_scale_std", "control_period_s")
_CHOICES = {"voltage": VOLTAGES, "current": CURRENTS, "convention": CONVENTIONS, "publish": PUBLISHED}

#: Factors, gear, steps and current of samples that are a DC motor's already.
_AS_IT_IS = (1.0, 1.0, 1.0, 0.0, 0.0, "instant")
#: Factors of the q axis's voltage and current by what is published: their product is the 1.5 of the dq frame's power.
_FACTORS: Mapping[str, tuple[float, float]] = {
    "phase": (math.sqrt(1.5), math.sqrt(1.5)),
    "line": (math.sqrt(3.0), math.sqrt(3.0) / 2.0),
    "kt": (1.5, 1.0),
}


@dataclass(frozen=True, slots=True)
class SignalMeaning:
    """What the signals of a drive mean.

    Attributes:
        voltage: `held` (applied from this sample until the next), `instant` (its value at the sample's instant,
            changing in between), `mean` (over the interval that ends at this sample).
        current: `instant` or `mean`.
        convention: `dc`, or `dq` (q axis, amplitude-invariant: the power is 1.5 v i).
        publish: with `dq`, which equivalent DC motor R, L and K are of: `phase`, `line` or `kt`.
        pole_pairs: of the motor, from 1 on.
        gear_ratio: turns of the motor for one turn of what the position is measured at, greater than 0.
        truncated_A, truncated_V: steps in which current and voltage are cut off toward zero, as the drive reports them;
            0: they are not. A value is then on average half a step further from zero than it says.
        current_late_s: how far the current is behind angle and speed, s: the delay of a filter in the drive.
        voltage_scale_std: 1 σ of one factor that the voltage as a whole may be off by, a share: of a voltage that is a
            share of the supply, as far as the supply is known.
        control_period_s: for how long the drive's control holds a voltage, s: so far apart may be the moments that
            voltage and current are of.

    Raises:
        BadInputError: a value is none of these; the text names the field.
    """

    voltage: str = "held"
    current: str = "instant"
    convention: str = "dc"
    publish: str = "phase"
    pole_pairs: int = 1
    gear_ratio: float = 1.0
    truncated_A: float = 0.0
    truncated_V: float = 0.0
    current_late_s: float = 0.0
    voltage_scale_std: float = 0.0
    control_period_s: float = CONTROL_PERIOD_S

    def __post_init__(self) -> None:
        for name, known in _CHOICES.items():
            value = getattr(self, name)
            if value not in known:
                raise BadInputError(f"{name} = {value!r} is none of {', '.join(known)}")
        if isinstance(self.pole_pairs, bool) or not isinstance(self.pole_pairs, int) or self.pole_pairs < 1:
            raise BadInputError(f"pole_pairs = {self.pole_pairs!r} must be a whole number from 1 on")
        if not (isinstance(self.gear_ratio, int | float) and math.isfinite(self.gear_ratio) and self.gear_ratio > 0.0):
            raise BadInputError(f"gear_ratio = {self.gear_ratio!r} must be a number greater than 0")
        for name in _FROM_ZERO:
            step = getattr(self, name)
            if not (isinstance(step, int | float) and math.isfinite(step) and step >= 0.0):
                raise BadInputError(f"{name} = {step!r} must be a number from 0 on")

    @property
    def measures_voltage(self) -> bool:
        """Whether the voltage is a measurement of the winding's balance, and not what was applied until the next."""
        return self.voltage != "held"

    @property
    def of_means(self) -> bool:
        """Whether the winding's balance is that of means over intervals: of a voltage that is one, or of a held one
        beside a current that is."""
        return self.voltage == "mean" or (self.voltage == "held" and self.current == "mean")

    @property
    def follows_current(self) -> bool:
        """Whether a live filter is driven by the current, and the winding left to its balance: a measured voltage is
        not what acts until the next sample, and a mean of the current not what a filter's step ends with."""
        return self.measures_voltage or self.current == "mean"

    @property
    def may_hold_voltage(self) -> bool:
        """Whether the drive may hold a voltage that is not in its samples for whole ones: neither its voltage nor its
        current is measured as that of a control loop which is faster."""
        return not self.follows_current

    @property
    def words(self) -> str:
        """What the voltage is, for a reason."""
        return {"held": "held beside a mean of the current", "instant": "an instant's", "mean": "a mean"}[self.voltage]

    @property
    def factors(self) -> tuple[float, float]:
        """By which voltage and current as the drive reports them become those of the DC motor."""
        return _FACTORS[self.publish] if self.convention == "dq" else (1.0, 1.0)

    def equivalents(self) -> dict[str, dict[str, float]]:
        """By the other choices of `publish`: factors of R, L and K from what is published to theirs."""
        if self.convention == "dc":
            return {}
        v, i = self.factors
        others = {name: _FACTORS[name] for name in PUBLISHED if name != self.publish}
        return {n: {"R": (a / b) / (v / i), "L": (a / b) / (v / i), "K": a / v} for n, (a, b) in others.items()}

    @property
    def document(self) -> dict[str, Any]:
        """What published values are of, as JSON documents have it: the DC motor at the motor's shaft."""
        return {key: getattr(self, key) for key in ("convention", "publish", "pole_pairs", "gear_ratio")}

    def converted(self, block: SampleBlock) -> SampleBlock:
        """The block with the DC motor's voltage and current, and position, speed and torque of the motor's shaft.

        Samples of a drive with `dc`, no gear and an instant's current are returned as they are.
        """
        v, i = self.factors
        n = self.gear_ratio
        if (v, i, n, self.truncated_V, self.truncated_A, self.current) == _AS_IT_IS:
            return block
        factors = {"voltage_V": v, "current_A": i, "position_rad": n, "velocity_rad_s": n, "torque_Nm": 1.0 / n}
        steps = {"voltage_V": self.truncated_V, "current_A": self.truncated_A}
        changed: dict[str, Any] = {
            name: factor * (array + 0.5 * step * np.sign(array) if (step := steps.get(name, 0.0)) else array)
            for name, factor in factors.items()
            if (factor != 1.0 or steps.get(name)) and (array := getattr(block, name)) is not None
        }
        if self.current == "mean" and not block.current_mean:
            changed["current_mean"] = True
        return replace(block, **changed) if changed else block

    @property
    def as_dc(self) -> SignalMeaning:
        """Of samples that `converted` has gone over."""
        return replace(self, convention="dc", gear_ratio=1.0, truncated_A=0.0, truncated_V=0.0)

    def with_keys(self, given: Mapping[str, Any]) -> SignalMeaning:
        """The same with some fields given otherwise.

        Raises:
            BadInputError: a value is impossible; the text names the field.
        """
        return replace(self, **given) if given else self


def _whole(text: str) -> int:
    """A whole number, also as "7.0".

    Raises:
        ValueError: it is none.
    """
    number = float(text)
    if not number.is_integer():
        raise ValueError
    return int(number)


#: Names of the fields: keys of `[drive.signals]` and of a capture's metadata.
KEYS = tuple(f.name for f in fields(SignalMeaning))


def keys_of_texts(texts: Mapping[str, str]) -> dict[str, Any]:
    """What a capture's metadata tell of the meaning, by field. A `voltage` or `current` that begins with a digit is a
    note of somebody's (`# voltage: 24 V`) and none of it.

    Raises:
        BadInputError: a value is impossible; the text names the key.
    """
    given: dict[str, Any] = {key: texts[key].strip() for key in KEYS if key in texts}
    for key in ("voltage", "current"):
        if key in given and given[key][:1] in "0123456789.+-":
            del given[key]
    readers: dict[str, Callable[[str], float]] = {"pole_pairs": _whole}
    for key in ("pole_pairs", "gear_ratio", *_FROM_ZERO):
        if key in given:
            try:
                given[key] = readers.get(key, float)(given[key])
            except (ValueError, OverflowError):
                raise BadInputError(f"{key} = {given[key]!r} is not such a number") from None
    SignalMeaning(**given)
    return given


def as_texts(meaning: SignalMeaning) -> dict[str, str]:
    """As metadata of a capture: every field, for a capture's own lines stand above a configuration."""
    return {k: f"{v!r}" if isinstance(v := getattr(meaning, k), float) else str(v) for k in KEYS}


def told(meaning: SignalMeaning, channels: Collection[str] = ("voltage_V", "current_A")) -> str:
    """In one line, for the user.

    Args:
        channels: that the drive has: of others nothing is said.
    """
    kinds = {"voltage_V": f"voltage {meaning.voltage}", "current_A": f"current {meaning.current}"}
    parts = [text for name, text in kinds.items() if name in channels]
    if meaning.convention == "dq":
        v, i = meaning.factors
        pairs = f"{meaning.pole_pairs} pole pairs"
        parts.append(f"dq of {pairs}, {meaning.publish} values (voltage × {v:.4g}, current × {i:.4g})")
    if meaning.gear_ratio != 1.0:
        parts.append(f"gear {meaning.gear_ratio:g}: at the motor's shaft")
    if meaning.truncated_A or meaning.truncated_V:
        parts.append("cut off toward zero: half a step is added")
    if meaning.current_late_s:
        parts.append(f"current {1e3 * meaning.current_late_s:g} ms late")
    if meaning.control_period_s > CONTROL_PERIOD_S:
        parts.append(f"voltage held for {1e3 * meaning.control_period_s:g} ms")
    if meaning.voltage_scale_std:
        parts.append(f"voltage known to {100.0 * meaning.voltage_scale_std:.2g} %")
    return ", ".join(parts)
