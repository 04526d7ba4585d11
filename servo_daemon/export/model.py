"""What is exported: a drive as it was identified, in SI units, at the motor's shaft and as a DC motor."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from servo_daemon.errors import BadInputError
from servo_daemon.parameters import MOTOR_NAMES
from servo_daemon.plant.core import Drive
from servo_daemon.plant.effects import effects_by_name
from servo_daemon.signal_meaning import SignalMeaning

#: Taken where nobody says how fast the drive samples, s: then effects are as the daemon's own step has them at 1 kHz.
ASSUMED_PERIOD_S = 1e-3
#: Parameters of the motor that a model needs, by what drives it.
CORE: Mapping[Drive, tuple[str, ...]] = {"voltage": MOTOR_NAMES, "current": ("K", "J", "B"), "torque": ("J", "B")}


@dataclass(frozen=True, slots=True)
class Value:
    """One parameter: `value` and 1 σ (None: not known) in `unit`; `origin`: where it comes from, in words."""

    value: float
    std: float | None
    unit: str
    origin: str


@dataclass(frozen=True, slots=True)
class ExportedModel:
    """A drive as it is handed to other tools.

    Attributes:
        name: of the drive.
        source: file, or daemon and drive, in words.
        effects: on top of the linear motor.
        values: parameters that are known, at the motor's shaft.
        missing: parameters of the model that are not, and why.
        linear: the axis moves along a line: units are m, N and kg.
        meaning: how the drive's own signals become those of this motor.
        gear_known: the source says how the encoder is geared.
        sample_period_s: of the drive; None: not known.
        limits: `voltage_V`, `current_A`, `velocity_rad_s` as far as they are known, at the motor's shaft.
    """

    name: str
    source: str
    drive: Drive
    effects: tuple[str, ...]
    values: Mapping[str, Value]
    missing: Mapping[str, str]
    linear: bool = False
    meaning: SignalMeaning = field(default_factory=SignalMeaning)
    gear_known: bool = True
    limits: Mapping[str, float] = field(default_factory=dict)
    sample_period_s: float | None = None

    @property
    def gear(self) -> float:
        """Turns of the motor for one of the output."""
        return self.meaning.gear_ratio

    @property
    def needed(self) -> tuple[str, ...]:
        """Parameters that a simulation of the whole model needs."""
        own = (p.name for name in self.effects for p in effects_by_name()[name].parameters)
        return tuple(dict.fromkeys((*CORE[self.drive], *own)))

    def get(self, name: str) -> float | None:
        """A value, where it is known."""
        return self.values[name].value if name in self.values else None

    def require(self, names: Iterable[str], target: str) -> dict[str, float]:
        """Values that a target cannot do without.

        Raises:
            BadInputError: one is not known; nothing is put in its place.
        """
        names = tuple(names)
        if lost := [name for name in names if name not in self.values]:
            raise self.lacking(lost, ", ".join(lost), target)
        return {name: self.values[name].value for name in names}

    def lacking(self, lost: Sequence[str], needed: str, target: str) -> BadInputError:
        """What a target needs, why the source does not tell it, and what to do."""
        by_reason: dict[str, list[str]] = {}
        for name in lost:
            by_reason.setdefault(self.missing.get(name, "not in the model"), []).append(name)
        why = "; ".join(f"{', '.join(names)}: {reason}" for reason, names in by_reason.items())
        return BadInputError(
            f"--to {target} needs {needed}, which {self.source} does not tell ({why}): give what you know with "
            f"--fix {lost[0]}=…, to `fit` if others can follow from it, or choose another target"
        )


@dataclass(frozen=True, slots=True)
class Export:
    """What a target makes of a model.

    Attributes:
        content: of the file.
        notes: what the target cannot express, and other remarks, in words.
        beside: further files that belong into the same folder, by their names.
    """

    content: bytes
    notes: tuple[str, ...]
    beside: Mapping[str, bytes] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Target:
    """A kind of file.

    Attributes:
        suffix: what its name ends in.
        write: makes it. Raises BadInputError: the model lacks a parameter that it needs.
    """

    name: str
    suffix: str
    write: Callable[[ExportedModel], Export]
