"""An encoder that stands before the motor is known: voltage and current tell whether the shaft stands, too.

Of a shaft that stands the winding is all there is: with an offset, ∫v dt = R ∫i dt + L i + a + b t. A shaft that turns
adds K θ, which follows (K²/J) ∫∫i dt² while friction is small; b t is the speed that it had.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import nnls

from servo_daemon.commissioning.limits import MotionLimits
from servo_daemon.commissioning.stop import Stop, StoppedError
from servo_daemon.samples import F64, SampleBlock

#: What stands is left with this much of what noise can add up to (R h σ √n + L σ, over all samples): 0.12 to 0.38 of
#: 10 shafts that were blocked; 3.1 and more of 24 that turned.
_NOISE = 1.0
#: It turns if the inertia takes this factor from the squares of what is left, or if what is left is this share of
#: ∫v dt: more than contacts and dead times take of a voltage that moves a motor.
_INERTIA, _SHARE = 4.0, 0.15
#: Fewer samples tell nothing.
_SAMPLES = 50
#: A motor reaches this share of its limit of speed at the greatest voltage, and its encoder shows so many counts.
_REACHES, _COUNTS = 0.2, 1.5
#: While it is driven it is asked so often, s, of the last so many samples (a millisecond of work).
_EVERY_S, _LATEST = 0.1, 2000

DEAD = "the motor turns (back-EMF), and the encoder does not show it"
STANDS = "the shaft stands although there is torque (no back-EMF): stuck, or at a stop"
LOCKED = "the shaft does not move: locked (voltage and current are those of a winding at rest)"


def named(stop: Stop, block: SampleBlock, offset_A: float, noise_A: float) -> Stop:
    """A stop because of no motion, by its cause as far as there is one to tell.

    Args:
        stop: "no_motion" or "motion_ended".
        block: the samples since the encoder stands.
        offset_A, noise_A: of the current sensor.
    """
    assert block.voltage_V is not None and block.current_A is not None
    if len(block) < _SAMPLES:
        return stop
    columns = _columns(block.time_s, block.voltage_V, block.current_A - offset_A)
    turns = _turns(block.time_s, columns, noise_A)
    if turns:
        return Stop("encoder_lost", DEAD, stop.time_s)
    if turns is None:
        return stop
    if stop.reason == "no_motion":
        return Stop("no_motion", LOCKED, stop.time_s)
    return Stop("hard_stop", STANDS, stop.time_s)


class UnseenMotion:
    """Asks now and then, while the encoder of an unknown motor stands, whether the shaft does: a motor that turned
    unseen would pass its limit of speed.

    Args:
        count_rad: one encoder count.
    """

    def __init__(self, limits: MotionLimits, count_rad: float) -> None:
        # What `_COUNTS` are as an integral of the back-EMF, V s, of the largest K that there may be.
        self._seen_Vs = _COUNTS * count_rad * limits.voltage_V / (_REACHES * limits.speed_rad_s)
        self._asked_s = 0.0

    def check(self, time_s: float, since: Callable[[], tuple[SampleBlock, float, float]]) -> None:
        """Asks, if it is time to.

        Args:
            since: gives the samples since the encoder stands, and offset and noise of the current sensor, A.

        Raises:
            StoppedError: the shaft has turned further than the encoder would have missed.
        """
        if time_s - self._asked_s < _EVERY_S:
            return
        self._asked_s = time_s
        block, offset_A, noise_A = since()
        block = block.slice(max(0, len(block) - _LATEST), len(block))
        assert block.voltage_V is not None and block.current_A is not None
        if len(block) < _SAMPLES:
            return
        columns = _columns(block.time_s, block.voltage_V, block.current_A - offset_A)
        if not _turns(block.time_s, columns, noise_A):
            return
        (*_, turned), _ = nnls(columns[:, :3], columns[:, 3])
        if float(np.ptp(turned * columns[:, 2])) > self._seen_Vs:
            raise StoppedError(Stop("encoder_lost", DEAD, time_s))


def _columns(time_s: F64, voltage_V: F64, current_A: F64) -> F64:
    """∫i dt, i, ∫∫i dt² and ∫v dt without offset and slope, shape (n, 4)."""
    h = np.diff(time_s)
    once = _summed(0.5 * (current_A[1:] + current_A[:-1]) * h)
    twice = _summed(0.5 * (once[1:] + once[:-1]) * h)
    columns = np.stack([once, current_A, twice, _summed(voltage_V[:-1] * h)], axis=1)
    line, _ = np.linalg.qr(np.stack([np.ones_like(time_s), time_s - time_s[0]], axis=1))
    return np.asarray(columns - line @ (line.T @ columns))


def _turns(time_s: F64, columns: F64, noise_A: float) -> bool | None:
    """Whether a motor turns; None: neither a shaft that turns nor one that stands explains it.

    Args:
        columns: of its samples, as `_columns` gives them.
    """
    h = np.diff(time_s)
    size = np.linalg.norm(columns, axis=0)
    if not size.all():
        return None
    *regressors, target = (columns / size).T
    (R, L), left = nnls(np.stack(regressors[:2], axis=1), target)
    _, left_turning = nnls(np.stack(regressors, axis=1), target)
    n = len(time_s)
    R, L = R * size[3] / size[0], L * size[3] / size[1]
    noise = np.sqrt(n) * (R * float(np.median(h)) * np.sqrt(n) + L) * noise_A / size[3]
    if left < _NOISE * noise:
        return False
    return True if left**2 > _INERTIA * left_turning**2 or left > _SHARE else None


def _summed(rate: F64) -> F64:
    return np.concatenate([[0.0], np.cumsum(rate)])
