"""Regressions as others would run them: padasip's recursive least squares and a sliding window of NumPy's.

Both take current, voltage and the encoder's central difference through the same low-pass (a causal second-order
Butterworth), so that noise is small and the delay is the same on both sides.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from servo_daemon.samples import F64
from tests.recovery.generator import Recording

from .rival_filters import Rival, Task

#: The best of 20, 40, 100 and 200 Hz over three motors.
CUT_OFF_HZ = 20.0
#: Memory of the RLS (forgetting 1 − 1/(rate · memory)) and length of the sliding window, s; three times as long lags.
MEMORY_S, WINDOW_S, EVERY_S = 1.0, 2.0, 0.1


def smooth(recording: Recording) -> tuple[float, F64, F64, F64]:
    """Sample period, and low-passed voltage, current and speed at the inner samples, shape (n - 2,)."""
    from scipy.signal import butter, lfilter

    h = float(np.median(np.diff(recording.time_s)))
    b, a = butter(2, CUT_OFF_HZ, fs=1 / h)
    time_s, position = recording.time_s, recording.position_rad
    speed = (position[2:] - position[:-2]) / (time_s[2:] - time_s[:-2])
    signals = (recording.voltage_V[1:-1], recording.current_A[1:-1], speed)
    voltage, current, speed = (np.asarray(lfilter(b, a, signal)) for signal in signals)
    return h, voltage, current, speed


def padasip_rls(task: Task) -> Rival:
    """padasip's FilterRLS on the sampled model: I⁺ = a I + b V + c ω and ω⁺ = d ω + e I, solved for the motor."""
    from padasip.filters import FilterRLS

    motor = task.motor
    h, v, i, w = smooth(task.recording)
    v, i, w = v / motor.supply_V, i / motor.rated_current_A, w / motor.speed_max_rad_s
    forgetting = 1 - h / MEMORY_S
    electrical, mechanical = FilterRLS(3, mu=forgetting), FilterRLS(2, mu=forgetting)
    first, second = np.full((len(v) + 2, 3), np.nan), np.full((len(v) + 2, 2), np.nan)
    for k in range(len(v) - 1):
        electrical.adapt(i[k + 1], np.array([i[k], v[k], (w[k] + w[k + 1]) / 2]))
        mechanical.adapt(w[k + 1], np.array([w[k], (i[k] + i[k + 1]) / 2]))
        first[k + 3], second[k + 3] = electrical.w, mechanical.w
    A, V, W = motor.rated_current_A, motor.supply_V, motor.speed_max_rad_s
    a, b, c = first.T * np.array([[1.0], [A / V], [A / W]])
    d, e = second.T * np.array([[1.0], [W / A]])
    with np.errstate(all="ignore"):
        R, K = (1 - a) / b, -c / b
        B = K * (1 - d) / e
        value = np.column_stack([R, -R * h / np.log(a), K, -B * h / np.log(d), B])
    return Rival(value, np.full(value.shape, np.nan))


def sliding_window(task: Task) -> Rival:
    """NumPy's least squares of both balances over the last seconds, ten times a second: V = R I + L İ + K ω, and
    I = (J/K) dω/dt + (B/K) ω. The interval is the textbook's, as if residuals were white."""
    recording = task.recording
    h, v, i, w = smooth(recording)
    v = (v + np.concatenate([v[:1], v[:-1]])) / 2  # about a sample: the mean of what is held before and after it
    di, dw = np.gradient(i, h), np.gradient(w, h)
    n, window, every = len(recording.time_s), round(WINDOW_S / h), round(EVERY_S / h)
    value, std = np.full((n, 5), np.nan), np.full((n, 5), np.nan)
    for end in range(window, len(v), every):
        part = slice(end - window, end)
        (R, L, K), C = _solved(np.column_stack([i, di, w])[part], v[part])
        (J_K, B_K), D = _solved(np.column_stack([dw, w])[part], i[part])
        value[end + 2 : end + 2 + every] = R, L, K, J_K * K, B_K * K
        var_K = C[2, 2]
        parts = C[0, 0], C[1, 1], var_K, D[0, 0] * K**2 + J_K**2 * var_K, D[1, 1] * K**2 + B_K**2 * var_K
        std[end + 2 : end + 2 + every] = np.sqrt(parts)
    return Rival(value, std)


def _solved(X: F64, y: F64) -> tuple[F64, F64]:
    """Coefficients and their covariance."""
    solution, *_ = np.linalg.lstsq(X, y, rcond=None)
    variance = float(np.sum((y - X @ solution) ** 2)) / (len(y) - X.shape[1])
    return np.asarray(solution), np.asarray(variance * np.linalg.inv(X.T @ X))


REGRESSIONS: dict[str, Callable[[Task], Rival]] = {
    "padasip RLS": padasip_rls,
    "sliding window": sliding_window,
}
