"""Features from the two balances: the motor's own regression, and the same balances seen otherwise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from servo_daemon.estimators.modulating import Windows, make_windows
from servo_daemon.estimators.motor_rls import MotorRls
from servo_daemon.estimators.regression_estimate import RegressionEstimate
from servo_daemon.estimators.stretch import Stretch, motion, speed, speed_sign
from servo_daemon.learning.window import Window
from servo_daemon.plant.build import build_plant
from servo_daemon.samples import F64

#: What the regression has beside R, L, K, J, B.
_EFFECTS = ("coulomb_friction", "constant_load_torque", "current_sensor_offset")
#: The regression corrects what the current does between samples once it has an estimate: from this first share.
_FIRST = 0.3
_CORE = ("R", "L", "K", "J", "B")
_FEWEST = 12
#: Of what happened once: beyond six robust standard deviations, found in so many rounds.
_REJECT, _REJECTIONS = 6.0 * 1.4826, 3
#: Signals are shifted against each other by this much, s.
_SHIFT_S = 0.004
_SPAN_S = {"armature": 0.02, "armature long": 0.1, "shaft": 0.1, "shaft long": 0.4}


def regression(w: Window) -> RegressionEstimate | None:
    """R, L, K, J, B, Tc, TL by the daemon's own regression over this window; None where it has no answer."""
    rls = MotorRls(build_plant(_EFFECTS), {})
    noise = {"position_rad": w.position_lsb**2 / 12.0}
    s, cut = w.stretch, round(_FIRST * len(w.stretch.time_s))
    for part in (_cut(s, 0, cut), _cut(s, cut, len(s.time_s))):
        rls.update(part, noise)
    return rls.estimate()


def _cut(s: Stretch, a: int, b: int) -> Stretch:
    v, i, torque, angle, omega = (
        None if x is None else x[a:b] for x in (s.voltage, s.current, s.torque, s.position, s.velocity)
    )
    gap = None if s.gap is None else s.gap[a:b]
    return Stretch(s.time_s[a:b], s.usable[a:b], v, i, torque, angle, omega, s.complete, gap)


def regression_features(found: RegressionEstimate | None, rms_i: float) -> dict[str, float]:
    """The features `catalogue.REGRESSION`."""
    if found is None:
        return {}
    value = dict(zip(found.names, found.value.tolist(), strict=True))
    std = dict(zip(found.names, found.std.tolist(), strict=True))
    if any(n not in value for n in _CORE):
        return {}
    out = {f"reg_{n}": value[n] for n in _CORE}
    out |= {f"reg_{n}_std": std[n] / max(abs(value[n]), 1e-300) for n in _CORE}
    R, L, K, J, B = (value[n] for n in _CORE)
    torque = K * rms_i
    if torque > 0.0:
        out["reg_Tc_share"], out["reg_TL_share"] = value.get("Tc", 0.0) / torque, value.get("TL", 0.0) / torque
    load = R * B + K * K
    if R > 0.0 and load > 0.0:
        out |= {"reg_tau_e": L / R, "reg_tau_m": J * R / load, "reg_gain": K / load}
    return out


def balance_features(w: Window, reg: dict[str, float], rms: F64) -> dict[str, float]:
    """The features `catalogue.BALANCES`; rms: of voltage, current, speed."""
    s = w.stretch
    if s.voltage is None or s.current is None or "reg_R" not in reg or not (rms > 0.0).all():
        return {}
    out: dict[str, float] = {}
    short, long = _windows(w, "armature"), _windows(w, "armature long")
    if short is not None:
        out |= _armature(short, s, reg, float(rms[0])) | _armature_shifted(short, s, _shift(w))
    if long is not None:
        fit = _fit(_armature_columns(long, s), long.held(s.voltage))
        out |= _against(fit.theta, reg, "arm_long", "R") | {"arm_left_long": fit.left}
    return out | _shaft(w, reg, rms)


def _armature_columns(w: Windows, s: Stretch) -> list[F64]:
    assert s.current is not None
    current, rate = w.integrals(s.current, 0, 1)
    return [current, -rate, motion(w, s)[0], w.of_one]


def _armature(w: Windows, s: Stretch, reg: dict[str, float], rms_v: float) -> dict[str, float]:
    assert s.voltage is not None
    assert s.current is not None
    columns, y = _armature_columns(w, s), w.held(s.voltage)
    plain = _fit(columns, y)
    with_drop = [*columns, w.integral(np.sign(s.current))]
    drop = _fit(with_drop, y)
    out = _against(drop.theta, reg, "arm_drop", "RLK")
    out |= {"arm_drop": drop.theta[4] / rms_v, "arm_offset": plain.theta[3] / rms_v}
    return out | {"arm_left": plain.left, "arm_rejected": _rejected(with_drop, y)}


def _shift(w: Window) -> int:
    """By so many samples signals are shifted against each other, to see whether the balances then close better."""
    return max(1, round(_SHIFT_S / w.period_s))


def _armature_shifted(w: Windows, s: Stretch, shift: int) -> dict[str, float]:
    """log of what is left with one signal shifted to what is left without: below 0 where that signal came late
    (`late`, it is moved ahead) or early."""
    assert s.voltage is not None
    assert s.current is not None
    columns, v = _armature_columns(w, s), w.held(s.voltage)
    drop = w.integral(np.sign(s.current))
    plain = _fit([*columns, drop], v).left
    out: dict[str, float] = {}
    for name, k in (("late", shift), ("early", -shift)):
        current, angle = _moved(s.current, k), _motion_moved(s, k)
        i, di = w.integrals(current, 0, 1)
        cases = {
            "v": _fit([*columns, drop], w.held(_moved(s.voltage, k))),
            "i": _fit([i, -di, columns[2], w.of_one, w.integral(np.sign(current))], v),
            "w": _fit([*columns[:2], motion(w, angle)[0], w.of_one, drop], v),
        }
        out |= {f"arm_{name}_{c}": _log_ratio(fit.left, plain) for c, fit in cases.items()}
    return out


def _motion_moved(s: Stretch, k: int) -> Stretch:
    if s.position is not None:
        return replace(s, position=_moved(s.position, k))
    assert s.velocity is not None
    return replace(s, velocity=_moved(s.velocity, k))


def _moved(x: F64, k: int) -> F64:
    """What comes k samples later (k < 0: earlier), the ends held."""
    if k > 0:
        return np.concatenate([x[k:], np.full(k, x[-1])])
    return np.concatenate([np.full(-k, x[0]), x[:k]])


def _log_ratio(a: float, b: float) -> float:
    return float(np.log(max(a, 1e-12) / max(b, 1e-12)))


def _shaft(w: Window, reg: dict[str, float], rms: F64) -> dict[str, float]:
    s, K = w.stretch, reg["reg_K"]
    assert s.current is not None
    out: dict[str, float] = {}
    short, long = _windows(w, "shaft"), _windows(w, "shaft long")
    direction = speed_sign(s)
    if short is not None:
        out |= _shaft_short(short, s, reg, rms, direction, _shift(w))
    if long is not None:
        fit = _fit([*_shaft_columns(long, s), long.integral(direction)], long.integral(s.current))
        out |= _against(K * fit.theta, reg, "shaft_long", "JB")
        out |= {"shaft_left_long": fit.left, "shaft_long_Tc": fit.theta[3] / float(rms[1])}
    return out


def _shaft_short(
    w: Windows, s: Stretch, reg: dict[str, float], rms: F64, direction: F64, shift: int
) -> dict[str, float]:
    assert s.current is not None
    K, rms_i, rms_w = reg["reg_K"], float(rms[1]), float(rms[2])
    y, minus_rate = w.integrals(s.current, 0, 1)
    columns = _shaft_columns(w, s)
    linear = _fit(columns, y)
    out = _against(K * linear.theta, reg, "shaft_linear", "JB") | {"shaft_left_linear": linear.left}
    columns.append(w.integral(direction))
    rough = _fit(columns, y)
    out |= {"shaft_left": rough.left, "shaft_rejected": _rejected(columns, y)}
    omega = speed(s)
    drag = _fit([*columns, w.integral(omega * np.abs(omega))], y).theta
    out |= _against(K * drag, reg, "shaft_drag", "JB") | {"shaft_drag": drag[4] * rms_w**2 / rms_i}
    out["shaft_delay"] = float(_fit([*columns, minus_rate], y).theta[4])
    for name, k in (("late", shift), ("early", -shift)):
        out[f"shaft_{name}"] = _log_ratio(_fit(columns, w.integral(_moved(s.current, k))).left, rough.left)
    return out


def _shaft_columns(w: Windows, s: Stretch) -> list[F64]:
    speed_, acceleration = motion(w, s)
    return [acceleration, speed_, w.of_one]


def closure(w: Window, value: Mapping[str, float]) -> tuple[float, float] | None:
    """How far the two balances of this window are from closing with these parameters: RMS of what is left over the RMS
    of voltage and of current. What any drive may have beside them (an offset, a brush drop; a load, dry friction) is
    fitted to what is left: values that a model without these has bent to the data must not win by it. None without a
    signal.

    Args:
        value: R, L, K, J, B, SI units.
    """
    s = w.stretch
    short, shaft = _windows(w, "armature"), _windows(w, "shaft")
    if s.voltage is None or s.current is None or short is None or shaft is None:
        return None
    current, minus_rate, speed_, one = _armature_columns(short, s)
    left = short.held(s.voltage) - value["R"] * current - value["L"] * minus_rate - value["K"] * speed_
    drop = short.integral(np.sign(s.current))
    acceleration, shaft_speed, shaft_one = _shaft_columns(shaft, s)
    torque = value["J"] * acceleration + value["B"] * shaft_speed
    shaft_left = shaft.integral(s.current) - torque / value["K"]
    friction = shaft.integral(speed_sign(s))
    return (
        _left(left, [one, drop], short.held(s.voltage)),
        _left(shaft_left, [shaft_one, friction], shaft.integral(s.current)),
    )


def _left(residual: F64, free: list[F64], y: F64) -> float:
    left = _fit(free, residual).left * np.sqrt(residual @ residual)
    return float(left / np.sqrt(max(float(y @ y), 1e-300)))


def _against(fit: F64, reg: dict[str, float], prefix: str, names: Sequence[str]) -> dict[str, float]:
    """log of the first coefficients to those of the regression; nothing for what is not positive."""
    pairs = ((n, float(fit[k]), reg[f"reg_{n}"]) for k, n in enumerate(names))
    return {f"{prefix}_{n}": float(np.log(a / b)) for n, a, b in pairs if a > 0.0 and b > 0.0}


@dataclass(frozen=True, slots=True)
class _Fit:
    """Coefficients, and |residual| / |y|; NaN where there are too few rows."""

    theta: F64
    left: float


def _fit(columns: list[F64], y: F64) -> _Fit:
    """Least squares with columns of size 1."""
    if len(y) <= 2 * len(columns):
        return _Fit(np.full(len(columns), np.nan), float("nan"))
    Phi = np.column_stack(columns)
    size = np.sqrt(np.square(Phi).sum(axis=0))
    size[size == 0.0] = 1.0
    A = Phi / size
    gram = A.T @ A
    gram.flat[:: len(gram) + 1] += 1e-10
    theta = np.linalg.solve(gram, A.T @ y)
    left = y - A @ theta
    return _Fit(theta / size, float(np.sqrt((left @ left) / max(float(y @ y), 1e-300))))


def _rejected(columns: list[F64], y: F64) -> float:
    """What rows leave that a fit to the others rejects, as a share of |y|: large where something happened once (a
    voltage lost, a count slipped), which a fit to all rows would spread over all of them.

    Rows beyond 6 robust standard deviations (1.4826 × the median magnitude) are left out, three times.
    """
    Phi, kept = np.column_stack(columns), np.ones(len(y), dtype=bool)
    left = np.zeros(len(y))
    for _ in range(_REJECTIONS):
        theta = _fit([c[kept] for c in columns], y[kept]).theta
        if not np.isfinite(theta).all():
            return float("nan")
        left = np.abs(y - Phi @ theta)
        kept = left <= _REJECT * float(np.median(left)) + 1e-300
    away = left[~kept]
    return float(np.sqrt((away @ away) / max(float(y @ y), 1e-300)))


def _windows(w: Window, which: str) -> Windows | None:
    """Windows without an unusable sample or a gap inside; None if there are none. The shaft's short ones overlap by
    half, of the others there are enough side by side."""
    s, side_by_side = w.stretch, which != "shaft"
    length = max(_FEWEST, round(_SPAN_S[which] / w.period_s)) + 1
    bad = ~s.usable if s.gap is None else ~s.usable | s.gap
    first = np.arange(0, len(s.time_s) - length + 1, length if side_by_side else length // 2, dtype=np.intp)
    before = np.concatenate([[0], np.cumsum(bad)])
    first = first[before[first + length] - before[first + 1] == 0]
    return make_windows(s.time_s, first, length) if len(first) else None
