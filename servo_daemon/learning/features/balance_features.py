"""Features from the two balances: the motor's own regression, and the same balances seen otherwise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from servo_daemon.learning.features.balance_fits import Case, Fits, fit
from servo_daemon.learning.features.window import Window
from servo_daemon.numerics import MEDIAN_TO_STD, THIRD_DIFFERENCE_GAIN, upper_median
from servo_daemon.parameters import MOTOR_NAMES
from servo_daemon.plant.build import build_plant
from servo_daemon.regression.columns.rows import DIRECTED_STDS
from servo_daemon.regression.estimate import RegressionEstimate
from servo_daemon.regression.modulating import Windows, make_windows
from servo_daemon.regression.motor_rls import MotorRls
from servo_daemon.regression.rls import SPANS_S
from servo_daemon.regression.stretch import Stretch, motion
from servo_daemon.samples import F64

#: What the regression has beside R, L, K, J, B; the drop of the brushes only where the current flows both ways, which
#: tells it from an offset: each for this share of the samples at least.
_EFFECTS = ("coulomb_friction", "constant_load_torque", "current_sensor_offset")
_DROP, _EACH_WAY = "brush_voltage_drop", 0.02
#: The regression corrects what the current does between samples once it has an estimate: from this first share.
_FIRST = 0.3
_FEWEST = 12
#: Signals are shifted against each other by this much, s.
_SHIFT_S = 0.004
_SPAN_S = {"armature": 0.02, "armature long": 0.1, "shaft": 0.1, "shaft long": 0.4}


def regression(w: Window) -> RegressionEstimate | None:
    """R, L, K, J, B, Tc, TL, Vb by the daemon's own regression over this window; None where it has no answer.

    It knows the current's noise, takes what that adds to the regressors out, and takes no sample for the drop's sake in
    which the noise may have made the current's sign: where an axis stands between moves that is most of them.
    """
    s = w.stretch
    assert s.current is not None
    noise = {"position_rad": w.position_lsb**2 / 12.0, "current_A": _noise_var(s.current)}
    least = DIRECTED_STDS * noise["current_A"] ** 0.5
    ways = min(np.count_nonzero(s.current > least), np.count_nonzero(s.current < -least))
    if ways > _EACH_WAY * len(s.current) and (found := _regression(w, (*_EFFECTS, _DROP), noise)) is not None:
        return found
    return _regression(w, _EFFECTS, noise)  # a drop is an offset, or too few samples are left


def _regression(w: Window, effects: tuple[str, ...], noise: Mapping[str, float]) -> RegressionEstimate | None:
    s, cut = w.stretch, round(_FIRST * len(w.stretch.time_s))
    rls = MotorRls(build_plant(effects), {}, spans_s=(SPANS_S[-1],))
    for part in (_cut(s, 0, cut), _cut(s, cut, len(s.time_s))):
        rls.update(part, noise)
    found = rls.estimate()
    return found if found is not None and set(MOTOR_NAMES) <= set(found.names) else None


def _noise_var(signal: F64) -> float:
    """Variance of the white part of a signal: as `numerics.white_noise_var`, from a quarter of the third
    differences, which tells it to a few percent."""
    a, b, c, d = signal[: len(signal) // 4 * 4].reshape(-1, 4).T
    return (upper_median(np.abs(d - a + 3.0 * (b - c))) / MEDIAN_TO_STD) ** 2 / THIRD_DIFFERENCE_GAIN


def _cut(s: Stretch, a: int, b: int) -> Stretch:
    v, i, torque, angle, omega = (
        None if x is None else x[a:b] for x in (s.voltage, s.current, s.torque, s.position, s.velocity)
    )
    gap = None if s.gap is None else s.gap[a:b]
    return Stretch(s.time_s[a:b], s.usable[a:b], v, i, torque, angle, omega, s.complete, gap)


def regression_features(found: RegressionEstimate | None, rms_v: float, rms_i: float) -> dict[str, float]:
    """The features `catalogue.REGRESSION`; rms: of voltage and current."""
    if found is None:
        return {}
    value = dict(zip(found.names, found.value.tolist(), strict=True))
    std = dict(zip(found.names, found.std.tolist(), strict=True))
    out = {f"reg_{n}": value[n] for n in MOTOR_NAMES}
    out |= {f"reg_{n}_std": std[n] / max(abs(value[n]), 1e-300) for n in MOTOR_NAMES}
    R, L, K, J, B = (value[n] for n in MOTOR_NAMES)
    torque = K * rms_i
    if rms_v > 0.0:
        out["reg_Vb_share"] = value.get("Vb", 0.0) / rms_v
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
        out |= _armature(short, s, reg, float(rms[0]), _shift(w))
    if long is not None:
        found = fit(_armature_columns(long, s), long.held(s.voltage))
        out |= _against(found.theta, reg, "arm_long", "R") | {"arm_left_long": found.left}
    return out | _shaft(w, reg, rms)


def _armature_columns(w: Windows, s: Stretch) -> list[F64]:
    assert s.current is not None
    current, rate = w.integrals(s.current, 0, 1)
    return [current, -rate, _speed_integral(w, s), w.of_one]


def _speed_integral(w: Windows, s: Stretch, origin: int = 0) -> F64:
    """∫φ ω, from the position if there is one, counted from that of the sample `origin`."""
    if s.position is not None:
        return -w.integral(s.position - s.position[origin], 1)
    assert s.velocity is not None
    return w.integral(s.velocity)


def _armature(w: Windows, s: Stretch, reg: dict[str, float], rms_v: float, shift: int) -> dict[str, float]:
    assert s.voltage is not None
    assert s.current is not None
    direction = np.sign(s.current)
    columns = [*_armature_columns(w, s), w.integral(direction), w.held(s.voltage)]
    i, di, speed_, one, drop, v = range(6)
    with_drop = (i, di, speed_, one, drop)
    cases: dict[str, Case] = {"plain": (with_drop[:4], v), "drop": (with_drop, v)}
    for when, k in (("late", shift), ("early", -shift)):
        moved, at = w.moved(k), len(columns)
        current, rate = moved.integrals(s.current, 0, 1)
        columns += [current, -rate, moved.integral(direction), moved.held(s.voltage)]
        columns += [_speed_integral(moved, s, max(k, 0))]
        cases[f"{when}_v"] = with_drop, at + 3
        cases[f"{when}_i"] = (at, at + 1, speed_, one, at + 2), v
        cases[f"{when}_w"] = (i, di, at + 4, one, drop), v
    fits = Fits(columns)
    plain, beside_drop, *shifted = fits.solve(list(cases.values()))
    theta = beside_drop.theta
    out = _against(theta, reg, "arm_drop", "RLK") | _against(plain.theta, reg, "arm_plain", "RLK")
    out["arm_drop"] = theta[4] / rms_v
    out |= {"arm_offset": plain.theta[3] / rms_v, "arm_left": plain.left, "arm_rejected": fits.rejected(with_drop, v)}
    names = list(cases)[2:]
    return out | {f"arm_{n}": _log_ratio(f.left, beside_drop.left) for n, f in zip(names, shifted, strict=True)}


def _shift(w: Window) -> int:
    """By so many samples signals are shifted against each other, to see whether the balances then close better: the log
    of what is left with one signal shifted to what is left without is below 0 where that signal came late (`late`, it
    is moved ahead) or early."""
    return max(1, round(_SHIFT_S / w.period_s))


def _log_ratio(a: float, b: float) -> float:
    return float(np.log(max(a, 1e-12) / max(b, 1e-12)))


def _shaft(w: Window, reg: dict[str, float], rms: F64) -> dict[str, float]:
    s, K = w.stretch, reg["reg_K"]
    assert s.current is not None
    out: dict[str, float] = {}
    short, long = _windows(w, "shaft"), _windows(w, "shaft long")
    direction = s.sliding
    if short is not None:
        out |= _shaft_short(short, s, reg, rms, direction, _shift(w))
    if long is not None:
        found = fit([*_shaft_columns(long, s), long.integral(direction)], long.integral(s.current))
        out |= _against(K * found.theta, reg, "shaft_long", "JB")
        out |= {"shaft_left_long": found.left, "shaft_long_Tc": found.theta[3] / float(rms[1])}
    return out


def _shaft_short(
    w: Windows, s: Stretch, reg: dict[str, float], rms: F64, direction: F64, shift: int
) -> dict[str, float]:
    assert s.current is not None
    K, omega = reg["reg_K"], s.speed
    current, minus_rate = w.integrals(s.current, 0, 1)
    columns = [*_shaft_columns(w, s), w.integral(direction), w.integral(omega * np.abs(omega)), minus_rate, current]
    columns += [w.moved(k).integral(s.current) for k in (shift, -shift)]
    linear, rough, dragged, delay, y, late, early = (0, 1, 2), (0, 1, 2, 3), (0, 1, 2, 3, 4), (0, 1, 2, 3, 5), 6, 7, 8
    fits = Fits(columns)
    cases = [(linear, y), (rough, y), (dragged, y), (delay, y), (rough, late), (rough, early)]
    plain, beside_friction, beside_drag, delayed, *shifted = fits.solve(cases)
    left, drag = beside_friction.left, float(beside_drag.theta[4] * rms[2] ** 2 / rms[1])
    out = _against(K * plain.theta, reg, "shaft_linear", "JB") | {"shaft_left_linear": plain.left}
    out |= {"shaft_left": left, "shaft_rejected": fits.rejected(rough, y)}
    out |= _against(K * beside_drag.theta, reg, "shaft_drag", "JB") | {"shaft_drag": drag}
    out["shaft_delay"] = float(delayed.theta[4])
    return out | {f"shaft_{when}": _log_ratio(f.left, left) for when, f in zip(("late", "early"), shifted, strict=True)}


def _shaft_columns(w: Windows, s: Stretch) -> list[F64]:
    speed_, acceleration = motion(w, s)
    return [acceleration, speed_, w.of_one]


def residual_shares(w: Window, value: Mapping[str, float]) -> tuple[float, float] | None:
    """How far the two balances of this window are from closing with these parameters: RMS of what is left over the RMS
    of voltage and of current. What any drive may have beside them (an offset, a brush drop; a load, dry friction) is
    fitted to what is left: values that a model without these has fitted to the data must not win by it. None without a
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
    friction = shaft.integral(s.sliding)
    return (
        _left(left, [one, drop], short.held(s.voltage)),
        _left(shaft_left, [shaft_one, friction], shaft.integral(s.current)),
    )


def _left(residual: F64, free: list[F64], y: F64) -> float:
    left = fit(free, residual).left * np.sqrt(residual @ residual)
    return float(left / np.sqrt(max(float(y @ y), 1e-300)))


def _against(fit: F64, reg: dict[str, float], prefix: str, names: Sequence[str]) -> dict[str, float]:
    """log of the first coefficients to those of the regression; nothing for what is not positive."""
    pairs = ((n, float(fit[k]), reg[f"reg_{n}"]) for k, n in enumerate(names))
    return {f"{prefix}_{n}": float(np.log(a / b)) for n, a, b in pairs if a > 0.0 and b > 0.0}


def _windows(w: Window, which: str) -> Windows | None:
    """Windows without an unusable sample or a gap inside; None if there are none. The shaft's short ones overlap by
    half, of the others there are enough side by side."""
    s, side_by_side = w.stretch, which != "shaft"
    length = max(_FEWEST, round(_SPAN_S[which] / w.period_s)) + 1
    bad = ~s.usable if s.gap is None else ~s.usable | s.gap
    first = np.arange(0, len(s.time_s) - length + 1, length if side_by_side else length // 2, dtype=np.intp)
    before = np.concatenate([[0], np.cumsum(bad)])
    first = first[before[first + length] - before[first + 1] == 0]
    return make_windows(s.time_s, first, length, held=which.startswith("armature")) if len(first) else None
