"""Figures of the unmodelled torque and voltage: over time, speed, angle and current, and as a spectrum."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servo_daemon.commands.diagnose.evidence import Evidence, has_other_torques
from servo_daemon.commands.shared.units import shown_unit
from servo_daemon.diagnosis.missing.missing import Missing
from servo_daemon.diagnosis.verdict.result import Diagnosis
from servo_daemon.numerics import sample_period
from servo_daemon.report import Axis, Line, Mark, Points, Scatter, Spectrum, TimeSeries
from servo_daemon.report.document import Block
from servo_daemon.report.numbers import number_text
from servo_daemon.samples import F64

#: A curve is the mean over stretches: so many of equal width, and so many of equally many samples.
_WIDE, _FULL, _FEWEST_IN_BIN = 40, 40, 8
#: A spectrum's pieces: about so many, half overlapping, and at least so many samples each.
_PIECES, _SHORTEST_PIECE = 6, 256
#: The least part of the largest amplitude that a spectrum shows.
_DEEP = 1e-6
_TURN = 2 * np.pi


@dataclass(frozen=True)
class _Series:
    """One missing quantity: its name and unit, and the passes that know it, by what they are called in a legend."""

    name: str
    key: str
    unit: str
    passes: Mapping[str, Missing]

    def of(self, who: str) -> F64:
        return self.passes[who].series[self.key]

    @property
    def time_s(self) -> F64:
        return next(iter(self.passes.values())).time_s

    def std(self, who: str) -> F64:
        return self.passes[who].std[self.key]

    @property
    def working(self) -> str:
        """What the motor works with, with its unit, of each model whose motor is another."""
        sizes = {who: f"{number_text(m.size[self.key], 3)} {self.unit} rms" for who, m in self.passes.items()}
        if len(set(sizes.values())) == 1:
            return next(iter(sizes.values()))
        return ", ".join(f"{size} ({who})" for who, size in sizes.items())

    @property
    def axis(self) -> Axis:
        return Axis(f"missing {self.name}", self.unit)


@dataclass(frozen=True)
class _Quantity:
    """What a missing quantity is drawn over: shape (n,), and whether its direction of motion matters."""

    values: F64
    axis: Axis
    by_direction: bool = True


def missing_figures(d: Diagnosis, evidence: Evidence, marks: Sequence[Mark]) -> tuple[Block, ...]:
    """All figures of what is missing in the longest capture."""
    capture = d.captures[evidence.longest]
    linear = capture.axis == "linear"
    extended = {} if evidence.left is None else {"extended": evidence.left}
    left_out = {"baseline": d.before} if evidence.asked is None else {"effects left out": evidence.asked}
    beside = left_out if has_other_torques(d, evidence) else {"baseline": d.before}
    motor = (
        evidence.asked or d.before
    )  # without a measured current the baseline's torque and current are a biased one's
    gap, group = 5.0 * capture.sample_period_s, str(capture.path)
    figures = list[Block]()
    for key in d.before.series:
        name = "force" if linear and key == "torque" else key
        unit = shown_unit({"torque": "N·m", "voltage": "V"}[key], linear=linear)
        fitted = _Series(name, key, unit, beside | extended)
        shaped = _Series(name, key, unit, left_out | extended)
        figures.append(_over_time(fitted, capture.time_s[0], gap, group, marks))
        figures += [_over(shaped, x, motor) for x in _quantities(motor, linear=linear)]
        figures += _spectrum(fitted)
    return tuple(figures)


def means_over_speed(m: Missing, key: str) -> Points | None:
    """A missing quantity's means over the speed; None: there is no speed, or too few samples for means."""
    speed = m.states.get("velocity_rad_s")
    return None if speed is None else _means(key, speed, m.series[key])


def _over_time(s: _Series, begin: float, gap: float, group: str, marks: Sequence[Mark]) -> TimeSeries:
    lines = tuple(Line(who, s.of(who), s.of(who) - s.std(who), s.of(who) + s.std(who)) for who in s.passes)
    return TimeSeries(
        f"Missing {s.name} over time",
        s.time_s - begin,
        lines,
        s.axis,
        f"The band is one standard deviation of the estimate on either side. The motor works with {s.working}.",
        group=group,
        gap=gap,
        marks=tuple(marks),
    )


def _quantities(m: Missing, *, linear: bool) -> Iterator[_Quantity]:
    speed, angle = m.states.get("velocity_rad_s"), m.states.get("position_rad")
    if speed is not None:
        yield _Quantity(speed, Axis("speed", "m/s" if linear else "rad/s"), by_direction=False)
    if angle is not None and np.ptp(angle) > 0:
        turns = not linear and np.ptp(angle) > _TURN
        name = "position" if linear else "angle within the turn" if turns else "angle"
        yield _Quantity(np.mod(angle, _TURN) if turns else angle, Axis(name, "m" if linear else "rad"))
    if m.augmented.plant.drive == "torque":
        yield _Quantity(m.input, Axis("applied force" if linear else "applied torque", "N" if linear else "N·m"))
    else:
        yield _Quantity(m.states.get("current_A", m.input), Axis("current", "A"))


def _over(s: _Series, x: _Quantity, m: Missing) -> Scatter:
    """Samples as points, their means as curves; over anything but the speed one for each direction of motion."""
    speed = m.states.get("velocity_rad_s")
    everything = np.ones(len(m.time_s), dtype=bool)
    parts: dict[str, NDArray[np.bool_]] = {"mean": everything}
    if x.by_direction and speed is not None and (speed > 0).any() and (speed < 0).any():
        parts = {"mean forwards": speed > 0, "mean backwards": speed < 0}
    curves = [
        _means(f"{who}, {what}", x.values[here], s.of(who)[here]) for who in s.passes for what, here in parts.items()
    ]
    std = number_text(float(np.median([np.median(s.std(who)) for who in s.passes])), 2)
    return Scatter(
        f"Missing {s.name} over {x.axis.label}",
        tuple(Points(who, x.values, s.of(who)) for who in s.passes),
        x.axis,
        s.axis,
        curves=tuple(c for c in curves if c is not None),
        caption=f"The motor works with {s.working}. One standard deviation of a point: about {std} {s.unit}.",
    )


def _means(name: str, x: F64, y: F64) -> Points | None:
    """Over stretches that are narrow where there are many samples and never very wide; None where too few have any."""
    if len(x) < 3 * _FEWEST_IN_BIN or np.ptp(x) == 0:
        return None
    order = np.sort(x)
    full = np.quantile(order, np.linspace(0.0, 1.0, _FULL + 1))
    edges = np.unique(np.concatenate([full, np.linspace(order[0], order[-1], _WIDE + 1)]))
    number = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, len(edges) - 2)
    counts = np.bincount(number, minlength=len(edges) - 1)
    some = counts >= _FEWEST_IN_BIN
    if np.count_nonzero(some) < 3:
        return None
    mean_x, mean_y = (np.bincount(number, weights=v, minlength=len(edges) - 1) / np.maximum(counts, 1) for v in (x, y))
    middle = (edges[:-1] + edges[1:]) / 2
    return Points(name, np.where(some, mean_x, middle), np.where(some, mean_y, np.nan))  # NaN: a gap in the curve


def _spectrum(s: _Series) -> Iterator[Spectrum]:
    """Amplitudes of sines, by Welch's means over Hann-windowed pieces of an even time base."""
    from scipy.signal import welch

    time = s.time_s
    period = sample_period(time) if len(time) >= 2 * _SHORTEST_PIECE else 0.0
    if period <= 0:
        return
    even = np.arange(time[0], time[-1], period)
    length = min(len(even), max(_SHORTEST_PIECE, 2 * len(even) // (_PIECES + 1)))
    lines, frequency = list[tuple[str, F64]](), np.zeros(0)
    for who in s.passes:
        values = np.interp(even, time, s.of(who))
        frequency, power = welch(values, 1.0 / period, nperseg=length, scaling="spectrum")
        lines.append((who, np.sqrt(2.0 * power[1:])))
    least = _DEEP * max(float(np.max(y)) for _, y in lines)
    yield Spectrum(
        f"Missing {s.name} over frequency",
        frequency[1:],
        tuple(Line(who, np.where(y >= least, y, np.nan)) for who, y in lines),
        Axis("amplitude", s.unit, log=True),
        f"Amplitude of a sine of that frequency; less than {_DEEP:.0e} of the largest is not drawn.",
    )
