"""Random motors, motions and instruments around a drive's datasheet (domain randomisation; Tobin et al., IROS 2017).

What is not known of a drive in service is drawn: the five parameters within a factor of what the datasheet says, dry
friction, a load, a brush drop and a sensor's offset from nothing to more than is usual, how the axis moves, who
controls it and how well, noise and resolution of the instruments. Every motor has a random stream of its own: the same
number gives the same motor, whoever computes it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from servo_daemon.errors import BadInputError
from servo_daemon.learning.examples.motions import DrawnMotion, draw_motion
from servo_daemon.parameters import MOTOR_NAMES
from servo_daemon.plant.effects import effects_by_name
from servo_daemon.samples import F64
from servo_daemon.simulate import Settings, make_settings
from servo_daemon.simulate.drive import CHUNK
from servo_daemon.simulate.visible import VISIBLE

CORE = MOTOR_NAMES
#: Effects that any drive may have, whatever its model says; of dry friction only if the model has none.
_BIASES = ("constant_load_torque", "current_sensor_offset", "brush_voltage_drop")
_DRY = ("coulomb_friction", "asymmetric_friction", "stribeck_friction")
#: The motor has run for this long when its window begins, s.
LEAD_S = 0.3
#: Motors outside the range are beyond its ends by these factors.
_OUTSIDE = (1.4, 5.0)
#: Without a datasheet's supply: volts that small drives run on.
_SUPPLIES_V = (12.0, 48.0)


@dataclass(frozen=True)
class TrainingSpec:
    """What is simulated.

    Attributes:
        nominal: R, L, K, J, B of the datasheet, and what is known of its effects' parameters; SI units.
        effects: the drive's model.
        spread: parameters are drawn from nominal/spread to nominal·spread.
        rate_hz: sample rate.
        window_s: length of the windows.
        supply_V: of the drive; None: drawn.
        counts_per_rev: of the encoder; None: drawn.
        channels: what the drive delivers.
        seed: of everything random.
    """

    nominal: Mapping[str, float]
    effects: tuple[str, ...] = ()
    spread: float = 3.0
    rate_hz: float = 1000.0
    window_s: float = 5.0
    supply_V: float | None = None
    counts_per_rev: float | None = None
    channels: tuple[str, ...] = ("voltage_V", "current_A", "position_rad")
    seed: int = 0

    def __post_init__(self) -> None:
        missing = [n for n in CORE if n not in self.nominal]
        if missing:
            raise BadInputError(f"training needs nominal values of R, L, K, J, B: {', '.join(missing)} is missing")
        if not self.spread > 1.0:
            raise BadInputError(f"spread must be greater than 1, not {self.spread:g}")
        if not 2.0 <= self.window_s <= 10.0:
            raise BadInputError(f"windows are 2 to 10 s long, not {self.window_s:g} s")
        if not 1.0 <= self.rate_hz * self.window_s <= 1e6:
            raise BadInputError(f"{self.window_s:g} s at {self.rate_hz:g} Hz are too many samples or too few")

    @property
    def samples(self) -> int:
        """Samples in a window."""
        return round(self.rate_hz * self.window_s)

    @property
    def plant_effects(self) -> tuple[str, ...]:
        """The model's and what any drive may have."""
        dry = () if set(_DRY) & set(self.effects) else ("coulomb_friction",)
        added = (*_BIASES, *dry)
        # Levels of dry friction by direction are a load torque beside equal ones: never both.
        if "asymmetric_friction" in self.effects:
            added = tuple(e for e in added if e != "constant_load_torque")
        return (*self.effects, *(e for e in added if e not in self.effects))


@dataclass(frozen=True)
class DrawnMotor:
    """One motor of the training.

    Attributes:
        settings: for `simulate.SimulatedDrive`; its motion is `motion`.
        truth: parameters by name.
    """

    settings: Settings
    truth: Mapping[str, float] = field(default_factory=dict)


def draw_parameters(spec: TrainingSpec, n: int) -> F64:
    """R, L, K, J, B of n motors, shape (n, 5): evenly in the logarithms (Sobol, scrambled): few fill the range."""
    from scipy.stats import qmc

    unit = qmc.Sobol(len(CORE), scramble=True, rng=np.random.default_rng([spec.seed, 1])).random(
        1 << max(0, n - 1).bit_length()
    )[:n]
    nominal = np.array([spec.nominal[name] for name in CORE])
    return np.asarray(nominal * spec.spread ** (2.0 * unit - 1.0))


def draw_outside(spec: TrainingSpec, number: int, core: F64) -> F64:
    """A motor that lies outside the range: R, L, K, J, B, shape (5,), of one within, of which one or two are put 1.4 to
    5 times beyond an end of their range."""
    rng = np.random.default_rng([spec.seed, 5, number])
    out = core.copy()
    for k in rng.choice(len(CORE), size=1 + int(rng.random() < 0.3), replace=False).tolist():
        beyond = spec.spread * _between(rng, *_OUTSIDE)
        out[k] = spec.nominal[CORE[k]] * beyond ** float(rng.choice((-1.0, 1.0)))
    return out


def draw_motor(spec: TrainingSpec, number: int, core: F64) -> DrawnMotor:
    """Motor `number` with these R, L, K, J, B, shape (5,)."""
    rng = np.random.default_rng([spec.seed, 2, number])
    p = dict(zip(CORE, core.tolist(), strict=True))
    supply = spec.supply_V or _between(rng, *_SUPPLIES_V)
    stall_A = supply / p["R"]
    table = {name: dict[str, float]() for name in spec.plant_effects}
    known = effects_by_name()
    drawn = _biases(rng, p, supply)
    for name, values in table.items():
        for q in known[name].parameters:
            if name in spec.effects:
                drawn[q.name] = _own(rng, spec, q.name, q.nominal, q.transform == "log", drawn)
            values[q.name] = float(np.clip(drawn[q.name], q.lower, q.upper))
    settings = make_settings(
        motor=p,
        effects=table,
        rate_hz=spec.rate_hz,
        supply_V=supply,
        seed=int(rng.integers(1 << 31)),
        sensors=_sensors(rng, spec, supply, stall_A),
    )
    # Whoever tuned the loop knew the motor more or less; some drives run open loop.
    gain = 0.0 if rng.random() < 0.25 else 10.0 ** rng.uniform(-1.0, 0.0)
    settings = replace(
        settings,
        gains=replace(settings.gains, k_su=settings.gains.k_su * gain),
        motion=_motion(rng, spec, settings, open_loop=gain == 0.0),
    )
    truth = dict(zip(settings.model.parameter_names, settings.ageing.start.tolist(), strict=True))
    return DrawnMotor(settings, truth)


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    """A draw whose logarithm is uniform."""
    return float(low * (high / low) ** rng.random())


def _biases(rng: np.random.Generator, p: Mapping[str, float], supply_V: float) -> dict[str, float]:
    """Effects that any drive may have: nothing in a third of them, else up to more than is usual."""
    current = 0.3 * supply_V / p["R"]
    torque = p["K"] * current

    def size(scale: float, low: float, high: float) -> float:
        return scale * (1e-4 if rng.random() < 0.33 else _between(rng, low, high))

    return {
        "Tc": size(torque, 0.003, 0.2),
        "TL": float(rng.choice((-1.0, 1.0))) * size(torque, 0.003, 0.15),
        "i0": float(rng.choice((-1.0, 1.0))) * size(current, 0.001, 0.02),
        "Vb": size(supply_V, 0.002, 0.04),
    }


def _own(
    rng: np.random.Generator, spec: TrainingSpec, name: str, nominal: float, positive: bool, drawn: Mapping[str, float]
) -> float:
    """A parameter of the model's own effects."""
    told = spec.nominal.get(name)
    if told is None and name in drawn:
        return drawn[name]
    centre = told if told is not None else VISIBLE.get(name, nominal)
    if positive:
        return float(centre * spec.spread ** rng.uniform(-1.0, 1.0))
    return float(centre + rng.normal() * max(abs(centre), 1e-9))


def _sensors(rng: np.random.Generator, spec: TrainingSpec, supply_V: float, stall_A: float) -> dict[str, Any]:
    """Instruments from good to poor."""
    return {
        "counts_per_rev": spec.counts_per_rev or round(_between(rng, 1000.0, 100_000.0)),
        "current_range_A": stall_A * _between(rng, 0.8, 2.5),
        "current_bits": int(rng.integers(11, 17)),
        "current_noise_A": stall_A * _between(rng, 1e-4, 4e-3),
        "voltage_lsb_V": 2.0 * supply_V / 2.0 ** int(rng.integers(9, 15)),
        "hidden_voltage_V": supply_V * _between(rng, 1e-4, 3e-3),
        "jitter_s": rng.uniform(0.0, 0.02) / spec.rate_hz,
        "channels": spec.channels,
    }


def _motion(rng: np.random.Generator, spec: TrainingSpec, settings: Settings, *, open_loop: bool) -> DrawnMotion:
    samples = spec.samples + math.ceil(LEAD_S * spec.rate_hz)
    chunks = math.ceil(samples / CHUNK) + 1
    return draw_motion(rng, chunks * CHUNK, settings, open_loop=open_loop)
