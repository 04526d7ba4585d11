"""What an unmodelled torque or voltage follows, where no effect has a name for it.

Each quantity is a set of columns without a physical formula: hats over speed, travel, current or time, harmonics of the
turn, a step, a spectral line, the heat of the winding. A quantity counts by the share of the series that it explains on
time blocks held out, beyond the plant's free parameters and beyond the quantities chosen before it. The series' own
variance is in the denominator: where it is no larger than its standard deviation nothing is explained.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from servo_daemon.diagnosis.missing.missing import Fitted, Missing
from servo_daemon.diagnosis.missing.signals import motion_of
from servo_daemon.diagnosis.screening.regression import Regression, of_parameters
from servo_daemon.diagnosis.screening.screen import context_of
from servo_daemon.plant.columns.scans import best_harmonics, spectral_lines, step_times
from servo_daemon.plant.columns.screening import Context, Trace
from servo_daemon.samples import F64

#: A share below this is none, nor is anything below this share of the working torque or voltage. The second is what
#: keeps clean captures empty: steps of encoder, converter and voltage leave real traces, of up to 0.05 % of the working
#: voltage, that follow angle and time; what a user looks for begins at some percent.
LEAST_SHARE, LEAST_SIZE = 0.08, 2e-3
#: So few samples hold so much of the series' energy, are so many standard deviations large at the largest, and are of
#: such a size beside the working torque or voltage, where something came at moments (chosen; not tried).
_FEW, _HELD_BY_FEW, _BEYOND_NOISE, _MOMENT_SIZE = 0.02, 0.4, 10.0, 0.05
#: Beyond this share of the working torque or voltage something is missing, also if it follows nothing (decision 73).
_LARGE = 0.02
#: Hats over a quantity's range, and the longest list (chosen; not tried).
_HATS, _LONGEST = 9, 4
#: Of a heat that comes and goes, in shares of the capture (chosen; not tried).
_THERMAL = (0.1, 0.4)


@dataclass(frozen=True, slots=True)
class Dependence:
    """Attributes:
    series: "torque" or "voltage".
    on: "speed", "direction", "angle", "travel", "current", "load", "time", "step", "moments",
        "temperature" or "frequency".
    share: of the series' mean square, on blocks held out, beyond those listed before.
    size: RMS of what it explains, N·m or V.
    relative: that over the working torque or voltage.
    detail: "harmonic" of the turn, "frequency_hz", "time_s".
    """

    series: str
    on: str
    share: float
    size: float
    relative: float
    detail: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class _Quantity:
    on: str
    columns: tuple[F64, ...]
    detail: Mapping[str, float]


def dependences(fit: Fitted, missing: Missing) -> tuple[Dependence, ...]:
    """What the series follow, the strongest first; empty where nothing is missing or it follows nothing.

    Args:
        fit: whose free parameters explain first.
        missing: of `missing_inputs`.
    """
    motion = motion_of(missing)
    of_motor, stiff = of_parameters(motion, fit, missing)
    context = context_of(missing, motion, of_motor)
    out: list[Dependence] = []
    for name in missing.series:
        quantities = list(_quantities(context, name))
        traces = [*of_motor, *(_trace(name, column) for q in quantities for column in q.columns)]
        regression = Regression.of(missing, motion, traces, stiff)
        unit, whole = (
            float(np.median(missing.std[name])),
            float(np.sqrt(missing.mean_square[name])) * missing.size[name],
        )
        found = _forward(
            name, regression, len(of_motor), quantities, (unit, missing.size[name]), int((~motion.rest).sum())
        )
        # Where its standard deviation varies by orders a part must not come out larger than the whole.
        found = [replace(d, size=min(d.size, whole), relative=min(d.size, whole) / missing.size[name]) for d in found]
        out += [d for d in found if d.relative >= LEAST_SIZE] or _moments(name, missing)
    return tuple(sorted(out, key=lambda d: -d.share))


def is_large(missing: Missing) -> bool:
    """Whether a torque or a voltage is missing, whatever it follows, that no clean capture shows: those have 0.1 % of
    the working one at the most (16 captures, four motors, four motions)."""
    noise = {n: float(np.median(std)) / missing.size[n] for n, std in missing.std.items()}
    return any(square >= _LARGE**2 and square > noise[n] ** 2 for n, square in missing.mean_square.items())


def _moments(name: str, missing: Missing) -> list[Dependence]:
    """What came at a few moments and follows nothing else: a load that dropped, a contact that opened. A series that is
    small nearly everywhere holds its energy in few samples (Gaussian noise: 14 % in the largest 2 %)."""
    where = missing.seen
    series, std, size = missing.series[name][where], missing.std[name][where], missing.size[name]
    energy = np.square(series)
    largest = energy >= np.quantile(energy, 1.0 - _FEW)
    share = float(energy[largest].sum() / max(float(energy.sum()), 1e-300))
    rms = float(np.sqrt(np.mean(energy[largest])))
    if share < _HELD_BY_FEW or (np.abs(series) < _BEYOND_NOISE * std).all() or rms < _MOMENT_SIZE * size:
        return []
    k = int(np.argmax(energy))
    return [Dependence(name, "moments", share, rms, rms / size, {"time_s": float(missing.time_s[where][k])})]


def _trace(series: str, values: F64) -> Trace:
    return Trace(torque=values) if series == "torque" else Trace(voltage=values)


def _forward(
    name: str, regression: Regression, own: int, quantities: list[_Quantity], units: tuple[float, float], n: int
) -> list[Dependence]:
    """Chosen one after the other, each by what it adds; at most one of a kind."""
    ends = own + np.cumsum([len(q.columns) for q in quantities])
    where = [range(int(end) - len(q.columns), int(end)) for end, q in zip(ends, quantities, strict=True)]
    columns = list(range(own))
    first = regression.errors(columns)[1]
    before, left = first, list(range(len(quantities)))
    out: list[Dependence] = []
    while left and len(out) < _LONGEST:
        errors = {k: regression.errors([*columns, *where[k]])[1] for k in left}
        # A column more must pay for itself: of two that explain alike the simpler one is named.
        best = min(left, key=lambda k: np.log(errors[k] + regression.unknown) + 0.01 * len(quantities[k].columns))
        share = (before - errors[best]) / (first + regression.unknown)
        size = units[0] * float(np.sqrt(max(before - errors[best], 0.0) / max(n, 1)))
        if share < LEAST_SHARE or size < LEAST_SIZE * units[1]:
            break
        out.append(Dependence(name, quantities[best].on, float(share), size, size / units[1], quantities[best].detail))
        columns, before = [*columns, *where[best]], errors[best]
        left = [
            k for k in left if quantities[k].on != quantities[best].on or quantities[k].on in ("angle", "frequency")
        ]
        left = [k for k in left if k != best]
    return out


def _quantities(c: Context, series: str) -> Iterator[_Quantity]:
    m = c.motion
    torque = series == "torque"
    yield _Quantity("direction", (c.rest_friction if torque else np.sign(m.i),), {})
    yield _Quantity("speed", _hats(m.omega), {})
    if np.any(m.i):  # beyond what is linear in it, which the balance itself is
        size = np.abs(m.i) / np.percentile(np.abs(m.i), 95.0)
        yield _Quantity("current", (np.sign(m.i), size, size**2, size * m.i, size**2 * m.i)[torque:], {})
    if torque and np.any(m.i):
        yield _Quantity("load", (np.abs(m.i) * c.rest_friction,), {})
    yield _Quantity("travel", (*_hats(m.theta), *(hat * c.rest_friction for hat in _hats(m.theta))), {})
    carrier = np.ones(len(m.t)) if torque else m.i
    yield _Quantity("time", _hats(m.t) if torque else (*_hats(m.t), *(hat * m.i for hat in _hats(m.t))), {})
    for k in step_times(c.residual[series], np.where(m.rest, 0.0, carrier)):
        yield _Quantity("step", (np.where(m.t >= m.t[k], carrier, 0.0),), {"time_s": float(m.t[k])})
    for share in _THERMAL if np.any(m.i) and not torque else ():
        yield _Quantity("temperature", (_heat(m.i, m.h, share * float(m.t[-1] - m.t[0])) * m.i,), {})
    for n in _harmonics(c, series):
        yield _Quantity("angle", (np.sin(n * m.theta), np.cos(n * m.theta)), {"harmonic": float(n)})
    for f in spectral_lines(m.t, c.residual[series], 2):
        wave = 2 * np.pi * f * m.t
        yield _Quantity("frequency", (np.sin(wave), np.cos(wave)), {"frequency_hz": f})


def _harmonics(c: Context, series: str) -> list[int]:
    whole = 1 if np.ptp(c.motion.theta) > 2 * np.pi else None
    return [*([whole] if whole else []), *best_harmonics(c, np.ones(len(c.motion.t)), series)]


def _hats(x: F64) -> tuple[F64, ...]:
    """Linear interpolation between knots at even shares of the samples, shapes (n,); they sum to one."""
    knots = np.unique(np.quantile(x, np.linspace(0.0, 1.0, _HATS)))
    if len(knots) < 3:
        return (x - x.mean(),)
    return tuple(np.interp(x, knots, row) for row in np.eye(len(knots)))


def _heat(i: F64, h: F64, tau: float) -> F64:
    from scipy.signal import lfilter

    return np.asarray(lfilter([0.0, 1.0], [1.0, -float(np.exp(-np.median(h) / tau))], i**2 * h))
