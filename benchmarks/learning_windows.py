"""Windows for `benchmarks/learning.py`: of motors by the independent generator, outside the trained range, with faults,
and what the other estimators say of a window."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from servo_daemon.config import DriveConfig
from servo_daemon.errors import ServoDaemonError
from servo_daemon.identification.output_error import FitOptions, Recording, fit_output_error
from servo_daemon.learning.examples.drawing import CORE, TrainingSpec
from servo_daemon.learning.examples.training import TARGETS
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.samples import F64, SampleBlock, make_block
from tests.recovery.generator import MOTIONS, PAPER, Scenario, Sensors, generate

#: The generator's motor has run for this long when its window begins, s.
_LEAD_S = 0.3


def generated(spec: TrainingSpec, number: int) -> tuple[SampleBlock, dict[str, float]]:
    """A window by the independent generator: a motor within the trained range around the paper's, any of the five
    motions, laboratory sensors, friction, load and brush drop in two of three."""
    rng = np.random.default_rng([11, number])
    p = {n: spec.nominal[n] * spec.spread ** rng.uniform(-1.0, 1.0) for n in CORE}
    current = 0.3 * PAPER.supply_V / p["R"]
    motor = replace(PAPER, **p, rated_current_A=current, current_limit_A=2.7 * current)
    share = 10.0 ** rng.uniform(-2.5, -0.8, size=3) * (rng.random(3) < 0.67)
    torque = p["K"] * current
    effects: dict[str, dict[str, float]] = {}
    if share[0]:
        effects["coulomb_friction"] = {"Tc": share[0] * torque}
    if share[1]:
        effects["constant_load_torque"] = {"TL": share[1] * torque}
    if share[2]:
        effects["brush_voltage_drop"] = {"Vb": 0.3 * share[2] * PAPER.supply_V}
    motion = list(MOTIONS)[number % len(MOTIONS)]
    scenario = Scenario(motion, _LEAD_S + spec.window_s, spec.rate_hz, effects, seed=number)
    r = generate(motor, replace(scenario, sensors=Sensors.laboratory(motor)))
    k = round(_LEAD_S * spec.rate_hz)
    block = make_block(
        r.time_s[k:], voltage_V=r.voltage_V[k:], current_A=r.current_A[k:], position_rad=r.position_rad[k:]
    )
    return block, p | {"Tc": effects.get("coulomb_friction", {}).get("Tc", 0.0)}


def _voltage_lost(b: SampleBlock, rng: np.random.Generator) -> SampleBlock:
    """The recorded voltage is zero for 0.3 s."""
    v = b.voltage_V.copy()
    k = int(rng.integers(len(v) // 2))
    v[k : k + round(0.06 * len(v))] = 0.0
    return replace(b, voltage_V=v)


def _current_spikes(b: SampleBlock, rng: np.random.Generator) -> SampleBlock:
    i = b.current_A.copy()
    where = rng.integers(len(i), size=len(i) // 100)
    i[where] += 3.0 * np.abs(i).max() * rng.choice((-1.0, 1.0), size=len(where))
    return replace(b, current_A=i)


def _current_late(b: SampleBlock, rng: np.random.Generator) -> SampleBlock:
    """The current is told 5 samples late; nothing about it is random."""
    del rng
    return replace(b, current_A=np.concatenate([np.full(5, b.current_A[0]), b.current_A[:-5]]))


def _encoder_slips(b: SampleBlock, rng: np.random.Generator) -> SampleBlock:
    """Three times the encoder loses a twentieth of the way it makes."""
    angle = b.position_rad.copy()
    for k in rng.integers(len(angle), size=3):
        angle[k:] += 0.05 * (np.ptp(angle) + 1e-3) * rng.choice((-1.0, 1.0))
    return replace(b, position_rad=angle)


def _wires_swapped(b: SampleBlock, rng: np.random.Generator) -> SampleBlock:
    """The current has the wrong sign; nothing about it is random."""
    del rng
    return replace(b, current_A=-b.current_A)


def _current_dead(b: SampleBlock, rng: np.random.Generator) -> SampleBlock:
    """The current sensor shows nothing but noise."""
    return replace(b, current_A=0.01 * np.abs(b.current_A).max() * rng.normal(size=len(b)))


FAULTS: Mapping[str, Callable[[SampleBlock, np.random.Generator], SampleBlock]] = {
    "voltage reported 0 for 6 % of the window": _voltage_lost,
    "current spikes, 1 % of the samples": _current_spikes,
    "current 5 samples late": _current_late,
    "encoder slips three times": _encoder_slips,
    "current with the wrong sign": _wires_swapped,
    "current sensor dead": _current_dead,
}


def ekf(block: SampleBlock, nominal: Mapping[str, float]) -> F64:
    """The daemon's filter after the window, started from the datasheet; NaN where it publishes nothing."""
    pipeline = Pipeline(DriveConfig(nominal=dict(nominal)))
    estimates = pipeline.process(block)
    last = estimates[-1] if estimates else None
    found = {} if last is None else {p.name: p.value for p in last.parameters}
    return np.array([np.nan if found.get(n) is None else found[n] for n in CORE], dtype=np.float64)


def output_error(block: SampleBlock, nominal: Mapping[str, float]) -> F64:
    """Method 2 on the window, for the model that has dry friction and a load; NaN where it fails."""
    effects = ("coulomb_friction", "constant_load_torque")
    try:
        fit = fit_output_error([Recording("window", block)], effects, FitOptions(nominal=nominal, robust=False))
    except ServoDaemonError:
        return np.full(len(CORE), np.nan)
    values = [fit.parameters[n].value for n in CORE]
    return np.array([np.nan if v is None else v for v in values], dtype=np.float64)


def truth_row(truth: Mapping[str, float]) -> F64:
    """Shape (m,), in the order of `TARGETS`."""
    return np.array([truth.get(n, 0.0) for n in TARGETS])
