"""The filtering of inverse-dynamic identification, and how its frequencies are chosen.

A signal that must be differentiated goes through a forward-backward Butterworth filter (no phase) and central
differences; then the effort and every regressor go through the same low-pass and are decimated ("parallel decimation"),
so that what the low-pass takes from one side it takes from the other (Gautier, *Dynamic identification of robots with
power model*, ICRA 1997; Janot, Gautier & Brunot, *Data Set and Reference Models of EMPS*, 2019). With f the highest
frequency of the dynamics: cut-off 5 f for the signal, low-pass at 2 f for the decimation (20, 100 and 40 Hz for EMPS).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servo_daemon.numerics import in_long_runs
from servo_daemon.samples import F64

#: Butterworth order of the published method.
_ORDER = 4
#: f: below it lies so much of the effort's power (EMPS: 23 Hz; its authors chose 20).
_POWER = 0.99
#: At most so much of the power of the highest derivative may be noise: by so much its coefficient comes out too small.
_NOISE_SHARE = 2e-4
#: f is at most this part of the sampling rate: at 2 f central differences of order 8 are right to 4e-5.
_MOST_OF_RATE = 1 / 20
#: ... and at least so many times the reciprocal of the duration: rows enough for a regression.
_FEWEST_PERIODS = 20
#: Coefficients of central differences at +1, +2, … samples (Fornberg, *Math. Comp.* 51, 1988).
_DIFFERENCES: Mapping[int, tuple[float, ...]] = {2: (1 / 2,), 8: (4 / 5, -1 / 5, 4 / 105, -1 / 280)}


@dataclass(frozen=True, slots=True)
class FilterChoice:
    """What the user wants; None is chosen from the data.

    Attributes:
        dynamics_Hz: f, the highest frequency of the dynamics.
        cutoff_Hz: of the Butterworth filter; None: 5 f, at most 80 % of the Nyquist frequency.
        decimation: every how many samples become a row; None: as the low-pass at 2 f allows.
        difference_order: of the central differences, 2 (as published) or 8.
        trim_samples: dropped at the beginning and the end of every uninterrupted stretch; None: half a period of f.
    """

    dynamics_Hz: float | None = None
    cutoff_Hz: float | None = None
    decimation: int | None = None
    difference_order: int = 8
    trim_samples: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True)
class Filter:
    """What is used: as `FilterChoice`, at the sampling rate `rate_Hz`."""

    rate_Hz: float
    dynamics_Hz: float
    cutoff_Hz: float
    decimation: int
    difference_order: int
    trim_samples: tuple[int, int]

    @property
    def shortest(self) -> int:
        """Fewest samples of a stretch that give a row or two."""
        return max(2 * sum(self.trim_samples), 40, 30 * self.decimation if self.decimation > 1 else 0)

    def smooth(self, signal: F64) -> F64:
        """The signal without what is above the cut-off, shape (n,), no phase."""
        from scipy.signal import butter, sosfiltfilt

        sections = butter(_ORDER, self.cutoff_Hz / (self.rate_Hz / 2), output="sos")
        return np.asarray(sosfiltfilt(sections, signal, padlen=3 * _ORDER))

    def derivative(self, signal: F64) -> F64:
        """Central difference, shape (n,); the ends by `numpy.gradient`."""
        slope = np.gradient(signal)
        coefficients = _DIFFERENCES[self.difference_order]
        m = len(coefficients)
        if m > 1 and len(signal) > 2 * m:
            inner = slice(m, len(signal) - m)
            ahead = [signal[m + k : len(signal) - m + k] - signal[m - k : len(signal) - m - k] for k in range(1, m + 1)]
            slope[inner] = sum(c * step for c, step in zip(coefficients, ahead, strict=True))
        return np.asarray(slope * self.rate_Hz)

    def decimate(self, columns: F64) -> F64:
        """Rows (w, m) from columns (n, m), ends trimmed, the last sample kept (as MATLAB's `decimate` does)."""
        from scipy.signal import sosfiltfilt

        kept = columns[self.trim_samples[0] : len(columns) - self.trim_samples[1]]
        if self.decimation == 1:
            return kept
        smooth = sosfiltfilt(_lowpass(self.decimation), kept, axis=0, padlen=3 * 8)
        return np.asarray(smooth[self._first(len(kept)) :: self.decimation])

    def pick(self, column: NDArray[Any]) -> NDArray[Any]:
        """The samples that `decimate` takes, without its low-pass."""
        kept = column[self.trim_samples[0] : len(column) - self.trim_samples[1]]
        return kept[self._first(len(kept)) :: self.decimation]

    def _first(self, n: int) -> int:
        return (n - 1) % self.decimation


@lru_cache(maxsize=16)
def _lowpass(decimation: int) -> F64:
    """Of a decimation, in sections: as one fraction the eight poles near 1 are unstable by rounding from 100 on."""
    from scipy.signal import cheby1

    return np.asarray(cheby1(8, 0.05, 0.8 / decimation, output="sos"))


def choose(choice: FilterChoice, rate_Hz: float, signals: Sequence[F64], efforts: Sequence[F64], order: int) -> Filter:
    """The filter for these stretches.

    Args:
        signals: what is differentiated, one array for each stretch.
        efforts: the other side of the balance, likewise.
        order: how many times `signals` are differentiated.
    """
    longest = int(np.argmax([len(s) for s in signals]))
    f = choice.dynamics_Hz
    if f is None:
        noise = noise_limit_Hz(signals[longest], rate_Hz, order)
        f = min(power_limit_Hz(efforts[longest], rate_Hz), noise, _MOST_OF_RATE * rate_Hz)
        f = max(f, _FEWEST_PERIODS * rate_Hz / len(signals[longest]))
    cutoff = choice.cutoff_Hz or min(5 * f, 0.4 * rate_Hz)
    decimation = choice.decimation or max(1, round(0.4 * rate_Hz / (2 * f)))
    trim = choice.trim_samples if choice.trim_samples is not None else (round(0.5 * rate_Hz / f),) * 2
    return Filter(rate_Hz, f, min(cutoff, 0.49 * rate_Hz), decimation, choice.difference_order, trim)


def _spectrum(signal: F64, rate_Hz: float) -> tuple[F64, F64]:
    from scipy.signal import welch

    f, power = welch(signal, rate_Hz, nperseg=min(len(signal), 4096), detrend="linear")
    return np.asarray(f), np.asarray(power)


def power_limit_Hz(effort: F64, rate_Hz: float) -> float:
    """The frequency below which 99 % of the effort's power lies."""
    f, power = _spectrum(effort, rate_Hz)
    share = np.cumsum(power)
    return float(f[np.searchsorted(share, _POWER * share[-1])]) if share[-1] > 0 else float(f[-1])


def noise_density(signal: F64, rate_Hz: float) -> float:
    """One-sided density of the sensor's noise, unit²/Hz: what is left in the uppermost quarter of the spectrum."""
    f, power = _spectrum(signal, rate_Hz)
    return float(np.median(power[f > 0.75 * f[-1]]))


def noise_limit_Hz(signal: F64, rate_Hz: float, order: int) -> float:
    """The largest f for which the derivative of that order, up to 2 f, is noise to no more than `_NOISE_SHARE`.

    White noise of density S has in its derivative of order m, up to F, the power ∫ S (2πf)^2m df.
    """
    f, power = _spectrum(signal, rate_Hz)
    density = noise_density(signal, rate_Hz)
    weight = (2 * np.pi * f) ** (2 * order)
    noise, total = np.cumsum(weight) * density, np.cumsum(weight * power)
    fits = np.flatnonzero(noise <= _NOISE_SHARE * total)
    return float(f[fits[-1]] / 2) if fits.size else float(f[1])


def rests(speed: F64, threshold: float, shortest: int) -> NDArray[np.bool_]:
    """Samples, shape (n,), of stretches of at least `shortest` samples in which the speed stays below the threshold:
    there dry friction is no known torque."""
    return in_long_runs(np.abs(speed) < threshold, shortest)
