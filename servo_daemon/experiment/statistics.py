"""What a block of motion says, as sums that add up over blocks.

For the parameters of one model, with J the sensitivities of what the sensors show in units of their noise, less what
the block's own initial state explains of them, that is the Fisher information JᵀJ. For two models, with d the
difference of what they show, it is the Gram matrix of [J d], from which the distance that is left when the second model
is fitted to the first,

    T = min_δ ‖d − J δ‖² = dᵀd − dᵀJ (JᵀJ)⁻¹ Jᵀd,

follows for any mixture of blocks: the criterion of T-optimality (Atkinson & Fedorov, *Biometrika* 62, 1975, 57–70).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from servo_daemon.experiment.models import Model
from servo_daemon.identification.output_error.problem.rollout import INPUT, STEP, TIME, free_run, simulate
from servo_daemon.samples import F64

#: States that every block may choose; those of effects (a winding's heat) go on from block to block.
_OWN = ("current_A", "velocity_rad_s", "position_rad")
#: Free runs under noise whose mean square is taken.
_NOISE_RUNS, _NOISE_SEED = 8, 1


@dataclass(frozen=True, slots=True)
class Noise:
    """Of the channels, shape (c,), 1 σ."""

    channels: tuple[str, ...]
    std: F64


def rows_of(voltage: F64, rate_hz: float) -> F64:
    """As `rollout` takes them, shape (n, 3)."""
    rows = np.empty((len(voltage), 3))
    rows[:, TIME] = np.arange(len(voltage)) / rate_hz
    rows[:, STEP] = 1.0 / rate_hz
    rows[:, INPUT] = voltage
    return rows


def make_noise(model: Model, sensor_std: Mapping[str, float], input_std_V: float, rate_hz: float, n: int) -> Noise:
    """What a free run of n samples differs by from the motor because of its sensors and of a voltage that nobody sees.

    Args:
        sensor_std: by channel, 1 σ.
        input_std_V: white noise of the applied voltage, held over a sample, 1 σ.
    """
    q, channels = model.coordinates(model.draws[0]), tuple(sensor_std)
    voltage = input_std_V * np.random.default_rng(_NOISE_SEED).standard_normal((_NOISE_RUNS, n))
    squares = np.zeros(len(channels))
    for v in voltage:
        run = simulate(model.plant, channels, q, start_state(model), rows_of(v, rate_hz))
        unit = Noise(channels, np.ones(len(channels)))
        Q = np.linalg.qr(_states(model, run.by_state, unit))[0]
        left = run.shown.ravel() - Q @ (Q.T @ run.shown.ravel())
        squares += np.mean(left.reshape(run.shown.shape) ** 2, axis=0) / _NOISE_RUNS
    return Noise(channels, np.sqrt(squares + np.array(list(sensor_std.values())) ** 2))


def start_state(model: Model) -> F64:
    """The state of a motor at rest, shape (nx,)."""
    return np.array([s.initial for s in model.plant.states])


def path(model: Model, q: F64, x0: F64, rows: F64) -> F64:
    """The plant's states at every sample, shape (n, nx)."""
    return free_run(model.plant, ("current_A",), q, x0, rows)[1]


def fisher(model: Model, q: F64, x0: F64, rows: F64, noise: Noise) -> F64:
    """JᵀJ of the free parameters in their units, shape (k, k)."""
    run = simulate(model.plant, noise.channels, q, x0, rows)
    J = _whitened(run.by_parameter[:, :, model.columns] * model.units, noise)
    return _gram(J, _states(model, run.by_state, noise))


def contrast(model: Model, q: F64, x0: F64, rows: F64, noise: Noise, truth: F64) -> F64:
    """Gram matrix of [J d], shape (k + 1, k + 1).

    Args:
        truth: shape (n, c), what is shown if the other model is true.
    """
    run = simulate(model.plant, noise.channels, q, x0, rows)
    d = _whitened((truth - run.shown)[:, :, None], noise)
    J = _whitened(run.by_parameter[:, :, model.columns] * model.units, noise)
    return _gram(np.hstack([J, d]), _states(model, run.by_state, noise))


def distance(gram: F64, prior: F64) -> tuple[float, F64]:
    """T of a sum of `contrast`, and the step δ of the free coordinates that leaves it, in their units."""
    A, b, c = gram[:-1, :-1] + np.diag(prior), gram[:-1, -1], float(gram[-1, -1])
    step = np.asarray(np.linalg.solve(A, b), dtype=np.float64)
    return max(c - float(b @ step), 0.0), step


def _whitened(values: F64, noise: Noise) -> F64:
    """(n, c, k) to (n·c, k), in units of the noise."""
    return np.asarray((values / noise.std[:, None]).reshape(-1, values.shape[2]))


def _states(model: Model, by_state: F64, noise: Noise) -> F64:
    own = [model.plant.state_names.index(n) for n in _OWN]
    S = _whitened(by_state[:, :, own], noise)
    return np.asarray(S / np.maximum(np.linalg.norm(S, axis=0), 1e-300))


def _gram(A: F64, states: F64) -> F64:
    """AᵀA less what the states explain."""
    Q = np.linalg.qr(states)[0]
    A = A - Q @ (Q.T @ A)
    return np.asarray(A.T @ A)
