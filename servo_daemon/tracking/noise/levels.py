"""Noise levels from the data: sensor noise to start with, then from the filter's own innovations.

Before the filter runs, the median of third differences tells a channel's white noise apart from its (smooth) signal:
for white noise of variance r the third difference has variance 20 r (binomials 1, 3, 3, 1), and the median absolute
value of a Gaussian is 0.6745 σ. A quantised channel cannot be better than its step: r ≥ q²/12.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from servo_daemon.numerics import white_noise_var
from servo_daemon.samples import F64

#: No variance is smaller, in its unit squared: below any sensor's (1 nA, 1 nrad), and its logarithm is a number.
LEAST_VAR = 1e-18
#: Fewest samples, or innovations, from which noise is learned: a variance is known to 20 % by them.
FEWEST_TO_LEARN = 50
#: Time constant of the adaptation, s (free within 2.5 .. 10, tried on three steps and eight starts).
_ADAPTATION_S = 5.0
#: While the level is still a guess it may change fourfold at once (half and twice tried on three starts: 0.2 σ at
#: most).
_FIRST_UPDATES = 5
#: Later it falls by this share of what is wanted at once where innovations are smaller than that (half and twice of
#: each tried on three starts: 0.7 σ at most).
_SETTLED_UPDATES, _FAR_NIS, _FAR_SHARE = 10, 0.6, 0.3
#: A drive's voltage is not what it says, if only by dead time and ripple: 1 σ as a share of its rms (half and twice
#: tried on three starts: 0.3 σ at most).
_INPUT_SHARE = 1e-3
#: Unmodelled torque, 1 σ over a millisecond as a share of the rms motor torque (half and twice tried on three starts:
#: 0.3 σ at most).
_TORQUE_SHARE = 2e-3
#: Process noise rises per tick above these, and falls below half the correlation (decision 12; see
#: `make calibrate`).
_NIS_HIGH, _CORRELATED = 1.3, 0.15
#: By how much a tick: up a hundredfold within a second (1.6¹⁰ = 110; decision 12; with 3.2 a start moves by 1 σ), down
#: again within 15 s (0.97¹⁵⁴ = 1/110; free: 0.985 and 0.94 move no tracking figure); and the most (half and twice:
#: nothing moves).
_RISE, _FALL, FACTOR_MOST = 1.6, 0.97, 1e8
#: Innovations smaller than this say that the noise is too large already: then it recedes per tick by this (half and
#: twice of each tried on three starts: 0.8 σ at most).
NIS_LOW, _RECEDE = 0.7, 0.05
#: Steering per tick: by how much per unit of correlation, and what it keeps where nothing is to be seen (chosen; free
#: within half and twice, of the second what is missing to one).
_STEER, _LEAK = 0.15, 0.998
#: Whiteness is that of so long a time, s (chosen; half and twice move no tracking figure).
_MEMORY_S = 10.0


def smallest_step(signal: F64) -> float:
    """Least significant bit of a quantised signal; 0 where there is none to be seen.

    A channel is quantised when its distinct steps are multiples of the smallest one.
    """
    steps = np.abs(np.diff(signal))
    steps = steps[steps > 1e-12 * max(1.0, float(np.abs(signal).max()))]
    if len(steps) < 8:
        return 0.0
    smallest = float(np.quantile(steps, 0.01))
    multiples = steps / smallest
    near = np.abs(multiples - np.round(multiples)) < 0.02 * np.maximum(1.0, multiples)
    few = multiples < 20
    return smallest if few.sum() >= 8 and near[few].mean() > 0.95 else 0.0


@dataclass(frozen=True, slots=True)
class ChannelNoise:
    """Variance of a channel and the floor below which it cannot be."""

    var: float
    floor: float


def initial_noise(signal: F64, lsb: float | None) -> ChannelNoise:
    """From the first samples and, if the driver knows it, the least significant bit."""
    step = smallest_step(signal) if lsb is None else lsb
    typical = float(np.sqrt(np.mean(np.square(signal - signal.mean()))))
    floor = max(step**2 / 12.0, (1e-6 * typical) ** 2, LEAST_VAR)
    return ChannelNoise(max(white_noise_var(signal), floor), floor)


def adapted(
    noise: ChannelNoise, excess: float, duration_s: float, update: int = 1_000_000, nis: float = 1.0
) -> ChannelNoise:
    """Move a channel's variance towards what its innovations show: E ν² = s₀ + r (innovation-based adaptive estimation,
    Mehra, *IEEE Trans. Autom. Control* 15, 1970).

    Args:
        excess: mean of ν² − s over the tick, outliers clipped (`kalman.layout.CLIP`).
        update: how many there have been, this one included: the first ones count as much as all before them.
        nis: mean of ν²/s of a slow drive. Far below one, in a filter that has settled, the level is still that of the
            first samples, where its motion passes for noise.
    """
    share = max(1.0 - math.exp(-duration_s / _ADAPTATION_S), 1.0 / update)
    if nis < _FAR_NIS and update > _SETTLED_UPDATES:
        share = max(share, _FAR_SHARE)
    # Never more than halve or double at once, later on: a tick is a small sample.
    most = 2.0 if update > _FIRST_UPDATES else 4.0
    wanted = min(max(noise.var + excess, noise.var / most), most * noise.var)
    return ChannelNoise(max(noise.var + share * (wanted - noise.var), noise.floor), noise.floor)


def input_variance(rms: float, lsb: float | None) -> float:
    """Variance of the held input, in its unit squared."""
    return (lsb or 0.0) ** 2 / 12.0 + (_INPUT_SHARE * rms) ** 2 + LEAST_VAR


def torque_intensity(rms_torque_Nm: float) -> float:
    """Intensity of unmodelled torque, (N·m)²·s."""
    return (_TORQUE_SHARE * rms_torque_Nm) ** 2 * 1e-3 + 1e-24


@dataclass(frozen=True, slots=True)
class ProcessNoise:
    """Intensity of what the model does not explain, as a factor ≥ 1 on a baseline, found from the innovations.

    Innovations that are larger than they should be and follow each other (positive lag-1 correlation) say that the
    model's prediction drifts away between samples: process noise is too small (Mehra 1970). It rises within a second
    and falls back slowly, never below the baseline. So a torque that is not in the model widens the intervals of the
    parameters instead of bending them at full confidence; the mismatch itself is reported by the factor.
    """

    factor: float = 1.0

    def after(
        self, correlation: float, nis: float, follow: float | None = None, too_much: bool = False
    ) -> ProcessNoise:
        """The level after a tick with this lag-1 correlation and normalised innovation squared.

        Args:
            follow: a correlation to be steered to zero at any size of the innovations. The channel's own noise is
                adapted beside it, so a wrong share between the two shows in correlations only.
            too_much: innovations of another channel that this noise moves are smaller than they should be.
        """
        if too_much:
            return ProcessNoise(max(self.factor * math.exp(-_RECEDE), 1.0))
        if nis > _NIS_HIGH and correlation > _CORRELATED:
            return ProcessNoise(min(self.factor * _RISE, FACTOR_MOST))
        if follow is not None:
            steer = _STEER * min(max(follow, -0.5), 0.5)
            if nis < NIS_LOW:  # more noise than there is: whatever the correlation says, it is not missing here
                steer = min(steer, 0.0) - _RECEDE
            steered = _LEAK * math.log(self.factor) + steer
            return ProcessNoise(math.exp(min(max(steered, 0.0), math.log(FACTOR_MOST))))
        if correlation < 0.5 * _CORRELATED or nis < 1.0:
            return ProcessNoise(max(self.factor * _FALL, 1.0))
        return self


@dataclass(frozen=True, slots=True)
class Whiteness:
    """Running lag-1 correlation and normalised innovation squared of one channel."""

    correlation: float = 0.0
    nis: float = 1.0

    def after(self, correlation: float, nis: float, duration_s: float) -> Whiteness:
        """The whiteness after another tick with this lag-1 correlation and mean normalised square."""
        share = 1.0 - math.exp(-duration_s / _MEMORY_S)
        return Whiteness(
            self.correlation + share * (correlation - self.correlation), self.nis + share * (nis - self.nis)
        )
