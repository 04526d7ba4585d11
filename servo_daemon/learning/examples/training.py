"""Training windows: thousands of simulated motors, on all cores of this machine or on a Dask cluster.

Each task makes some motors of the numbers it is given, and each motor has a random stream of its own: where and in
which order tasks run, and whether one had to be run again because a worker died, changes nothing.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from servo_daemon.errors import BadInputError, ServoDaemonError
from servo_daemon.fleet.cluster import scheduler
from servo_daemon.learning.examples.drawing import CORE, LEAD_S, TrainingSpec, draw_motor, draw_outside, draw_parameters
from servo_daemon.learning.examples.faults import with_fault
from servo_daemon.learning.features import catalogue
from servo_daemon.learning.features.features import compute_features
from servo_daemon.samples import F64, SampleBlock

if TYPE_CHECKING:
    from servo_daemon.plant.compiled import SampleLoop

#: What is learned: the motor's five, and its dry friction.
TARGETS = (*CORE, "Tc")
#: Motors a task: about a second of work, so that a task is worth sending and the bar moves.
_PER_TASK = 25
#: Windows without features (the motor hardly moved): beyond this share something is wrong with the datasheet.
_MOST_LOST = 0.5

#: What a window is: of a motor within the range and well measured; of such a motor with a fault of the measuring; of a
#: motor outside the range. The last two are what a model must decline (`novelty`).
HEALTHY, FAULTY, FOREIGN = 0, 1, 2
#: Faulty windows beside each healthy one: they come in many kinds, and cost no simulation.
_FAULTS_EACH = 2
#: Motors outside the range have other random streams than those within.
_FOREIGN_NUMBERS = 1 << 40

#: Told after each task how many motors are done.
Progress = Callable[[int], object]


@dataclass(frozen=True)
class TrainingSet:
    """Windows with known parameters.

    Attributes:
        features: shape (n, features), in their units, NaN where one cannot be had.
        truth: shape (n, len(TARGETS)), SI units.
        motor: shape (n,): whose window; negative for measured captures.
        kind: shape (n,): HEALTHY, FAULTY or FOREIGN.
    """

    features: F64
    truth: F64
    motor: NDArray[np.int64]
    kind: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.motor)

    def only(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> TrainingSet:
        """Some of the windows."""
        return TrainingSet(self.features[which], self.truth[which], self.motor[which], self.kind[which])

    def joined(self, other: TrainingSet) -> TrainingSet:
        """The windows of both."""
        return stacked([self, other])


def simulate_training(
    spec: TrainingSpec,
    motors: int,
    *,
    novel: bool = False,
    jobs: int = -1,
    dask: str | None = None,
    progress: Progress | None = None,
) -> TrainingSet:
    """Windows of so many simulated motors.

    Args:
        novel: beside each healthy window two with a fault, and one of a motor outside the range.
        jobs: processes on this machine; −1: one per core.
        dask: address of a Dask scheduler, such as "tcp://host:8786"; the tasks then run on its workers.

    Raises:
        BadInputError: no such scheduler, no motors, or hardly any motor of this datasheet moves.
        ServoDaemonError: Dask is not installed.
    """
    if motors < 1:
        raise BadInputError(f"at least one motor is needed, not {motors}")
    core = draw_parameters(spec, motors)
    tasks = [range(k, min(k + _PER_TASK, motors)) for k in range(0, motors, _PER_TASK)]
    parts: list[TrainingSet] = []
    with _engine(dask, jobs):
        from joblib import Parallel, delayed

        work = (delayed(simulate_motors)(spec, t, core[t.start : t.stop], novel=novel) for t in tasks)
        for part in Parallel(return_as="generator", batch_size=1, pre_dispatch="all" if dask else "2*n_jobs")(work):
            parts.append(part)
            if progress is not None:
                progress(min(_PER_TASK * len(parts), motors))
    return _checked(stacked(parts), motors)


def _checked(windows: TrainingSet, motors: int) -> TrainingSet:
    """Raises BadInputError where most of the motors hardly moved."""
    usable = np.count_nonzero(windows.kind == HEALTHY)
    if usable < (1.0 - _MOST_LOST) * motors:
        raise BadInputError(
            f"only {usable} of {motors} simulated motors gave a usable window: "
            "are the nominal values and the sample rate those of a motor that moves?"
        )
    return windows


@contextlib.contextmanager
def _engine(dask: str | None, jobs: int) -> Iterator[None]:
    """The back end that joblib works with meanwhile."""
    from joblib import parallel_config

    if dask is None:
        with parallel_config(backend="loky", n_jobs=jobs, inner_max_num_threads=1):
            yield
        return
    try:
        client = scheduler(dask, timeout_s=5)
    except ImportError:
        raise ServoDaemonError("--dask needs Dask: pip install 'servo-daemon[dask]'") from None
    with client, parallel_config(backend="dask", client=client, wait_for_workers_timeout=30):
        yield


def simulate_motors(spec: TrainingSpec, numbers: Sequence[int], core: F64, *, novel: bool = False) -> TrainingSet:
    """A task: the windows of these motors.

    Args:
        core: their R, L, K, J, B, shape (len(numbers), 5).
        novel: see `simulate_training`.
    """
    loop = servo_loop(spec)
    parts = []
    for number, row in zip(numbers, core, strict=True):
        window, truth = simulate_window(spec, number, row, loop)
        parts.append(labelled(window, truth, number))
        if novel:
            rng = np.random.default_rng([spec.seed, 4, number])
            faulty = [with_fault(window, rng)[0] for _ in range(_FAULTS_EACH)]
            parts += [labelled(f, truth, number, FAULTY) for f in faulty]
            far = draw_outside(spec, number, row)
            parts.append(labelled(*simulate_window(spec, _FOREIGN_NUMBERS + number, far, loop), number, FOREIGN))
    return stacked([p for p in parts if p is not None])


def servo_loop(spec: TrainingSpec) -> SampleLoop:
    """The plant with its servo, which all motors of a training share."""
    from servo_daemon.plant.build import build_plant
    from servo_daemon.plant.compiled import SampleLoop
    from servo_daemon.plant.servo_loop import servo_step

    return SampleLoop(servo_step(build_plant(_checked_effects(spec))))


def simulate_window(
    spec: TrainingSpec, number: int, core: F64, loop: SampleLoop
) -> tuple[SampleBlock, Mapping[str, float]]:
    """The window of motor `number` with these R, L, K, J, B, shape (5,), and all its parameters."""
    from servo_daemon.simulate import SimulatedDrive

    motor = draw_motor(spec, number, core)
    drive = SimulatedDrive(motor.settings, loop=loop)
    drive.next_block(math.ceil(LEAD_S * spec.rate_hz))
    return drive.next_block(spec.samples), motor.truth


def _checked_effects(spec: TrainingSpec) -> tuple[str, ...]:
    from servo_daemon.plant.effects import check_effects

    check_effects(spec.plant_effects)
    return spec.plant_effects


def labelled(window: SampleBlock, truth: Mapping[str, float], motor: int, kind: int = HEALTHY) -> TrainingSet | None:
    """One window with what is known of its motor; None where it has no features."""
    try:
        features = compute_features(window)
    except BadInputError:
        return None
    values = [truth.get(name, 0.0 if name == "Tc" else np.nan) for name in TARGETS]
    labels = (np.array([n], dtype=np.int64) for n in (motor, kind))
    return TrainingSet(features[None], np.array([values]), *labels)


def measured_training(captures: Sequence[tuple[SampleBlock, Mapping[str, float]]], window_s: float) -> TrainingSet:
    """Windows of measured captures whose parameters are known, to be joined to simulated ones.

    Args:
        captures: samples, and R, L, K, J, B (and Tc, if there is dry friction) of the motor they are of.

    Raises:
        BadInputError: a parameter is missing, or a capture has no usable window.
    """
    parts = []
    for k, (block, truth) in enumerate(captures):
        if missing := [n for n in CORE if n not in truth]:
            raise BadInputError(f"measured capture {k + 1}: the motor's {', '.join(missing)} must be known")
        found = [f for w in cut_windows(block, window_s) if (f := labelled(w, truth, -1 - k)) is not None]
        if not found:
            raise BadInputError(f"measured capture {k + 1}: no window of {window_s:g} s has usable samples")
        parts += found
    return stacked(parts)


def cut_windows(block: SampleBlock, window_s: float) -> list[SampleBlock]:
    """The whole windows of this length in a recording, one after the other."""
    time = block.time_s - block.time_s[0]
    period = float(time[-1]) / max(len(time) - 1, 1)
    count = int((float(time[-1]) + 1.5 * period) / window_s)
    edges = np.searchsorted(time, np.arange(count + 1) * window_s - 0.25 * period)
    return [block.slice(a, b) for a, b in itertools.pairwise(edges.tolist()) if b - a > 1]


def stacked(parts: Sequence[TrainingSet]) -> TrainingSet:
    """The windows of all parts as one set."""
    none = np.empty(0, dtype=np.int64)
    empty = TrainingSet(np.empty((0, len(catalogue.NAMES))), np.empty((0, len(TARGETS))), none, none)
    columns: list[Any] = [[getattr(p, f.name) for p in (empty, *parts)] for f in fields(TrainingSet)]
    return TrainingSet(*(np.concatenate(c) for c in columns))
