"""Maximum-likelihood restart: the values that predict the first samples best, for a filter that has not found its own.

Where R and K lie along a line on which the balances hardly change (slow motion of a motor with much friction), or R and
L along one (a winding that settles between two samples), an extended Kalman filter is led astray by its derivatives at
wrong values, and the regressions, which are not, hardly know. The samples do: an ordinary Kalman filter with given
parameters predicts each of them from those before it, and its likelihood, maximised over parameters and noise together,
is as exact as any estimate can be (Åström, *Automatica* 16, 1980). By Fisher's scoring: with ν the innovations, s their
variances, and derivatives by differences of whole passes,

    g_j = Σ ν ν_j / s − ½ (ν²/s − 1) s_j / s,     H_jk = Σ ν_j ν_k / s + ½ s_j s_k / s²,     θ ← θ − H⁻¹ g

The noise has to be found beside the parameters, and no process noise of these may be there: with the noise that the
filter had, and its drift, K of the paper's motor was 6 % off at 3.2 of its standard deviations (20 s of reversals, rms
of 12 draws); without the drift 2.6 % at 1.6; with both as here 1.5 % at 0.9 (of 8).

Without it `test_a_start_that_the_filter_does_not_find_is_found_by_likelihood` fails.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from servo_daemon.kalman.ekf import Ekf
from servo_daemon.kalman.gaussian import Gaussian
from servo_daemon.kalman.measurement import GATE
from servo_daemon.kalman.records import Innovations, NoiseLevels
from servo_daemon.numerics import inverse_of_information, score_and_information
from servo_daemon.samples import F64
from servo_daemon.tracking.noise.levels import LEAST_VAR
from servo_daemon.tracking.noise.setting import NoiseSetting
from servo_daemon.tracking.plan.parameter_masks import ParameterMasks
from servo_daemon.tracking.restart.divergence import DivergenceMonitor
from servo_daemon.tracking.restart.relinearisation import FOUND_TICK
from servo_daemon.tracking.samples.filtering import MOST_SAMPLES, STEPS_A_TICK, Filtering, Fit
from servo_daemon.tracking.validity.gates import QUALIFIED

#: After so many ticks of the filter the samples since its start are asked, and once more with those up to then
#: (decision 36: where slow reversals had left K 4.2 σ off).
_TICKS = (100, 155)
#: A search that has not settled after so many iterations is given up (free within 8 .. 30).
_MOST_ITERATIONS = 15
#: Steps of the differences: of one unit of a coordinate, of a variance's logarithm (far above rounding, far below what
#: is looked for; chosen; half and twice move no tracking figure).
_DIFFERENCE, _NOISE_DIFFERENCE = 1e-4, 0.05
#: An iteration moves no coordinate by more units than this, no variance's logarithm by more than that (free within
#: 0.25 .. 1 and 0.5 .. 2).
_LONGEST, _LONGEST_NOISE = 0.5, 1.0
#: Added to a variance's information, so that one that is nothing comes to rest; and how much smaller than in the
#: beginning it may become, logarithm (free within 0.5 .. 2 and −4 .. −16).
_DAMPING, _LEAST_NOISE = 1.0, -8.0
#: The last step, in standard deviations (the root of gᵀH⁻¹g over the parameters); samples are added meanwhile (chosen;
#: half and twice move no tracking figure).
_SETTLED = 0.3
#: The innovations then: lag-1 correlation at most, and mean of ν²/s around one (see `make calibrate`).
_WHITE, _AS_EXPECTED = 0.1, 0.15


@dataclass(frozen=True, slots=True)
class _Point:
    """Parameters' coordinates (n,) and the noise's log-variances (m,)."""

    coordinates: F64
    log_var: F64


@dataclass(slots=True)
class _Iteration:
    """Passes over the samples, one a point, of which a tick takes some (`STEPS_A_TICK`).

    Attributes:
        points: where, each with its distance from the first.
        base: what the filter says at the first; None: it has not been there yet.
        error, log_s: derivatives of the innovations and of their variances' logarithms along the others, so far.
    """

    points: list[tuple[_Point, float]]
    base: Innovations | None = None
    error: list[F64] = field(default_factory=list)
    log_s: list[F64] = field(default_factory=list)

    @property
    def next(self) -> _Point:
        """The point of the next pass."""
        return self.points[0 if self.base is None else 1 + len(self.error)][0]

    def take(self, there: Innovations) -> bool:
        """What the filter says at the next point. Returns whether that was the last."""
        if self.base is None:
            self.base = there
        else:
            by = self.points[1 + len(self.error)][1]
            self.error.append(((there.innovation - self.base.innovation) / by).ravel())
            self.log_s.append((np.log(there.variance / self.base.variance) / by).ravel())
        return len(self.error) == len(self.points) - 1


class MaximumLikelihoodRestart:
    """Maximises the likelihood of one filter's first samples, some passes a tick, and sets the filter to the result."""

    def __init__(self, masks: ParameterMasks, ekf: Ekf, filtering: Filtering, noise: NoiseSetting) -> None:
        self._masks, self._ekf, self._filtering, self._noise = masks, ekf, filtering, noise
        self._free = np.flatnonzero(masks.free)
        asked = [p.transform == "log" and p.name != "L" for p in masks.parameters]
        self._asked = np.flatnonzero((masks.published & np.array(asked))[self._free])
        self.begin(asked=False)

    def begin(self, *, asked: bool) -> None:
        """A filter starts.

        Args:
            asked: it may be asked for; a filter from a saved state knows enough.
        """
        self._waits, self._iterations = asked, 0
        self._iteration: _Iteration | None = None
        self._compares = False
        self._passes = 1
        self._at = _Point(np.zeros(0), np.zeros(0))
        self._least_log_var: F64 = np.zeros(0)

    @property
    def is_open(self) -> bool:
        """It may yet be asked for."""
        return self._waits

    def update(self, tick: int, scales: F64, monitor: DivergenceMonitor) -> bool:
        """After each tick. Returns whether the filter has been set to what was found.

        Args:
            tick: number of the running filter's.
            scales: one unit of each coordinate, shape (n,).
            monitor: of what the filter has found.
        """
        if not self._waits or tick < FOUND_TICK:
            return False
        searches = self._iteration is not None
        if not monitor.of_its_start or (not searches and self._filtering.kept > MOST_SAMPLES):
            self.end()
            return False
        if not self._compares:
            self._compares, self._filtering.own = True, Fit()
        if tick in _TICKS and self._filtering.kept <= MOST_SAMPLES:
            self._begin_search(scales)
        if self._iteration is None:
            return False
        found = self._go_on(self._iteration, scales)
        if found or self._iterations == _MOST_ITERATIONS:
            self._iteration = None
            if tick >= _TICKS[-1]:
                self.end()
        return found

    def _begin_search(self, scales: F64) -> None:
        self._filtering.begin_batch()
        self._passes = max(1, STEPS_A_TICK // self._filtering.kept)
        self._iterations, self._at = 0, self._here()
        self._least_log_var = self._at.log_var + _LEAST_NOISE
        self._iteration = _Iteration(self._around(scales))

    def end(self) -> None:
        """Nothing is asked any more: what is known is enough, or the motor is another one than in its first samples."""
        self._waits, self._iteration = False, None
        self._filtering.keep(None)

    def _here(self) -> _Point:
        noise = self._ekf.noise
        var = np.array([noise.input_var, noise.torque_psd, *noise.channel_var])
        return _Point(self._ekf.coordinates, np.log(np.maximum(var, LEAST_VAR)))

    def _go_on(self, iteration: _Iteration, scales: F64) -> bool:
        """A tick's share of the passes. Returns whether the search is over, and the filter is there; else it is as it
        was."""
        before, constants = self._ekf.snapshot(), self._ekf.constants
        found = False
        for _ in range(self._passes):
            there = self._predicted(iteration.next)
            if not there.possible:  # so far off that the filter overflows: nothing leads back from there
                self._iterations = _MOST_ITERATIONS
                break
            if iteration.take(there):
                found = self._iterated(iteration, scales)
                break
        if not found:
            self._ekf.restore(before)
        self._ekf.put_constants(constants)
        if found:
            self._tell_noise()
        return found

    def _iterated(self, iteration: _Iteration, scales: F64) -> bool:
        """One step of the scoring. Returns whether it was the last, and the filter is there."""
        self._iterations += 1
        assert iteration.base is not None
        step, covariance = self._step(iteration, iteration.base)
        var = covariance.diagonal()[self._asked]  # below zero by rounding where nothing is known along some direction
        known = bool(np.all((var > 0.0) & (var < QUALIFIED**2)))
        n = len(self._free)
        length = step[:n] @ np.linalg.pinv(covariance, hermitian=True) @ step[:n]
        if known and 0.0 <= length < _SETTLED**2 and self._explains(iteration.base) and self._goes_on_from(covariance):
            return True
        self._at = self._moved(step, scales)
        self._iteration = _Iteration(self._around(scales))
        return False

    def _predicted(self, at: _Point, *, up_to_now: bool = False) -> Innovations:
        """The kept samples, each predicted from those before it with these parameters and this noise.

        Args:
            up_to_now: those that have come since the search began, too.
        """
        var = np.exp(at.log_var).tolist()
        self._ekf.set_noise(NoiseLevels(var[0], var[1], tuple(var[2:])))
        zeros = np.zeros(len(at.coordinates))
        self._ekf.set_active(zeros, zeros)
        return self._filtering.predictions(
            Gaussian(self._masks.names, at.coordinates, np.diag(zeros)), up_to_now=up_to_now
        )

    def _step(self, iteration: _Iteration, base: Innovations) -> tuple[F64, F64]:
        """Of the free coordinates and the log-variances, shape (n + m,); and the covariance of the former, (n, n)."""
        nu, s = base.innovation.ravel(), base.variance.ravel()
        z2 = np.square(nu) / s
        usual = z2 < GATE**2
        d_nu, d_s = np.array(iteration.error) * (usual / np.sqrt(s)), np.array(iteration.log_s) * usual
        z, n = nu / np.sqrt(s), len(self._free)
        gradient, H = score_and_information(z, d_nu - 0.5 * z * d_s, d_s)
        inverse = 2.0 * inverse_of_information(H + np.diag([0.0] * n + [2.0 * _DAMPING] * (len(d_nu) - n)))
        return -0.5 * inverse @ gradient, inverse[:n, :n]

    def _around(self, scales: F64) -> list[tuple[_Point, float]]:
        """Where the search is, and the points at a small distance along each unknown, with that distance."""
        at = self._at
        out = [(at, 0.0)]
        for k in self._free.tolist():
            by = _DIFFERENCE * float(scales[k])
            out.append((_Point(at.coordinates + by * (np.arange(len(at.coordinates)) == k), at.log_var), by))
        for k in range(len(at.log_var)):
            moved = at.log_var + _NOISE_DIFFERENCE * (np.arange(len(at.log_var)) == k)
            out.append((_Point(at.coordinates, moved), _NOISE_DIFFERENCE))
        return out

    def _moved(self, step: F64, scales: F64) -> _Point:
        n = len(self._free)
        coordinates, longest = self._at.coordinates.copy(), float(np.max(np.abs(step[:n]) / scales[self._free]))
        coordinates[self._free] += step[:n] * min(1.0, _LONGEST / max(longest, 1e-300))
        log_var = self._at.log_var + np.clip(step[n:], -_LONGEST_NOISE, _LONGEST_NOISE)
        return _Point(coordinates, np.maximum(log_var, self._least_log_var))

    def _explains(self, base: Innovations) -> bool:
        """Whether the innovations are white and as large as they should be, in every channel."""
        z = base.innovation / np.sqrt(base.variance)
        if np.count_nonzero(np.abs(z) > GATE) > 0:
            return False
        square, number = np.sum(np.square(z), axis=0), np.maximum(np.sum(base.measured, axis=0), 1)
        correlation = np.sum(z[1:] * z[:-1], axis=0) / np.maximum(square, 1e-12)
        return bool((np.abs(square / number - 1.0) < _AS_EXPECTED).all() and (np.abs(correlation) < _WHITE).all())

    def _is_better(self, found: Innovations) -> bool:
        """Whether these values predict what has come since the filter was through its start better than the filter did.
        The likeliest constants of a motor that is none are wrong, and the filter, which follows it, is not."""
        n = self._filtering.own.samples
        last = Innovations(found.innovation[-n:], found.variance[-n:], found.gated[-n:])
        return n > 0 and Fit().with_more(last).cost < self._filtering.own.cost

    def _goes_on_from(self, covariance: F64) -> bool:
        """Whether what was found is better than the filter; then it is at the last sample with that."""
        if not self._is_better(self._predicted(self._at, up_to_now=True)):
            return False
        everything = np.zeros((len(self._at.coordinates),) * 2)
        everything[np.ix_(self._free, self._free)] = covariance
        self._ekf.put_parameters(self._at.coordinates, everything)
        self._ekf.take_statistics()
        return True

    def _tell_noise(self) -> None:
        """The noise of current and voltage as it was found."""
        if self._noise.of_current is not None:
            var = np.exp(self._at.log_var)
            at = 2 + self._ekf.channels.index("current_A")
            self._noise.put_of_current(float(var[at]), float(var[0]))
