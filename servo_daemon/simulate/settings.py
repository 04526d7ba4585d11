"""What is simulated: motor, effects, ageing, servo, sensors, resolved from the texts and tables a user gives."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from servo_daemon.errors import BadInputError
from servo_daemon.parameters import J_M, LINEAR, Parameter
from servo_daemon.plant.ageing import Ageing, ageing_texts, parse_ageing
from servo_daemon.plant.build import PlantModel, build_plant
from servo_daemon.plant.effects import effects_by_name, further_harmonics, unknown_effect
from servo_daemon.plant.servo_loop import ServoGains, suitable_gains
from servo_daemon.simulate.motion import Motion, MotionName
from servo_daemon.simulate.visible import VISIBLE

#: The paper's motor (its section 2, method 2).
PAPER_MOTOR: Mapping[str, float] = {p.name: p.nominal for p in LINEAR}

#: Inertia of the paper's motor without its load; ours, so that there is a J_d = J − J_m to follow.
DEFAULT_J_M = 0.0081

#: What the daemon is told about the simulated motor when it runs without a configuration: 34–42 % off.
DEFAULT_NOMINAL: Mapping[str, float] = {
    "R": PAPER_MOTOR["R"] * 1.42,
    "L": PAPER_MOTOR["L"] * 1.40,
    "K": PAPER_MOTOR["K"] * 0.65,
    "J": PAPER_MOTOR["J"] * 1.38,
    "B": PAPER_MOTOR["B"] * 0.66,
    "J_m": DEFAULT_J_M,
}

#: How that motor ages: visible within minutes, settled after an hour, alive for ever.
DEFAULT_AGEING: Mapping[str, Sequence[str]] = {
    "R": ("+25%/20min", "0.3%/sqrt(min):walk"),  # winding warms, brushes wear
    "K": ("-12%/30min:exp", "0.1%/sqrt(min):walk"),  # magnets weaken with temperature and age
    "B": ("+30%/25min", "0.3%/sqrt(min):walk"),  # grease stiffens
    "L": ("-8%/40min",),
    "J_d": ("+0.001/30min", "+0.0008@10min"),  # the load grows, then something is clamped on
}


@dataclass(frozen=True, slots=True)
class Sensors:
    """What the record shows of the truth. Everything random is Gaussian and independent from sample to sample.

    Attributes:
        counts_per_rev: encoder counts, 4 × lines; 0 for a continuous position.
        current_range_A: of the converter, ±; currents beyond it clip and are flagged; 0 for no limit.
        current_bits: of the converter; 0 for continuous values.
        current_noise_A: 1 σ.
        voltage_lsb_V: resolution of the output stage: the applied voltage is a multiple of it; 0 for continuous.
        voltage_noise_V: 1 σ of the record against the voltage that was asked for and applied.
        hidden_voltage_V: 1 σ of a voltage that acts on the motor and is not in the record.
        position_noise_rad: 1 σ, before the encoder counts.
        velocity_noise_rad_s: 1 σ of the recorded tacho, where the record has one.
        jitter_s: sample times lie within ± this of the even grid; the record shows the true time.
        time_lsb_s: resolution of the recorded time.
        channels: what is recorded.
    """

    counts_per_rev: float = 8192.0
    current_range_A: float = 50.0
    current_bits: int = 14
    current_noise_A: float = 0.06
    voltage_lsb_V: float = 48.0 / 8192.0
    voltage_noise_V: float = 0.0
    hidden_voltage_V: float = 0.0
    position_noise_rad: float = 0.0
    velocity_noise_rad_s: float = 0.02
    jitter_s: float = 1e-5
    time_lsb_s: float = 1e-6
    channels: tuple[str, ...] = ("voltage_V", "current_A", "position_rad")

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if f.name != "channels" and not (math.isfinite(value) and value >= 0):
                raise BadInputError(f"{f.name} must be a number of at least 0, not {value!r}")
        known = ("voltage_V", "current_A", "position_rad", "velocity_rad_s")
        unknown = [c for c in self.channels if c not in known]
        if unknown or not self.channels:
            raise BadInputError(f"channels must be some of {', '.join(known)}, not {', '.join(unknown) or 'none'}")

    @property
    def current_lsb_A(self) -> float:
        """One step of the current converter; 0 if continuous."""
        if not (self.current_bits and self.current_range_A):
            return 0.0
        return 2.0 * self.current_range_A / 2.0**self.current_bits


@dataclass(frozen=True)
class Settings:
    """A complete simulation; `make_settings` fills in what a user leaves out."""

    model: PlantModel
    ageing: Ageing
    gains: ServoGains
    sensors: Sensors
    motion: Motion
    rate_hz: float = 1000.0
    supply_V: float = 24.0
    seed: int = 0

    @property
    def fingerprint(self) -> str:
        """Names this simulated device: the same settings are the same motor."""
        parts = (self.model.content_hash, self.ageing.start.tolist(), self.ageing.profiles, self.ageing.motor_inertia)
        text = repr((*parts, self.gains, self.sensors, self.motion, self.rate_hz, self.supply_V, self.seed))
        return hashlib.sha256(text.encode()).hexdigest()[:12]


def parse_effect(text: str) -> tuple[str, dict[str, float]]:
    """'coulomb_friction:Tc=0.3' as ('coulomb_friction', {'Tc': 0.3}).

    An effect takes the parameters of its further harmonics, too (`cogging_torque:Tcog=0.3,Tcog_2=0.1`); those that are
    given are then part of the model, see `with_harmonics`.

    Raises:
        BadInputError: unknown effect or parameter, not a number, or out of bounds; the text names it.
    """
    name, _, rest = text.partition(":")
    name = name.strip()
    effects = effects_by_name()
    if name not in effects:
        raise BadInputError(unknown_effect(name))
    family = (name, *further_harmonics(name))
    own = {p.name: p for member in family for p in effects[member].parameters}
    values: dict[str, float] = {}
    for part in (piece for piece in rest.split(",") if piece.strip()):
        key, separator, number = (s.strip() for s in part.partition("="))
        if not separator or key not in own:
            raise BadInputError(f"effect {name}: unknown parameter '{key}': it has {', '.join(own)}")
        if key in values:
            raise BadInputError(f"effect {name}: {key} is given twice")
        values[key] = _checked(own[key], number, f"effect {name}")
    return name, values


def with_harmonics(name: str, values: Mapping[str, float]) -> tuple[str, ...]:
    """The effect and those of its further harmonics that have a value."""
    known = effects_by_name()
    further = further_harmonics(name)
    return (name, *(f for f in further if any(p.name in values for p in known[f].parameters)))


def _checked(parameter: Parameter, value: Any, where: str) -> float:
    try:
        return parameter.read(value)
    except ValueError as error:
        raise BadInputError(f"{where}: {parameter.name} = {error}") from None


def parse_effects(effects: Iterable[str] | Mapping[str, Any]) -> tuple[tuple[str, ...], dict[str, float]]:
    """Effect texts, or a table name -> table of parameters, as (names in order, parameters).

    Raises:
        BadInputError: see `parse_effect`; an effect named twice; a shared parameter given two values.
    """
    if isinstance(effects, str):
        effects = [effects]
    if isinstance(effects, Mapping):
        texts = []
        for name, table in effects.items():
            if not isinstance(table, Mapping):
                raise BadInputError(f"effect {name}: {table!r} is not a table of its parameters")
            texts.append(f"{name}:" + ",".join(f"{key}={value}" for key, value in table.items()))
        effects = texts
    names: list[str] = []
    values: dict[str, float] = {}
    for text in effects:
        if not isinstance(text, str):
            raise BadInputError(f"effect {text!r} is not a text such as 'coulomb_friction:Tc=0.3'")
        name, own = parse_effect(text)
        added = with_harmonics(name, own)
        for twice in (n for n in added if n in names):
            raise BadInputError(f"effect {twice} is named twice")
        for key, value in own.items():
            if values.setdefault(key, value) != value:
                raise BadInputError(f"effect {name}: {key} = {value:g}, but another effect says {values[key]:g}")
        names += added
    return tuple(names), values


def _motor(motor: Mapping[str, Any] | None) -> dict[str, float]:
    """R, L, K, J, B: the paper's motor with what is given instead."""
    if not motor:
        return dict(PAPER_MOTOR)
    table = {p.name: p for p in LINEAR}
    unknown = [name for name in motor if name not in table]
    if unknown:
        raise BadInputError(f"motor: unknown parameter '{unknown[0]}': a motor has {', '.join(table)}")
    return dict(PAPER_MOTOR) | {name: _checked(table[name], value, "motor") for name, value in motor.items()}


def make_settings(
    *,
    motor: Mapping[str, Any] | None = None,
    J_m: float | None = None,
    effects: Iterable[str] | Mapping[str, Any] = (),
    ageing: Mapping[str, str | Sequence[str]] | Sequence[str] = (),
    rate_hz: float = 1000.0,
    seconds: float | None = None,
    seed: int = 0,
    supply_V: float = 24.0,
    motion: MotionName = "mixed",
    peak_speed_rad_s: float | None = None,
    dither_rms_V: float | None = None,
    sensors: Mapping[str, Any] | None = None,
) -> Settings:
    """Settings from what a user gives; sensors, gains and motion left out are fitted to motor, supply and rate.

    Args:
        motor: R, L, K, J, B in SI units; the paper's where absent.
        J_m: inertia without load, kg·m²; then J_d is part of the truth.
        effects: texts such as "coulomb_friction:Tc=0.3", or a table of tables.
        ageing: texts such as "R=+40%/300s", or a table parameter -> text or texts.
        seconds: length, for ageing "over the whole capture"; None for a drive that runs on.
        peak_speed_rad_s, dither_rms_V: of the motion.
        sensors: fields of `Sensors` that differ from the default.

    Raises:
        BadInputError: anything unknown, not a number or impossible; one line naming it.
    """
    for name, value in {"rate": rate_hz, "supply_V": supply_V, "seconds": 1.0 if seconds is None else seconds}.items():
        if not (math.isfinite(value) and value > 0):
            raise BadInputError(f"{name} must be a finite number greater than zero, not {value:g}")
    if seed < 0:
        raise BadInputError(f"seed must not be negative, not {seed}")
    p = _motor(motor)
    names, own = parse_effects(effects)
    model = build_plant(names)
    p |= {q.name: own.get(q.name, VISIBLE.get(q.name, q.nominal)) for q in model.parameters[len(LINEAR) :]}
    start = np.array([p[name] for name in model.parameter_names])
    inertia = None if J_m is None else _checked(J_M, J_m, "J_m")
    speed_gain = p["K"] / (p["R"] * p["B"] + p["K"] ** 2)
    return Settings(
        model=model,
        ageing=Ageing(model.parameters, start, parse_ageing(ageing_texts(ageing), seconds, seed), inertia),
        gains=suitable_gains(p, supply_V, rate_hz),
        sensors=_fitting_sensors(p, supply_V, rate_hz, sensors or {}),
        motion=Motion(
            name=motion,
            # Of the speed that the whole supply would give: leaves voltage for acceleration and following.
            peak_speed_rad_s=0.38 * supply_V * speed_gain if peak_speed_rad_s is None else peak_speed_rad_s,
            dither_rms_V=0.06 * supply_V * (motion != "rest") if dither_rms_V is None else dither_rms_V,
            rate_hz=rate_hz,
        ),
        rate_hz=rate_hz,
        supply_V=supply_V,
        seed=seed,
    )


def _fitting_sensors(p: Mapping[str, float], supply_V: float, rate_hz: float, given: Mapping[str, Any]) -> Sensors:
    """A good laboratory drive's sensors for this motor: ± the stall current, noise 0.3 % of about 40 % of that."""
    known = {f.name for f in fields(Sensors)}
    unknown = [name for name in given if name not in known]
    if unknown:
        raise BadInputError(f"unknown sensor setting '{unknown[0]}': known are {', '.join(sorted(known))}")
    stall_A = supply_V / p["R"]
    fitted: dict[str, Any] = {
        "current_range_A": stall_A,
        "current_noise_A": 0.003 * 0.4 * stall_A,
        "voltage_lsb_V": 2 * supply_V / 8192.0,
        "jitter_s": min(1e-5, 0.01 / rate_hz),
    }
    try:
        sensors = Sensors(**(fitted | {k: tuple(v) if k == "channels" else v for k, v in given.items()}))
    except TypeError as error:
        raise BadInputError(f"a sensor setting is not a number: {error}") from None
    if sensors.jitter_s > 0.45 / rate_hz:
        raise BadInputError(f"jitter_s = {sensors.jitter_s:g} is more than 45 % of the sample period")
    return sensors
