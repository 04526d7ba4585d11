"""The extended Kalman filter as an object: state, constants and the compiled loop over `ekf_model`'s step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from servo_daemon.estimators.base import Gaussian, to_coordinate
from servo_daemon.estimators.ekf_model import EkfLayout, build_ekf_step
from servo_daemon.plant.build import PlantModel
from servo_daemon.plant.compiled import SampleLoop
from servo_daemon.samples import F64

#: Standard deviations of the plant's states when nothing is known of them: current A, speed rad/s, angle rad.
_UNKNOWN_STATE_STD = {"current_A": 100.0, "velocity_rad_s": 1000.0, "position_rad": 100.0}

#: Variance of a parameter the filter must not move.
_HELD_VARIANCE = 1e-18


class Loop(Protocol):
    """What runs the step: `SampleLoop`, or the readable one in `filterpy_ekf`."""

    def run(self, state: F64, constants: F64, samples: F64) -> F64: ...


@dataclass(frozen=True, slots=True)
class NoiseLevels:
    """Variances the filter works with.

    Attributes:
        input_var: of the held input (V², A² or (N·m)²).
        torque_psd: of a white load torque, (N·m)²·s.
        channel_var: per measured channel, in its unit squared.
    """

    input_var: float
    torque_psd: float
    channel_var: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Innovations:
    """What a run of samples had to say to the filter; shape (n, channels) each; invalid samples are 0."""

    innovation: F64
    variance: F64
    gated: F64

    def are_sound(self) -> bool:
        """Everything finite and every variance positive."""
        return bool(
            np.isfinite(self.innovation).all() and (self.variance > 0).all() and np.isfinite(self.variance).all()
        )


class Ekf:
    """Joint state and parameter filter.

    Args:
        plant: the model.
        channels: measured channels, some of `ekf_model.MEASURABLE`.
        drift_var_per_s: random-walk intensity of each parameter's coordinate, 1/s, shape (n_q,).
        loop: engine; the compiled one if None.
    """

    def __init__(
        self, plant: PlantModel, channels: tuple[str, ...], drift_var_per_s: F64, loop: Loop | None = None
    ) -> None:
        self.plant, self.channels = plant, channels
        layout, function = build_ekf_step(plant, channels)
        self._lay: EkfLayout = layout
        self._loop: Loop = SampleLoop(function) if loop is None else loop
        self._drift = drift_var_per_s
        self._state = np.zeros(layout.n_state)
        self._constants = np.zeros(layout.n_constants)
        rows, columns = np.tril_indices(layout.n_z)
        order = np.lexsort((rows, columns))  # by columns, as the step packs it
        self._rows, self._columns = rows[order], columns[order]
        self.started = False

    @property
    def layout(self) -> EkfLayout:
        return self._lay

    def reset(self) -> None:
        self._state[:] = 0.0
        self.started = False

    def start(self, parameters: Gaussian, x: F64 | None = None, held_input: float = 0.0, held_var: float = 0.0) -> None:
        """Begin from these parameters and, if given, these plant states (as a mean; their spread is wide)."""
        mean, covariance = self._ordered(parameters)
        z, P = np.zeros(self._lay.n_z), np.zeros((self._lay.n_z, self._lay.n_z))
        z[self._lay.q] = mean
        P[self._lay.q, self._lay.q] = covariance
        self._state[:] = 0.0
        self._state[self._lay.held_input], self._state[self._lay.held_variance] = held_input, held_var
        self._put(z, P)
        self.forget_state(x)
        self.started = True

    def forget_state(self, x: F64 | None = None) -> None:
        """After a pause or a restart of the device: parameters are kept, the plant's states are unknown again."""
        initial = np.array([s.initial for s in self.plant.states]) if x is None else x
        self._forget(list(range(self._lay.n_x)), initial)

    def forget_motion(self, x: F64) -> None:
        """After missing samples: current, speed and angle are unknown again; what changes slowly (a temperature) is
        known as before.

        Args:
            x: where the plant's states are to start, shape (n_x,); those that are not forgotten are not looked at.
        """
        self._forget([k for k, s in enumerate(self.plant.states) if s.name in _UNKNOWN_STATE_STD], x)

    def _forget(self, which: list[int], x: F64) -> None:
        z, P = self.mean, self.covariance
        z[which] = x[which]
        P[which, :] = 0.0
        P[:, which] = 0.0
        for k in which:
            state = self.plant.states[k]
            P[k, k] = _UNKNOWN_STATE_STD.get(state.name, 3 * state.scale) ** 2
        self._put(z, P)

    def doubt_input(self, var: float) -> None:
        """Samples are missing before the next one: what was applied meanwhile is known only to this variance more."""
        self._state[self._lay.held_variance] += var

    def set_noise(self, noise: NoiseLevels) -> None:
        self._constants[0], self._constants[1] = noise.input_var, noise.torque_psd
        self._constants[2 + 2 * self._lay.n_q :] = noise.channel_var

    def set_active(self, active: F64, walking: F64) -> None:
        """Which parameters may move.

        Args:
            active: shape (n_q,), 1 or 0: whether the gain's row acts.
            walking: shape (n_q,), 1 or 0: whether process noise is added.
        """
        n = self._lay.n_q
        self._constants[2 : 2 + n] = self._drift * walking
        self._constants[2 + n : 2 + 2 * n] = active

    def update(self, samples: F64) -> Innovations:
        """Run over samples laid out as `EkfLayout` says, shape (n, n_sample)."""
        outputs = self._loop.run(self._state, self._constants, samples)
        return Innovations(outputs[:, 0::3], outputs[:, 1::3], outputs[:, 2::3])

    def take_information(self) -> F64:
        """Information gained on each parameter's coordinate since the last call: Σ (1/σ²_after − 1/σ²_before)."""
        gained = self._state[self._lay.information].copy()
        self._state[self._lay.information] = 0.0
        return gained

    @property
    def mean(self) -> F64:
        return self._state[self._lay.z].copy()

    @property
    def covariance(self) -> F64:
        P = np.empty((self._lay.n_z, self._lay.n_z))
        P[self._rows, self._columns] = P[self._columns, self._rows] = self._state[self._lay.tri]
        return P

    @property
    def x(self) -> F64:
        """The plant's states, shape (n_x,)."""
        return self._state[self._lay.x].copy()

    def estimate(self) -> Gaussian:
        lay = self._lay
        return Gaussian(self.plant.parameter_names, self._state[lay.q].copy(), self.covariance[lay.q, lay.q])

    def is_sound(self) -> bool:
        """Everything finite and every variance positive (a Cholesky factor exists)."""
        if not np.isfinite(self._state).all():
            return False
        P = self.covariance
        if not (np.diag(P) > 0).all():
            return False
        scale = np.sqrt(np.diag(P))
        try:
            np.linalg.cholesky(P / np.outer(scale, scale) + 1e-12 * np.eye(len(P)))
        except np.linalg.LinAlgError:
            return False
        return True

    def _put(self, z: F64, P: F64) -> None:
        self._state[self._lay.z] = z
        self._state[self._lay.tri] = P[self._rows, self._columns]

    def _ordered(self, g: Gaussian) -> tuple[F64, F64]:
        """The given estimates in the plant's order; a parameter not given is held at its table value."""
        n = self._lay.n_q
        mean = np.array([to_coordinate(p, p.nominal) for p in self.plant.parameters])
        covariance = np.diag(np.full(n, _HELD_VARIANCE))
        index = [self.plant.parameter_names.index(name) for name in g.names]
        mean[index] = g.mean
        covariance[np.ix_(index, index)] = g.covariance + np.diag(np.full(len(index), _HELD_VARIANCE))
        return mean, covariance
