"""A prediction of the motor from the last fit, and whether the samples follow it.

Linear motor, sample by sample; position and current pull it towards what is measured, slowly enough that a shaft that
stops at once, or an encoder that does, shows within some ten milliseconds.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from servo_daemon.commissioning.standing import DEAD, STANDS
from servo_daemon.commissioning.stop import Stop, StoppedError
from servo_daemon.commissioning.supervisor import Reading
from servo_daemon.plant.linear import linear_step
from servo_daemon.regression.sampling import settling

#: Time within which the prediction forgets what was wrong, s: a few periods of any encoder that dies.
_MEMORY_S = 0.02
#: Share of the greatest speed (of the greatest current) by which motion (current) may differ from the prediction: a dry
#: friction that the model lacks changes less than that within `_MEMORY_S`.
_SPEED, _CURRENT = 0.25, 0.5
#: Share of the greatest torque by which it may differ.
_TORQUE = 0.2
#: Counts, and standard deviations of the current, that are no difference.
_COUNTS, _SIGMA = 10.0, 10.0
#: Share of the current's difference that is taken up with every sample.
_CURRENT_GAIN = 0.2
#: A speed has left the prediction where it differs by this share of it; below this share of the greatest speed none is
#: named.
_LEFT, _FAST = 0.5, 0.1

#: An encoder that moves by no more, counts, stands: it may flicker between two.
_FLICKER = 1.5
#: A shaft that stands is looked at when the memory of its last motion is gone: after so many times `_MEMORY_S`.
_GONE = 3.0


class Prediction:
    """Of one motor from where it is now.

    Args:
        motor: R, L, K, J, B.
        start: where the samples are; the motor is at rest there.
        peaks: rad/s and A that were seen before: differences are small against these.
        offset_A: of the current sensor.
    """

    def __init__(
        self, motor: Mapping[str, float], period_s: float, count_rad: float, noise_A: float, offset_A: float,
        start: Reading, peaks: tuple[float, float],
    ) -> None:  # fmt: skip
        Ad, Bd = linear_step(motor, period_s)
        self._A: list[list[float]] = np.asarray(Ad, dtype=float).tolist()
        self._b: list[float] = np.asarray(Bd, dtype=float)[:, 0].tolist()
        self._motor, self._period_s, self._count, self._noise_A = motor, period_s, count_rad, noise_A
        rate = 1.0 / _MEMORY_S
        self._gain_x, self._gain_w = 1.4 * rate * period_s, rate * rate * period_s
        self._offset_A = offset_A
        self._i, self._w, self._x = 0.0, 0.0, start.position_rad
        self._last = start
        self._peak_w, self._peak_i = peaks
        self._turning = 0.0  # mean modulus of the speed by back-EMF over the memory, rad/s
        self._stands_at, self._stands_since = start.position_rad, start.time_s
        self._turned = 0.0  # greatest `_turning` while the encoder stood
        self._emf_V = 0.0  # as voltage and current of the last sample have it

    def check(self, r: Reading) -> None:
        """Takes the next sample.

        Raises:
            StoppedError: the motor does not do what it did.
        """
        last, dt = self._last, r.time_s - self._last.time_s
        for _ in range(max(1, round(dt / self._period_s))):
            self._step(last.voltage_V)
        current = r.current_A - self._offset_A
        self._emf_V = self._measured_emf(last, current, dt)
        self._turning += dt / _MEMORY_S * (abs(self._emf_V / self._motor["K"]) - self._turning)
        self._look_at_standing(r)
        off_x, off_i = r.position_rad - self._x, current - self._i
        self._peak_w, self._peak_i = max(self._peak_w, abs(self._w)), max(self._peak_i, abs(self._i))
        torque_rad = _TORQUE * self._motor["K"] / self._motor["J"] * self._peak_i * _MEMORY_S**2
        if abs(off_x) > _SPEED * self._peak_w * _MEMORY_S + torque_rad + _COUNTS * self._count:
            raise StoppedError(self._named(r, "the shaft does not move as it did: its motion departs from the model"))
        if abs(off_i) > _CURRENT * self._peak_i + _SIGMA * self._noise_A:
            raise StoppedError(self._named(r, "the current is not what voltage and speed make it"))
        self._x += self._gain_x * off_x
        self._w += self._gain_w * off_x
        self._i += _CURRENT_GAIN * off_i
        self._last = r

    def named_stuck(self, stop: Stop) -> Stop:
        """A stop because the encoder stands, named by the back-EMF."""
        if self._turned > _FAST * self._peak_w:
            return Stop("encoder_lost", DEAD, stop.time_s)
        return Stop("hard_stop", STANDS, stop.time_s)

    def _look_at_standing(self, r: Reading) -> None:
        if abs(r.position_rad - self._stands_at) > _FLICKER * self._count:
            self._stands_at, self._stands_since, self._turned = r.position_rad, r.time_s, 0.0
        elif r.time_s - self._stands_since > _GONE * _MEMORY_S:
            self._turned = max(self._turned, self._turning)

    def _step(self, v: float) -> None:
        i, w, x = self._i, self._w, self._x
        a, b = self._A, self._b
        self._i = a[0][0] * i + a[0][1] * w + a[0][2] * x + b[0] * v
        self._w = a[1][0] * i + a[1][1] * w + a[1][2] * x + b[1] * v
        self._x = a[2][0] * i + a[2][1] * w + a[2][2] * x + b[2] * v

    def _measured_emf(self, last: Reading, current: float, dt: float) -> float:
        before = last.current_A - self._offset_A
        m = self._motor
        mean_A = before + settling(m["R"], m["L"], dt)[0] * (current - before)
        return last.voltage_V - m["R"] * mean_A - m["L"] * (current - before) / dt

    def _named(self, r: Reading, otherwise: str) -> Stop:
        """Speed by three witnesses: the prediction, the back-EMF, the encoder. The encoder alone stands: it is dead;
        both have left the prediction: the shaft has run against something."""
        last, w = self._last, self._w
        by_emf = self._emf_V / self._motor["K"]
        by_encoder = (r.position_rad - last.position_rad) / (r.time_s - last.time_s)
        if abs(w) < _FAST * self._peak_w:
            return Stop("innovations", otherwise, r.time_s)
        emf_left, encoder_left = abs(by_emf - w) > _LEFT * abs(w), abs(by_encoder - w) > _LEFT * abs(w)
        stands = abs(r.position_rad - last.position_rad) < _FLICKER * self._count
        if encoder_left and stands and not emf_left:
            return Stop("encoder_lost", DEAD, r.time_s)
        if encoder_left and emf_left and abs(by_emf - by_encoder) < _LEFT * abs(w):
            return Stop("hard_stop", "the shaft was stopped at once: it has run against something", r.time_s)
        return Stop("innovations", otherwise, r.time_s)
