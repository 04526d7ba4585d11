"""The extended Kalman filter as an object: state, constants and the compiled loop over `model`'s step."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from servo_daemon.kalman.gaussian import Gaussian, completed
from servo_daemon.kalman.held import build_held_step
from servo_daemon.kalman.layout import STATISTICS, EkfLayout
from servo_daemon.kalman.model import INSTRUMENT_S, NO_INSTRUMENT_S, build_ekf_step
from servo_daemon.kalman.moments import Moments, conditioned, set_apart
from servo_daemon.kalman.records import ChannelStatistics, Innovations, NoiseLevels
from servo_daemon.numerics import is_definite
from servo_daemon.plant.build import PlantModel
from servo_daemon.plant.compiled import SampleLoop
from servo_daemon.plant.effects.base import LATE
from servo_daemon.samples import F64

#: Standard deviations of the plant's states when nothing is known of them: current A, speed rad/s, angle rad (vague
#: beside what the first samples say; chosen; free within half and twice).
_UNKNOWN_STATE_STD = {"current_A": 100.0, "velocity_rad_s": 1000.0, "position_rad": 100.0}

#: Variance of a parameter the filter must not move.
_HELD_VARIANCE = 1e-18
#: What rounding may take from an eigenvalue of a correlation matrix (n ε is 10⁻¹⁵).
_ROUNDING = 1e-12
_LAST = STATISTICS.index("last")


class Loop(Protocol):
    """What runs the step: `SampleLoop`, or the one in `filterpy_ekf`."""

    def run(self, state: F64, constants: F64, samples: F64) -> F64: ...


class Ekf:
    """Joint state and parameter filter.

    Args:
        plant: the model.
        channels: measured channels, some of `layout.MEASURABLE`.
        loop: engine of the running recursion; the compiled one if None.
        mean_input: see `build_ekf_step`.
    """

    def __init__(
        self, plant: PlantModel, channels: tuple[str, ...], loop: Loop | None = None, *, mean_input: bool = False
    ) -> None:
        self.channels, self._mean_input = channels, mean_input
        self.use(plant, loop)
        self._state = np.zeros(self._lay.n_state)
        self._constants = np.zeros(self._lay.n_constants)
        self.use_instrumental_trajectory(True)
        self._moments = Moments(self._lay)
        self.started = False

    def use(self, plant: PlantModel, loop: Loop | None = None) -> None:
        """Go on with the same model in other parts, see `PlantModel`."""
        self.plant = plant
        self._lay, function = build_ekf_step(plant, self.channels, self._mean_input)
        self._compiled: Loop = SampleLoop(function)
        self._running: Loop = self._compiled if loop is None else loop
        self._held: Loop | None = None  # made when it is asked for

    @property
    def layout(self) -> EkfLayout:
        return self._lay

    def reset(self) -> None:
        self._state[:] = 0.0
        self.started = False

    def start(self, parameters: Gaussian, x: F64 | None = None, held_input: float = 0.0, held_var: float = 0.0) -> None:
        """Begin from these parameters and, if given, these plant states (as a mean; their spread is wide)."""
        mean, covariance = completed(parameters, self.plant.parameters, _HELD_VARIANCE)
        z, P = np.zeros(self._lay.n_z), np.zeros((self._lay.n_z, self._lay.n_z))
        z[self._lay.q] = mean
        P[self._lay.q, self._lay.q] = covariance
        self._state[:] = 0.0
        self._state[self._lay.held_input], self._state[self._lay.held_variance] = held_input, held_var
        self._moments.put(self._state, z, P)
        self.forget_state(x)
        self.started = True

    def forget_state(self, x: F64 | None) -> None:
        """After a pause or a restart of the device: parameters are kept, the plant's states are unknown again."""
        initial = np.array([s.initial for s in self.plant.states]) if x is None else x
        self._forget(list(range(self._lay.n_x)), initial)

    def forget_motion(self, x: F64) -> None:
        """After missing samples: current, speed and angle are unknown again, and what a late sensor kept of them; what
        changes slowly (a temperature) is known as before.

        Args:
            x: where the plant's states are to start, shape (n_x,); those that are not forgotten are not looked at.
        """
        self._forget([k for k, s in enumerate(self.plant.states) if s.name in _UNKNOWN_STATE_STD or s in LATE], x)

    def _forget(self, which: list[int], x: F64) -> None:
        states = [self.plant.states[k] for k in which]
        self._know_states(which, x[which], [_UNKNOWN_STATE_STD.get(s.name, 3 * s.scale) ** 2 for s in states])
        self._state[-1] = 0.0

    def know_state(self, name: str, mean: float, var: float) -> None:
        """What is known of a state of the plant from elsewhere; it is correlated with nothing."""
        self._know_states([self.plant.state_names.index(name)], mean, [var])

    def _know_states(self, which: list[int], mean: F64 | float, var: list[float]) -> None:
        z, P = self._moments.of(self._state)
        z[which] = mean
        set_apart(P, which, np.diag(var))
        self._moments.put(self._state, z, P)
        self._state[self._lay.trajectory] = z[self._lay.x]

    def set_noise(self, noise: NoiseLevels) -> None:
        self._constants[0], self._constants[1] = noise.input_var, noise.torque_psd
        self._constants[self._lay.r] = noise.channel_var

    @property
    def noise(self) -> NoiseLevels:
        """The noise levels as they were set."""
        r = tuple(self._constants[self._lay.r].tolist())
        return NoiseLevels(float(self._constants[0]), float(self._constants[1]), r)

    @property
    def constants(self) -> F64:
        """A copy of what the filter is told: noise, walks, which parameters may move, whether it has an instrumental
        trajectory."""
        return self._constants.copy()

    def put_constants(self, constants: F64) -> None:
        """Set all constants as `constants` gave them before."""
        self._constants[:] = constants

    def set_active(self, active: NDArray[np.bool_] | F64, walk_var_per_s: F64) -> None:
        """How the parameters may move.

        Args:
            active: shape (n_q,), 1 or 0: whether the gain's row acts.
            walk_var_per_s: shape (n_q,): process noise of each coordinate, 1/s.
        """
        self._constants[self._lay.walk] = walk_var_per_s
        self._constants[self._lay.active] = active

    def hold(self) -> None:
        """Hold every parameter from now on."""
        self._constants[self._lay.active] = 0.0

    def use_instrumental_trajectory(self, use: bool) -> None:
        """Whether derivatives are taken along the instrumental trajectory (`model`); for parameters that are nearly
        right."""
        self._constants[-1] = INSTRUMENT_S if use else NO_INSTRUMENT_S

    def update(self, samples: F64, *, again: bool = False) -> Innovations:
        """Run over samples laid out as `EkfLayout` says, shape (n, n_sample).

        Args:
            again: they are gone over again: with the compiled step whatever the engine is, for these are a hundred
                times as many as there are samples.
        """
        outputs = (self._compiled if again else self._running).run(self._state, self._constants, samples)
        return Innovations(outputs[:, 0::3], outputs[:, 1::3], outputs[:, 2::3])

    def predict_held(self, samples: F64) -> Innovations:
        """As `update(…, again=True)` with parameters that are known exactly, in a tenth of its time: of all that the
        filter carries the plant's states, their covariance and the held input go on, and nothing else.

        Args:
            samples: shape (n, n_sample).
        """
        if self._held is None:
            _, function = build_held_step(self.plant, self.channels, self._mean_input)
            self._held = SampleLoop(function, paced_by=1)
        lay = self._lay
        index = [*range(lay.n_x), *lay.state_covariance, lay.held_input, lay.held_variance]
        state = self._state[index]
        constants = np.concatenate([self._constants, self._state[lay.q]])
        outputs = self._held.run(state, constants, samples)
        self._state[index] = state
        return Innovations(outputs[:, 0::3], outputs[:, 1::3], outputs[:, 2::3])

    def take_information(self) -> F64:
        """Information gained on each parameter's coordinate since the last call: Σ (1/σ²_after − 1/σ²_before)."""
        gained = self._state[self._lay.information].copy()
        self._state[self._lay.information] = 0.0
        return gained

    def take_statistics(self) -> dict[str, ChannelStatistics]:
        """Sums over the innovations of each channel since the last call."""
        sums = self._state[self._lay.statistics].reshape(len(self.channels), len(STATISTICS))
        taken = {name: ChannelStatistics.of(row) for name, row in zip(self.channels, sums.tolist(), strict=True)}
        last = sums[:, _LAST].copy()
        sums[:] = 0.0
        sums[:, _LAST] = last  # goes on from sample to sample
        return taken

    @property
    def mean(self) -> F64:
        return self._state[self._lay.z].copy()

    @property
    def covariance(self) -> F64:
        return self._moments.of(self._state)[1]

    @property
    def x(self) -> F64:
        """The plant's states, shape (n_x,)."""
        return self._state[self._lay.x].copy()

    @property
    def state_var(self) -> F64:
        """Variances of the plant's states, shape (n_x,)."""
        return self._state[self._moments.variances[self._lay.x]]

    def estimate(self) -> Gaussian:
        return Gaussian(self.plant.parameter_names, *self.parameters_of(self._state))

    @property
    def coordinates(self) -> F64:
        """The parameters' coordinates, shape (n_q,)."""
        return self._state[self._lay.q].copy()

    @property
    def coordinate_std(self) -> F64:
        """1 σ of the parameters' coordinates, shape (n_q,)."""
        return np.asarray(np.sqrt(np.maximum(self._state[self._moments.parameter_variances], 0.0)))

    def correlation(self, k: int, j: int) -> float:
        """Of two coordinates' errors."""
        at = self._moments.parameters
        variances = self._state[at[k, k]] * self._state[at[j, j]]
        return float(self._state[at[k, j]] / np.sqrt(max(variances, 1e-300)))

    def snapshot(self) -> F64:
        """A copy of everything the filter carries, for `parameters_of`; cheap."""
        return self._state.copy()

    def restore(self, snapshot: F64) -> None:
        """Everything as it was then."""
        self._state[:] = snapshot

    def parameters_of(self, snapshot: F64) -> tuple[F64, F64]:
        """The parameters' coordinates (n_q,) and their covariance (n_q, n_q) in a snapshot."""
        return snapshot[self._lay.q].copy(), snapshot[self._moments.parameters]

    def moments_of(self, snapshot: F64) -> tuple[F64, F64]:
        """The parameters' coordinates and their variances in a snapshot, shape (n_q,) each."""
        return snapshot[self._lay.q], snapshot[self._moments.parameter_variances]

    def put_parameters(self, mean: F64, covariance: F64) -> None:
        """Replace what is known of the parameters; the plant's states stay and are no longer correlated with them.

        Args:
            mean: coordinates, shape (n_q,).
            covariance: shape (n_q, n_q).
        """
        z, P = self._moments.of(self._state)
        z[self._lay.q] = mean
        set_apart(P, list(range(self._lay.n_x, self._lay.n_z)), covariance)
        self._moments.put(self._state, z, P)

    def take_in(self, index: NDArray[np.intp], mean: F64, covariance: F64) -> None:
        """What is known of some coordinates from elsewhere, or was known of them before, as a measurement: states and
        other parameters follow by their correlations.

        Args:
            index: which, shape (k,).
            mean, covariance: of these, shapes (k,) and (k, k).
        """
        if len(index) == 0:
            return
        z, P = self._moments.of(self._state)
        self._moments.put(self._state, *conditioned(z, P, self._lay.n_x + index, mean, covariance))

    def widen_parameters(self, var: F64) -> None:
        """Add to the variances of the coordinates, shape (n_q,)."""
        self._state[self._moments.parameter_variances] += var

    def put_coordinate(self, k: int, coordinate: float) -> None:
        """Coordinate k is somewhere else; nothing else moves."""
        self._state[self._lay.n_x + k] = coordinate

    def is_plausible(self) -> bool:
        """Everything finite and every variance positive; cheap."""
        variances = self._state[self._moments.variances]
        return bool(np.logical_and.reduce(np.isfinite(self._state)) and np.minimum.reduce(variances) > 0.0)

    def is_sound(self) -> bool:
        """Plausible, and the covariance has a Cholesky factor."""
        if not self.is_plausible():
            return False
        P = self.covariance
        scale = np.sqrt(np.diag(P))
        return is_definite(P / np.outer(scale, scale), beyond=-_ROUNDING)
