"""Test data from a motor that knows nothing of servo_daemon: own equations, own integrator, own noise.

    from tests.recovery.generator import RE40, Scenario, Sensors, generate
    capture = generate(RE40, Scenario("reversals", seconds=20, effects={"coulomb_friction": {"Tc": 0.01}}, seed=3))
    capture.write_csv("capture.csv")     # what a drive would have recorded
    capture.truth.speed_rad_s            # what it was

The physics is C99 (motor.h has the equations), stick-slip, brush drop and backlash are events. Nothing here may import
servo_daemon or drivers: a test asserts it.
"""

from __future__ import annotations

import gzip
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from .effects import ALL, LISTED, UNLISTED, EffectValues, check_effects, setup_values
from .motions import MOTIONS, Gains, Motion, Plan, Start, servo_gains
from .motors import BELT_SERVO, GEAR_MOTOR, LARGE_SERVO, MOTORS, PAPER, RE40, Motor
from .native import F64, CompilerMissingError, IntegrationError, find_compiler, run
from .sensors import Sensors, hidden_voltage, recorded, sample_times, stream
from .sizes import typical
from .step import inner_step_s

__all__ = [
    "ALL",
    "BELT_SERVO",
    "GEAR_MOTOR",
    "LARGE_SERVO",
    "LISTED",
    "MOTIONS",
    "MOTORS",
    "PAPER",
    "RE40",
    "UNLISTED",
    "CompilerMissingError",
    "EffectValues",
    "Gains",
    "IntegrationError",
    "Motion",
    "Motor",
    "Plan",
    "Recording",
    "Scenario",
    "Sensors",
    "Start",
    "Truth",
    "find_compiler",
    "generate",
    "servo_gains",
    "stream",
    "typical",
]

_AGEING = ("R", "L", "K", "J", "B", "TL")


@dataclass(frozen=True, slots=True, eq=False)
class Scenario:
    """What happens to a motor.

    Attributes:
        motion: a name of MOTIONS, a function like those, or a ready Plan of n samples.
        seconds, rate_hz: n = round(seconds · rate_hz) samples.
        effects: hidden causes by name, each with all its parameters (see effects.py).
        ageing: R, L, K, J, B or TL (load torque, N·m) as arrays of shape (n,), each value held until the next sample.
        sensors: None: `Sensors.laboratory(motor)`; `Sensors()` is ideal.
        seed: of noise, jitter, hidden voltage, motion and dropouts.
        start: state at the first sample.
        inner_step_s: of the integrator; None: chosen from the fastest pole.
    """

    motion: str | Motion | Plan = "multisine"
    seconds: float = 20.0
    rate_hz: float = 1000.0
    effects: Mapping[str, EffectValues] = field(default_factory=dict)
    ageing: Mapping[str, F64] = field(default_factory=dict)
    sensors: Sensors | None = None
    seed: int = 0
    start: Start = field(default_factory=Start)
    inner_step_s: float | None = None

    @property
    def samples(self) -> int:
        """n."""
        return round(self.seconds * self.rate_hz)


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What was, at the true sampling instants; all arrays of shape (n,), none of it in the capture.

    Attributes:
        time_s: the true instants.
        parameters: "R", "L", "K", "J", "B", "TL", as they held from each sample to the next. R is the cold winding's,
            before a resistance step; J the motor's side; TL the ageing array and the constant load together.
        effects: as they were asked for.
        current_A, speed_rad_s, position_rad: the motor's state.
        load_speed_rad_s, load_position_rad: the far side of backlash or compliance, else 0.
        winding_rise_K: temperature of the winding above ambient.
        applied_V: mean voltage at the motor's terminals from each sample to the next.
        slip: -1 and 1 slides, 0 sticks (without dry friction: the sign of the speed).
        dry_friction_Nm: torque of dry friction against the motion; at rest, what it holds.
        spring_torque_Nm: through the shaft of backlash or compliance.
        inner_step_s: the integrator's step.
    """

    time_s: F64
    parameters: Mapping[str, F64]
    effects: Mapping[str, EffectValues]
    current_A: F64
    speed_rad_s: F64
    position_rad: F64
    load_speed_rad_s: F64
    load_position_rad: F64
    winding_rise_K: F64
    applied_V: F64
    slip: F64
    dry_friction_Nm: F64
    spring_torque_Nm: F64
    inner_step_s: float


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """A capture: what the instruments showed, shapes (n,), and the truth beside it.

    `voltage_V` is what was commanded from this sample until the next, after the drive's limits.
    """

    time_s: F64
    voltage_V: F64
    current_A: F64
    position_rad: F64
    truth: Truth
    metadata: Mapping[str, str]

    def write_csv(self, path: Path | str) -> None:
        """Writes the four columns in the capture format, gzipped if the name ends in .gz; nothing of the truth."""
        lines = [f"# {key}: {value}" for key, value in self.metadata.items()]
        lines.append("time_s,voltage_V,current_A,position_rad")
        columns = (self.time_s, self.voltage_V, self.current_A, self.position_rad)
        # 12 digits of the angle: below every noise here, even after hours or thousands of turns
        rows = zip(*(column.tolist() for column in columns), strict=True)
        lines += [f"{t:.9f},{v:.9g},{i:.9g},{angle:.12g}" for t, v, i, angle in rows]
        text = ("\n".join(lines) + "\n").encode()
        Path(path).write_bytes(gzip.compress(text, 6, mtime=0) if str(path).endswith(".gz") else text)


def generate(motor: Motor, scenario: Scenario) -> Recording:
    """Runs the scenario on the motor. The same arguments give the same numbers, bit for bit.

    Raises:
        ValueError: an unknown effect, a missing parameter, arrays of the wrong shape, an effect too stiff to follow.
        CompilerMissingError: there is no C compiler.
        IntegrationError: the motion could not be followed.
    """
    sensors = Sensors.laboratory(motor) if scenario.sensors is None else scenario.sensors
    n = scenario.samples
    _check(scenario, sensors, n)
    nominal_time = np.arange(n) / scenario.rate_hz
    plan = _plan(motor, scenario, nominal_time)
    time_s = sample_times(sensors, n, scenario.rate_hz, scenario.seed)
    parameters = _parameters(motor, scenario, n)
    inputs: dict[str, F64 | float] = {
        "time": time_s,
        **parameters,
        "torque_factor": _dropouts(scenario, nominal_time),
        "reference": plan.reference,
        "added_voltage": plan.added_V,
    }
    setup = {
        **plan.setup(motor, scenario.rate_hz),
        **scenario.start.setup(),
        **setup_values(scenario.effects),
        "counts_per_rev": sensors.counts_per_rev,
        "noise_pieces": float(sensors.hidden_pieces),
        "pwm_periods": float(max(1, round(sensors.pwm_hz / scenario.rate_hz)) if sensors.pwm_hz else 0),
    }
    setup["step_s"] = scenario.inner_step_s or inner_step_s(motor, setup, inputs)
    output = run(setup, inputs, hidden_voltage(sensors, n, scenario.seed))
    truth = _truth(time_s, parameters, scenario, output, setup["step_s"])
    metadata = {"source": "independent generator", "rate_hz": f"{scenario.rate_hz:g}"}
    if sensors.counts_per_rev:
        metadata["counts_per_rev"] = f"{sensors.counts_per_rev:g}"
    return Recording(
        **recorded(sensors, scenario.effects, time_s, output, scenario.seed), truth=truth, metadata=metadata
    )


def _check(scenario: Scenario, sensors: Sensors, n: int) -> None:
    if n < 2 or scenario.rate_hz <= 0:
        raise ValueError(f"{scenario.seconds} s at {scenario.rate_hz} Hz are {n} samples: at least two are needed")
    sensors.check(scenario.rate_hz)
    check_effects(scenario.effects)
    for name, values in scenario.ageing.items():
        if name not in _AGEING:
            raise ValueError(f"{name} does not age; {', '.join(_AGEING)} do")
        if np.shape(values) != (n,) or not np.isfinite(values).all() or (name != "TL" and np.min(values) <= 0):
            raise ValueError(f"ageing of {name}: {n} finite values, positive unless TL, not shape {np.shape(values)}")


def _plan(motor: Motor, scenario: Scenario, nominal_time: F64) -> Plan:
    motion = scenario.motion
    if isinstance(motion, str):
        if motion not in MOTIONS:
            raise ValueError(f"no motion {motion!r}; there are {', '.join(MOTIONS)}")
        motion = MOTIONS[motion]
    plan = motion if isinstance(motion, Plan) else motion(motor, nominal_time, stream(scenario.seed, "motion"))
    if plan.reference.shape != nominal_time.shape:
        raise ValueError(f"the motion has {plan.reference.shape[0]} samples, the scenario {len(nominal_time)}")
    return plan


def _parameters(motor: Motor, scenario: Scenario, n: int) -> dict[str, F64]:
    """R, L, K, J, B, TL, shapes (n,)."""
    nominal = {"R": motor.R, "L": motor.L, "K": motor.K, "J": motor.J, "B": motor.B, "TL": 0.0}
    arrays = {name: np.array(scenario.ageing.get(name, np.full(n, nominal[name])), float) for name in _AGEING}
    arrays["TL"] += float(scenario.effects.get("constant_load_torque", {}).get("TL", 0.0))
    return arrays


def _dropouts(scenario: Scenario, nominal_time: F64) -> F64:
    """The share of the motor's torque that arrives, shape (n,)."""
    factor = np.ones(len(nominal_time))
    if "torque_dropouts" in scenario.effects:
        depth, rate_hz, duration_s = (
            float(scenario.effects["torque_dropouts"][key]) for key in ("depth", "rate_hz", "duration_s")
        )
        rng = stream(scenario.seed, "dropouts")
        begins = rng.uniform(0.0, nominal_time[-1], rng.poisson(rate_hz * nominal_time[-1]))
        for begin in begins:
            factor[(nominal_time >= begin) & (nominal_time < begin + duration_s)] = 1.0 - depth
    return factor


def _truth(time_s: F64, parameters: dict[str, F64], scenario: Scenario, output: dict[str, F64], step_s: float) -> Truth:
    return Truth(
        time_s=time_s,
        parameters=parameters,
        effects=scenario.effects,
        current_A=output["current"],
        speed_rad_s=output["speed"],
        position_rad=output["angle"],
        load_speed_rad_s=output["load_speed"],
        load_position_rad=output["load_angle"],
        winding_rise_K=output["rise"],
        applied_V=output["applied"],
        slip=output["slip"],
        dry_friction_Nm=output["dry_torque"],
        spring_torque_Nm=output["spring_torque"],
        inner_step_s=step_s,
    )
