"""Features that need no model: spectra and phase lags in bands, statistics, steady ratios, reversals."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from servo_daemon.learning.features.catalogue import BANDS, CLASSES
from servo_daemon.learning.features.window import Window
from servo_daemon.samples import F64

_SIGNALS = "viw"
_PAIRS = (("v_i", 0, 1), ("v_w", 0, 2), ("i_w", 1, 2))
#: Segments of the spectra, s, half overlapping (Welch, *IEEE Trans. Audio Electroacoust.* 15, 1967).
_SEGMENT_S = 1.0
_LOWEST_HZ, _HIGHEST_SHARE = 1.0, 0.4
#: Speed and acceleration from differences over this time.
_ACROSS_S = 0.01
_STILL, _MOVING = 0.02, 0.05


def spectrum_features(w: Window) -> dict[str, float]:
    """The features `catalogue.SPECTRUM`."""
    size = min(w.even.shape[1], max(32, round(_SEGMENT_S / w.period_s)))
    S, frequency = _cross_spectra(w.even, size, 1.0 / w.period_s)
    edges = np.geomspace(_LOWEST_HZ, _HIGHEST_SHARE / w.period_s, BANDS + 1)
    band = np.searchsorted(edges, frequency * (1 + 1e-9)) - 1
    of_band = (band == np.arange(BANDS)[:, None]).astype(np.float64)
    sums = (of_band @ S.reshape(len(S), 9)).reshape(BANDS, 3, 3)
    power = np.einsum("bkk->bk", sums).real
    out: dict[str, float] = {}
    total = power.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.log10(np.maximum(power / total, 1e-9))
        for k, name in enumerate(_SIGNALS):
            out |= {f"power_{name}_{b + 1}": float(share[b, k]) for b in range(BANDS)}
        for pair, a, b in _PAIRS:
            cross = sums[:, a, b]
            gain, coherence = np.abs(cross) / power[:, a], np.abs(cross) ** 2 / (power[:, a] * power[:, b])
            out |= {f"gain_{pair}_{k + 1}": float(gain[k]) for k in range(BANDS)}
            out |= {f"coherence_{pair}_{k + 1}": float(coherence[k]) for k in range(BANDS)}
            out |= {f"lag_{pair}_{k + 1}": float(-np.angle(cross[k])) for k in range(3)}
        top = S[frequency > 0.8 * frequency[-1], 1, 1].real
        out["floor_i"] = float(np.sqrt(np.median(top) * len(frequency) / np.sum(S[:, 1, 1].real)))
    for name, k in (("decay_i", 1), ("decay_w", 2)):
        out[name] = _decay(S[:, k, k].real, w.period_s)
    return out


def _cross_spectra(x: F64, size: int, rate_hz: float) -> tuple[NDArray[np.complex128], F64]:
    """Σ over segments of conj(X_a) X_b, shape (f, 3, 3), and the frequencies, shape (f,)."""
    hop = max(1, size // 2)
    first = np.arange(0, x.shape[1] - size + 1, hop)
    pieces = np.lib.stride_tricks.sliding_window_view(x, size, axis=1)[:, first]  # (3, segments, size)
    pieces -= pieces.mean(axis=2, keepdims=True)
    pieces *= np.hanning(size)
    X = np.fft.rfft(pieces, axis=2)
    other = X.conj()
    S = np.empty((X.shape[2], 3, 3), dtype=np.complex128)
    for a in range(3):
        for b in range(a, 3):
            S[:, a, b] = np.einsum("sf,sf->f", other[a], X[b])
            S[:, b, a] = S[:, a, b].conj()
    return S, np.asarray(np.fft.rfftfreq(size, 1.0 / rate_hz), dtype=np.float64)


def _decay(power: F64, period_s: float) -> float:
    """Where the autocorrelation, from the power spectrum, first falls to a half, s."""
    if not np.isfinite(power).all() or not power.sum() > 0.0:
        return float("nan")
    r = np.fft.irfft(power)
    below = np.flatnonzero(r[: len(r) // 2 + 1] < 0.5 * r[0])
    k = int(below[0]) if len(below) else len(r) // 2
    step = (r[k - 1] - 0.5 * r[0]) / max(r[k - 1] - r[k], 1e-300) if k > 0 else 0.0
    return float((k - 1 + min(step, 1.0)) * period_s)


def statistics_features(w: Window, rms: F64) -> dict[str, float]:
    """The features `catalogue.STATISTICS`; rms: of voltage, current, speed."""
    acceleration = _acceleration(w)
    out = {f"rms_{n}": float(r) for n, r in zip(_SIGNALS, rms, strict=True)}
    out["rms_a"] = float(np.sqrt(np.mean(np.square(acceleration))))
    mean = w.even.mean(axis=1)
    centred = w.even - mean[:, None]
    peak = np.abs(w.even).max(axis=1)
    std = np.maximum(centred.std(axis=1), 1e-12 * peak + 1e-300)  # a constant's is not always exactly zero
    z = centred / std[:, None]
    square = z * z  # NumPy's powers are ten times as slow
    skew, kurtosis = np.mean(square * z, axis=1), np.mean(square * square, axis=1)
    for k, name in enumerate(_SIGNALS):
        size = max(float(rms[k]), 1e-300)
        out |= {f"mean_{name}": float(mean[k]) / size, f"crest_{name}": float(peak[k]) / size}
        out |= {f"skew_{name}": float(skew[k]), f"kurtosis_{name}": float(kurtosis[k])}
    speed = np.abs(w.even[2])
    out["still"] = float(np.mean(speed < _STILL * max(float(peak[2]), 1e-300)))
    out["saturated"] = w.saturated
    out["encoder_step"] = w.position_lsb / max(float(rms[2]) * _ACROSS_S, 1e-300)
    return out


def _acceleration(w: Window) -> F64:
    """rad/s², shape (m − k,), from speeds `_ACROSS_S` apart."""
    k = max(1, round(_ACROSS_S / w.period_s))
    return np.asarray((w.even[2, k:] - w.even[2, :-k]) / (k * w.period_s))


def motion_features(w: Window, rms: F64) -> dict[str, float]:
    """The features `catalogue.MOTION`; rms: of voltage, current, speed."""
    v, i, omega = w.even
    if not (rms[2] > 0.0 and np.isfinite(rms[2])):
        return {}
    vv, ii, ww = (float(x @ x) for x in w.even)
    vi, vw, iw = float(v @ i), float(v @ omega), float(i @ omega)
    out = {"ratio_v_w": vw / ww, "ratio_i_w": iw / ww}
    if ii > 0.0 and vv > 0.0:
        out |= {"ratio_v_i": vi / ii, "balance_power": vi * vi / (ii * vv)}
    alpha = _acceleration(w)
    half = (len(i) - len(alpha)) // 2
    aa = float(alpha @ alpha)
    out["ratio_i_a"] = float(i[half : half + len(alpha)] @ alpha) / aa if aa > 0.0 else float("nan")
    return out | _by_speed(i / max(float(rms[1]), 1e-300), omega) | _reversals(w, rms) | _ripple(w, rms)


def _by_speed(current: F64, omega: F64) -> dict[str, float]:
    """Mean current in the direction of motion over speed: dry friction is what is left at low speed."""
    magnitude, sign = np.abs(omega), np.sign(omega)
    top = float(magnitude.max())
    along, out = current * sign, {}
    edges = np.linspace(_MOVING, 1.0, CLASSES + 1) * top
    for c in range(CLASSES):
        here = (magnitude >= edges[c]) & (magnitude <= edges[c + 1])
        out[f"current_at_{c + 1}"] = float(along[here].mean()) if here.any() else float("nan")
    forward, backward = sign * (magnitude > edges[0]) > 0, sign * (magnitude > edges[0]) < 0
    both = forward.any() and backward.any()
    out["direction"] = float(along[forward].mean() - along[backward].mean()) if both else float("nan")
    return out


def _reversals(w: Window, rms: F64) -> dict[str, float]:
    """How often, and by how much the current steps there."""
    omega, current = w.even[2], w.even[1]
    moving = np.flatnonzero(np.abs(omega) > _MOVING * float(np.abs(omega).max()))
    sign = np.sign(omega[moving])
    turn = np.flatnonzero(sign[1:] != sign[:-1])
    out = {"reversals": (len(turn) + 1) / w.seconds, "reversal_i": 0.0}
    if len(turn) and rms[1] > 0.0:
        steps = (current[moving[turn + 1]] - current[moving[turn]]) * sign[turn + 1]
        out["reversal_i"] = float(np.mean(steps) / rms[1])
    return out


def _ripple(w: Window, rms: F64) -> dict[str, float]:
    """Fast current that goes with no change of the voltage: least squares of the fast part on the voltage's steps."""
    v, i = w.even[0], w.even[1]
    k = max(2, round(0.5 * _ACROSS_S / w.period_s))
    if not (np.isfinite(rms[:2]).all() and (rms[:2] > 0.0).all()):
        return {}
    fast, fast_v = _fast(i, k), _fast(v, k)
    X = np.stack([fast_v[1:-1], fast_v[:-2]])
    gram = X @ X.T
    gram.flat[::3] += 1e-9 * max(float(np.trace(gram)), 1e-300)
    left = fast[1:-1] - np.linalg.solve(gram, X @ fast[1:-1]) @ X
    return {"ripple_i": float(np.sqrt(np.mean(left**2)) / rms[1])}


def _fast(x: F64, k: int) -> F64:
    """x without its running mean over k samples, shape (n − k + 1,)."""
    sums = np.cumsum(np.concatenate([[0.0], x]))
    mean = (sums[k:] - sums[:-k]) / k
    start = k // 2
    return np.asarray(x[start : start + len(mean)] - mean)
