"""What can happen to a drive: each case is a recording of the independent generator, the model the daemon is told, and
what was true. Faults of instruments are put into the recording afterwards (`faults`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from servo_daemon.samples import F64
from tests.recovery.generator import MOTIONS, Motion, Motor, Plan, Recording, Scenario, Sensors, generate, servo_gains
from tests.recovery.tracking import faults
from tests.recovery.tracking.faults import Where
from tests.recovery.tracking.follow import NAMES

#: Excitation before a quiet stretch, s.
LIVELY_S = 20.0
#: Sizes: of a step of R or J; of a load torque and of dry friction, as shares of the torque at rated current.
STEP, LOAD, FRICTION = 0.30, 0.30, 0.08


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One motor's run.

    Attributes:
        motion: in words.
        recording: what the daemon sees, and the truth.
        model: effects the daemon is told.
        truth: parameter -> (n,): the linear motor's, then those of the model's effects.
        change_s: when the step or fault came; None: nothing special happens at one moment.
        stepped: which parameter stepped; "" where none.
        scale: parameter -> (n,): what its error is a share of; the truth's size where absent.
        expect: what must be seen beside right values, in words.
    """

    motion: str
    recording: Recording
    model: tuple[str, ...] = ()
    truth: Mapping[str, F64] = field(default_factory=dict)
    change_s: float | None = None
    stepped: str = ""
    scale: Mapping[str, F64] = field(default_factory=dict)
    expect: str = ""


Build = Callable[[Motor, float, int], Case]


def _case(motion: str, recording: Recording, **more: object) -> Case:
    truth = {name: recording.truth.parameters[name] for name in NAMES}
    return Case(motion, recording, truth=truth, **more)  # type: ignore[arg-type]


def _with_load(case: Case, motor: Motor) -> Case:
    """`constant_load_torque` in the model; errors of TL as shares of the torque at rated current."""
    load = case.recording.truth.parameters["TL"]
    scale = {"TL": np.full(len(load), motor.working_torque_Nm)}
    return replace(case, model=("constant_load_torque",), truth={**case.truth, "TL": load}, scale=scale)


def _with_friction(case: Case, motor: Motor) -> Case:
    """`coulomb_friction` in the model."""
    Tc = np.full(len(case.recording.time_s), FRICTION * motor.working_torque_Nm)
    return replace(case, model=("coulomb_friction",), truth={**case.truth, "Tc": Tc})


def _friction(motor: Motor) -> Mapping[str, Mapping[str, float | str]]:
    return {"coulomb_friction": {"Tc": FRICTION * motor.working_torque_Nm}}


def step(parameter: str, motion: str) -> Build:
    """R or J is 30 % more from the middle of the run on; TL comes from nothing, as a share of the rated torque."""

    def build(motor: Motor, seconds: float, seed: int) -> Case:
        late = np.arange(round(1000 * seconds)) >= 500 * seconds
        if parameter == "TL":
            values = np.where(late, LOAD * motor.working_torque_Nm, 0.0)
        else:
            values = getattr(motor, parameter) * np.where(late, 1 + STEP, 1.0)
        recording = generate(motor, Scenario(motion, seconds=seconds, ageing={parameter: values}, seed=seed))
        return _case(motion, recording, change_s=seconds / 2, stepped=parameter)

    return build


def load_step(motion: str, *, modelled: bool) -> Build:
    """A step of the load torque, with `constant_load_torque` in the model or without it."""

    def build(motor: Motor, seconds: float, seed: int) -> Case:
        case = step("TL", motion)(motor, seconds, seed)
        if modelled:
            return _with_load(case, motor)
        return replace(case, stepped="", expect="not white")

    return build


def instrument(fault: faults.Fault, motion: str = "pick_and_place") -> Build:
    """A fault of an instrument from the middle of the run on."""

    def build(motor: Motor, seconds: float, seed: int) -> Case:
        recording = generate(motor, Scenario(motion, seconds=seconds, seed=seed))
        begin = int(np.searchsorted(recording.time_s, seconds / 2))
        return _case(motion, fault(recording, Where(motor, begin, seed)), change_s=seconds / 2)

    return build


def always(fault: faults.Fault, motion: str = "pick_and_place") -> Build:
    """A fault of an instrument that was always there."""

    def build(motor: Motor, seconds: float, seed: int) -> Case:
        recording = generate(motor, Scenario(motion, seconds=seconds, seed=seed))
        return _case(motion, fault(recording, Where(motor, 0, seed)))

    return build


def coarse_voltage(motor: Motor, seconds: float, seed: int) -> Case:
    """The voltage is reported in steps of 0.1 V."""
    sensors = replace(Sensors.laboratory(motor), voltage_lsb_V=0.1)
    return _case(
        "pick_and_place", generate(motor, Scenario("pick_and_place", seconds=seconds, sensors=sensors, seed=seed))
    )


def reversals(motor: Motor, seconds: float, seed: int) -> Case:
    """Slow speed reversals under Coulomb friction, with the effect in the model."""
    recording = generate(motor, Scenario("reversals", seconds=seconds, effects=_friction(motor), seed=seed))
    return _with_friction(_case("reversals", recording), motor)


def slow_sampling(motor: Motor, seconds: float, seed: int) -> Case:
    """100 Hz samples of a motor with L/R = 1 ms."""
    quick = replace(motor, L=1e-3 * motor.R)
    return _case("multisine", generate(quick, Scenario("multisine", seconds=seconds, rate_hz=100.0, seed=seed)))


def quiet(kind: str, *, lively: bool = True, friction: str = "none") -> Build:
    """Lively motion for 20 s (or none), then nothing but one speed, no voltage, or one place held.

    Args:
        kind: "speed", "standstill" or "hold".
        friction: "none", "modelled" or "unmodelled".
    """

    def build(motor: Motor, seconds: float, seed: int) -> Case:
        before = LIVELY_S if lively else 0.0
        effects = {} if friction == "none" else _friction(motor)
        plan = _quiet_motion(kind, before)
        recording = generate(motor, Scenario(plan, seconds=before + seconds, effects=effects, seed=seed))
        case = _case(kind if not lively else f"lively, {kind}", recording, change_s=before or None)
        return _with_friction(case, motor) if friction == "modelled" else case

    return build


def _quiet_motion(kind: str, lively_s: float) -> Motion:
    """A servo's usual motion first (by voltage for the standstill), then the quiet one."""
    before = {"speed": "reversals", "standstill": "multisine", "hold": "pick_and_place"}[kind]

    def motion(motor: Motor, time_s: F64, rng: np.random.Generator) -> Plan:
        plan = MOTIONS[before](motor, time_s, rng)
        quiet = time_s >= lively_s
        held = {"speed": 0.3 * motor.speed_max_rad_s, "standstill": 0.0, "hold": 0.02 * motor.speed_max_rad_s}[kind]
        gains = servo_gains(motor, (len(time_s) - 1) / (time_s[-1] - time_s[0]))
        return replace(plan, reference=np.where(quiet, held, plan.reference), gains=gains)

    return motion


CASES: Mapping[str, Build] = {
    "R +30 %": step("R", "multisine"),
    "R +30 %, pick and place": step("R", "pick_and_place"),
    "J +30 %": step("J", "multisine"),
    "J +30 %, pick and place": step("J", "pick_and_place"),
    "load step in the model": load_step("multisine", modelled=True),
    "load step in the model, pick and place": load_step("pick_and_place", modelled=True),
    "load step not in the model": load_step("multisine", modelled=False),
    "load step not in the model, pick and place": load_step("pick_and_place", modelled=False),
    "constant speed": quiet("speed"),
    "constant speed from the start": quiet("speed", lively=False),
    "standstill": quiet("standstill"),
    "standstill from the start": quiet("standstill", lively=False),
    "hold, friction in the model": quiet("hold", friction="modelled"),
    "hold, friction not in the model": quiet("hold", friction="unmodelled"),
    "reversals, friction in the model": reversals,
    "current frozen for 2 s": instrument(faults.frozen_current(2.0)),
    "current frozen for good": instrument(faults.frozen_current(None)),
    "voltage reported 0 for 50 ms": instrument(faults.no_voltage(0.05)),
    "voltage spikes": always(faults.spikes("voltage_V")),
    "current spikes": always(faults.spikes("current_A")),
    "encoder slips 50 counts": instrument(faults.slip(50)),
    "current offset 2 %": always(faults.current_offset(0.02)),
    "current offset 5 %": always(faults.current_offset(0.05)),
    "voltage in steps of 0.1 V": coarse_voltage,
    "20 % missing singly": always(faults.missing(0.2, 1)),
    "20 % missing in runs": always(faults.missing(0.2, 50)),
    "100 Hz, L over R 1 ms": slow_sampling,
}
