"""Simulate and fit in one go: what the command line and the daemon call."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from servo_daemon.learning import DEFAULT_MOTORS, Learner
from servo_daemon.learning.examples.drawing import TrainingSpec
from servo_daemon.learning.examples.targets import Target
from servo_daemon.learning.examples.training import TrainingSet, simulate_training
from servo_daemon.learning.model.model import LearnedModel
from servo_daemon.learning.training.fitting import train_model


@dataclass(frozen=True)
class Job:
    """How to train.

    Attributes:
        motors: simulated.
        target, learner: see `targets` and `learners`.
        jobs: processes on this machine; −1: one per core.
        dask: address of a scheduler whose workers simulate; None: this machine.
        measured: windows of measured captures, beside the simulated ones.
    """

    motors: int = DEFAULT_MOTORS
    target: Target = "correction"
    learner: Learner = "grnn"
    jobs: int = -1
    dask: str | None = None
    measured: TrainingSet | None = None


def train(
    spec: TrainingSpec,
    job: Job,
    *,
    progress: Callable[[int], object] | None = None,
    say: Callable[[str], object] | None = None,
) -> LearnedModel:
    """A model of simulated motors.

    Args:
        progress: told how many motors are done.
        say: told what is being done after that.

    Raises:
        BadInputError: see `simulate_training` and `train_model`.
    """
    began = time.perf_counter()
    windows = simulate_training(spec, job.motors, novel=True, jobs=job.jobs, dask=job.dask, progress=progress)
    simulated_s = time.perf_counter() - began
    if job.measured is not None:
        windows = windows.joined(job.measured)
    model = train_model(spec, windows, target=job.target, learner=job.learner, say=say)
    facts = dict(model.facts) | {"motors_drawn": job.motors, "windows": len(windows), "simulation_s": simulated_s}
    return replace(model, facts=facts)
