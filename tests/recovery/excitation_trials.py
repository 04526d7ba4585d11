"""What a plan is worth, measured: the generator's motor plays it, both models are fitted to the noisy capture.

The rival is the generator's own multisine, as strong as the same limits allow. Of the motor the plan knows nominal
values that are off, of the effects nothing but their names.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servo_daemon.diagnosis.search.evidence import LEAST_BIC, LEAST_GAIN
from servo_daemon.diagnosis.trial.compare import Advantage, advantage
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.split import segment_length_s
from servo_daemon.diagnosis.trial.trial import Trial, fit_trial
from servo_daemon.experiment import Limits, MotionPlan, Request, Sensors, complete_limits, plan_motion
from servo_daemon.identification.output_error import FitOptions, FittedParameter, Recording, fit_output_error
from servo_daemon.identification.output_error.problem.setup import make_problem
from servo_daemon.identification.output_error.starts import starting_points
from servo_daemon.plant.effects import effects_by_name
from servo_daemon.samples import SampleBlock, make_block
from tests.recovery.generator import MOTIONS, Motor, Plan, Scenario, generate, stream, typical

F64 = NDArray[np.float64]
RATE_HZ, SECONDS = 1000.0, 20.0
#: What the user's datasheet says, of the truth.
_OFF = {"R": 1.08, "L": 0.92, "K": 0.96, "J": 1.1, "B": 1.15}
#: Starts of an effect's last parameter, of its usual size.
_STARTS = (1.0, 0.25, 4.0)


def nominal(motor: Motor) -> dict[str, float]:
    """What is known of the motor: wrong by 4 to 15 %."""
    return {name: factor * float(getattr(motor, name)) for name, factor in _OFF.items()}


def limits(motor: Motor) -> Limits:
    """The drive's: supply, current limit, speed without load, rated RMS current."""
    found, _ = complete_limits(
        nominal(motor),
        voltage_V=motor.supply_V,
        current_A=motor.current_limit_A,
        velocity_rad_s=motor.speed_max_rad_s,
        current_rms_A=motor.rated_current_A,
    )
    return found


def planned(motor: Motor, *, wanted: tuple[str, ...] = (), between: tuple[str, ...] = (), seed: int = 0) -> MotionPlan:
    """The plan for this motor."""
    sensors = Sensors(motor.counts_per_rev, 0.003 * motor.rated_current_A, 0.001 * motor.supply_V)
    return plan_motion(
        Request(
            nominal(motor), (), (), wanted, between, limits(motor), sensors, seconds=SECONDS, rate_hz=RATE_HZ, seed=seed
        )
    )


def rival(motor: Motor, seed: int) -> F64:
    """The generator's multisine, V, as strong as the limits allow the motor as it truly is."""
    time = np.arange(round(SECONDS * RATE_HZ)) / RATE_HZ
    voltage = np.asarray(MOTIONS["multisine"](motor, time, stream(seed, "motion")).reference)
    bound = limits(motor)
    # ideal limits: the motor is linear, so that one run tells how much more it stands
    truth = generate(motor, Scenario(Plan("voltage", 0.1 * voltage), SECONDS, RATE_HZ, seed=seed)).truth
    share = max(
        float(np.abs(voltage).max()) / bound.voltage_V,
        10 * float(np.abs(truth.current_A).max()) / bound.current_A,
        10 * float(np.abs(truth.speed_rad_s).max()) / bound.velocity_rad_s,
        10 * float(np.sqrt(np.mean(truth.current_A**2))) / bound.current_rms_A,
    )
    return np.asarray(0.98 * voltage / share)


def played(motor: Motor, voltage: F64, effects: dict[str, dict[str, float]], seed: int) -> SampleBlock:
    """The noisy capture."""
    r = generate(motor, Scenario(Plan("voltage", voltage), SECONDS, RATE_HZ, effects=effects, seed=seed))
    return make_block(r.time_s, voltage_V=r.voltage_V, current_A=r.current_A, position_rad=r.position_rad)


@dataclass(frozen=True, slots=True)
class Verdict:
    """Of the true model over the wrong one.

    Attributes:
        against: gain in held-out error with its interval, and BIC.
        model: the true one, fitted.
    """

    against: Advantage
    model: Trial

    @property
    def separated(self) -> bool:
        """As a diagnosis decides: a held-out gain beyond chance, and BIC."""
        return self.against.low > LEAST_GAIN and self.against.delta_bic < LEAST_BIC


def judged(motor: Motor, voltage: F64, true: str, wrong: str, share: float, seed: int) -> Verdict:
    """Both models fitted to the capture of this motion, the one hidden with this share of the working torque."""
    effects = typical(true, motor, share, rng=np.random.default_rng(seed))
    recording = Recording("capture", played(motor, voltage, effects, seed))
    data = Data.of([recording], {}, (), segment_length_s([recording]))
    model = _fitted(data, recording, motor, true)
    return Verdict(advantage(_fitted(data, recording, motor, wrong), model), model)


def _fitted(data: Data, recording: Recording, motor: Motor, effect: str) -> Trial:
    """The best end of several starts: the effect's parameters at their usual sizes, and the last of them off."""
    problem = make_problem([recording], (effect,), {}, segment_s=data.split.segment_s)
    start = starting_points([recording], problem, nominal(motor))
    begin = next(s.values for s in start if s.source.startswith("nominal"))
    moved = effects_by_name()[effect].parameters[-1].name
    trials = [fit_trial(data, (effect,), {**begin, moved: begin[moved] * factor}) for factor in _STARTS]
    return min((t for t in trials if t is not None), key=lambda t: t.solution.point.value)


def determined(motor: Motor, voltage: F64, seed: int) -> dict[str, FittedParameter]:
    """The linear motor's parameters from the capture of this motion, as `fit` finds them."""
    recording = Recording("capture", played(motor, voltage, {}, seed))
    return dict(fit_output_error([recording], (), FitOptions(nominal=nominal(motor))).parameters)
