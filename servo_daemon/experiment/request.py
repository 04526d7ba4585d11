"""What is asked of a plan, and the plan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from servo_daemon.errors import BadInputError, ConfigError
from servo_daemon.experiment.drive import Rig
from servo_daemon.experiment.family import (
    Shape,
    corners,
    fast_shapes,
    hold_shapes,
    multisine,
    servo_shapes,
    slow_shapes,
)
from servo_daemon.experiment.limits import Limits
from servo_daemon.experiment.loop import Reference, ServoGains, suitable_gains
from servo_daemon.experiment.models import Model, make_model
from servo_daemon.experiment.plan import MotionPlan, Progress, make_plan
from servo_daemon.experiment.questions import Precision, Question, separation
from servo_daemon.experiment.statistics import Noise, make_noise
from servo_daemon.plant.effects import check_effects
from servo_daemon.samples import F64

#: A block lasts about so long, s; a plan has so many of them.
_BLOCK_S, _FEWEST, _MOST = 2.0, 3, 12
#: Samples that a block has at least, a plan at most; and its longest, s.
_LEAST_SAMPLES, _MOST_SAMPLES, _LONGEST_S = 100, 240_000, 120.0
#: Free runs of a fit or a diagnosis: about so many, within these, s.
_RUNS, _SHORTEST_RUN_S, _LONGEST_RUN_S = 48, 0.4, 1.5
#: Sets of values that may be true.
DRAWS = 3
#: The name of no effect at all among candidates.
NOTHING = "none"


@dataclass(frozen=True, slots=True)
class Sensors:
    """What the drive measures with.

    Attributes:
        counts_per_rev: of the encoder.
        current_noise_A: 1 σ; None: the current is not measured.
        input_noise_V: 1 σ of a voltage that acts unseen, white from sample to sample.
    """

    counts_per_rev: float
    current_noise_A: float | None
    input_noise_V: float


@dataclass(frozen=True, slots=True)
class Request:
    """What is wanted.

    Attributes:
        known: values of R, L, K, J, B, and of effects' parameters where they are known; natural units.
        fixed: names that a fit would hold.
        model: effects that the motor has in any case.
        wanted: parameters to determine; empty: all that are free.
        between: candidates to tell apart, effects beside `model`; empty: parameters are wanted.
        limits: of the drive.
        sensors: of the drive.
        reference: what the plan is: a voltage, or what a servo is to follow.
        gains: of that servo; None: suitable ones.
        seconds, rate_hz, seed: of the plan.
    """

    known: Mapping[str, float]
    fixed: tuple[str, ...]
    model: tuple[str, ...]
    wanted: tuple[str, ...]
    between: tuple[str, ...]
    limits: Limits
    sensors: Sensors
    reference: Reference = "voltage"
    gains: ServoGains | None = None
    seconds: float = 20.0
    rate_hz: float = 1000.0
    seed: int = 0


def plan_motion(request: Request, progress: Progress = lambda _share, _step: None) -> MotionPlan:
    """The plan.

    Raises:
        BadInputError: something in the request is impossible; one line that names it.
    """
    n, blocks = _size(request)
    length = n // blocks
    models = [_model(request, effects) for effects in _candidates(request)]
    linear = _model(request, ())
    run = min(length, round(request.rate_hz * float(np.clip(request.seconds / _RUNS, _SHORTEST_RUN_S, _LONGEST_RUN_S))))
    gains = request.gains or suitable_gains(request.known, request.rate_hz)
    fullest = max(models, key=lambda m: len(m.effects))
    rig = Rig(fullest, linear, request.limits, request.rate_hz, request.reference, gains)
    questions = _questions(request, models, _noise(request, linear, run))
    return make_plan(rig, questions, family(request, gains, length), _default(request, gains, n), blocks, run, progress)


def family(request: Request, gains: ServoGains, length: int) -> list[Shape]:
    """The motions that a plan may be made of."""
    rng, rate = np.random.default_rng([request.seed, 1]), request.rate_hz
    if request.reference == "voltage":
        return [*fast_shapes(length, rate, corners(request.known), rng), *slow_shapes(length)]
    if request.reference == "velocity":
        return [*servo_shapes(length, rate, 4 * gains.bandwidth_hz, rng), *slow_shapes(length)]
    return [*servo_shapes(length, rate, gains.bandwidth_hz, rng), *slow_shapes(length), *hold_shapes(length)]


def _size(request: Request) -> tuple[int, int]:
    """Numbers of samples and of blocks."""
    n = round(request.seconds * request.rate_hz)
    blocks = int(np.clip(round(request.seconds / _BLOCK_S), _FEWEST, _MOST))
    if n < blocks * _LEAST_SAMPLES:
        raise BadInputError(
            f"{request.seconds:g} s at {request.rate_hz:g} Hz are {n} samples: a plan has at least "
            f"{blocks * _LEAST_SAMPLES}"
        )
    if n > _MOST_SAMPLES or request.seconds > _LONGEST_S:
        raise BadInputError(
            f"a plan has at most {_LONGEST_S:g} s and {_MOST_SAMPLES:,} samples, not {request.seconds:g} s at "
            f"{request.rate_hz:g} Hz: let the drive repeat a shorter one"
        )
    return n, blocks


def _candidates(request: Request) -> list[tuple[str, ...]]:
    """The effects of each candidate model."""
    if not request.between:
        return [request.model]
    if len(set(request.between)) != len(request.between) or len(request.between) < 2:
        raise BadInputError(f"candidates to tell apart must be two at least, all different: {_text(request.between)}")
    own = [m for m in request.model if m not in request.between]
    return [_together(own, name) for name in request.between]


def _together(model: Sequence[str], name: str) -> tuple[str, ...]:
    """The model with a candidate: what it takes the place of (another dry friction) goes."""
    if name == NOTHING:
        return tuple(model)
    kept: list[str] = []
    for other in model:
        try:
            check_effects((*kept, other, name))
            kept.append(other)
        except ConfigError:
            continue
    try:
        check_effects((*kept, name))
    except ConfigError as error:
        raise BadInputError(str(error)) from error
    return (*kept, name)


def _model(request: Request, effects: tuple[str, ...]) -> Model:
    return make_model(effects, request.known, request.fixed, request.limits, request.seconds, DRAWS, request.seed)


def _noise(request: Request, linear: Model, n: int) -> Noise:
    s = request.sensors
    # A count is a uniform error: its standard deviation is count/√12.
    shown = {"position_rad": 2 * np.pi / s.counts_per_rev / np.sqrt(12.0)}
    if s.current_noise_A is not None:
        shown = {"current_A": s.current_noise_A, **shown}
    return make_noise(linear, shown, s.input_noise_V, request.rate_hz, n)


def _questions(request: Request, models: Sequence[Model], noise: Noise) -> list[Question]:
    if request.between:
        return [separation(a, b, noise) for a, b in permutations(models, 2)]
    (model,) = models
    if lost := [n for n in request.wanted if n not in model.free]:
        raise BadInputError(f"no parameter {_text(lost)} to determine: free in this model are {_text(model.free)}")
    return [Precision(model, noise, request.wanted or model.free)]


def _default(request: Request, gains: ServoGains, n: int) -> F64:
    """A multisine over the whole time, to past the electrical corner (the servo's bandwidth): what one would do without
    a plan."""
    rng, at = np.random.default_rng([request.seed, 2]), corners(request.known)
    highest = 1.5 * at.electrical_hz if request.reference == "voltage" else 2 * gains.bandwidth_hz
    top = max(2.0, min(0.2 * request.rate_hz, highest))
    return multisine(n, request.rate_hz, 0.15, top, rng)


def _text(names: Sequence[str]) -> str:
    return ", ".join(names)
