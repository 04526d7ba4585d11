"""What a capture is once it has been read and checked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from servo_daemon.errors import BadInputError, CaptureError
from servo_daemon.numerics import sample_period
from servo_daemon.samples import CHANNELS, F64, GAP_FACTOR, U8, Quality, SampleBlock, make_block
from servo_daemon.signal_meaning import SignalMeaning, as_texts, keys_of_texts

Axis = Literal["rotary", "linear"]

#: A linear axis has its own column names; inside the program they travel in the rotary fields.
LINEAR_COLUMNS: Mapping[str, str] = MappingProxyType(
    {"force_N": "torque_Nm", "position_m": "position_rad", "velocity_m_s": "velocity_rad_s"}
)

#: Metadata that are numbers greater than zero wherever they are given (docs/captures.md).
NUMERIC_METADATA = ("mass_kg", "arm_length_m", "counts_per_rev")


#: Fewer have no sampling period.
MIN_SAMPLES = 2


def capture_error(
    path: Path, message: str, *, line: int | None = None, place: str | None = None, column: str | None = None
) -> CaptureError:
    """The one wording of everything that is wrong with a capture: file, line (1-based, all lines count), column.

    A file without lines has a place of its own kind instead ("sheet Data, row 17"; "sample 17", counted from 1).
    """
    where = [str(path)]
    if line is not None:
        where.append(f"line {line}")
    if place is not None:
        where.append(place)
    if column is not None:
        where.append(f"column {column}")
    return CaptureError(f"{', '.join(where)}: {message}")


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """A checked capture: at least two samples, finite values, strictly increasing time.

    Attributes:
        path: the file it came from.
        time_s: shape (n,), s, as in the file. Seconds since 1970 are held to 0.24 µs (float64), not better.
        voltage_V: shape (n,) or None, V; voltage_V[k] was applied from time_s[k] until time_s[k + 1].
        current_A: shape (n,) or None, A.
        position_rad: shape (n,) or None, rad (m on a linear axis).
        velocity_rad_s: shape (n,) or None, rad/s (m/s on a linear axis).
        temperature_C: shape (n,) or None, °C.
        torque_Nm: shape (n,) or None, N·m (N on a linear axis).
        axis: "linear" where the file has force_N, position_m, velocity_m_s or says `# axis: linear`.
        metadata: the `# key: value` lines; a key given on several lines has them joined by newlines.
        notes: what the user should hear about the file (ignored columns), one sentence each.
        current_known: shape (n,): where the current is a measurement; None: everywhere.
        as_map: what the file's signals were taken for, as a signal map would say it ("signals" by column,
            "counts_per_rev"); empty: as they are called.
    """

    path: Path
    time_s: F64
    voltage_V: F64 | None = None
    current_A: F64 | None = None
    position_rad: F64 | None = None
    velocity_rad_s: F64 | None = None
    temperature_C: F64 | None = None
    torque_Nm: F64 | None = None
    axis: Axis = "rotary"
    metadata: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    current_known: NDArray[Any] | None = None
    as_map: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("metadata", "as_map"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))
        for name in ("time_s", *self.channels):
            array = getattr(self, name)
            if array.shape != self.time_s.shape:
                raise ValueError(f"{name} has shape {array.shape}, time_s has {self.time_s.shape}")
            array.setflags(write=False)

    def __len__(self) -> int:
        return int(self.time_s.shape[0])

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels it carries, in the order of `samples.CHANNELS`."""
        return tuple(name for name in CHANNELS if getattr(self, name) is not None)

    @property
    def sample_period_s(self) -> float:
        """Median distance of two samples, s: not moved by gaps."""
        return sample_period(self.time_s)

    @property
    def duration_s(self) -> float:
        """From the first sample to the last, s."""
        return float(self.time_s[-1] - self.time_s[0])

    def metadata_number(self, key: str) -> float | None:
        """A metadata value as a number; None where the capture does not give it.

        Raises:
            CaptureError: it is given and is not a number.
        """
        text = self.metadata.get(key)
        if text is None:
            return None
        try:
            return float(text)
        except ValueError as error:
            raise capture_error(self.path, f"metadata {key}: {text!r} is not a number") from error

    @property
    def mass_kg(self) -> float | None:
        """Mass of a known load, kg."""
        return self.metadata_number("mass_kg")

    @property
    def arm_length_m(self) -> float | None:
        """Distance of that mass from the shaft, m."""
        return self.metadata_number("arm_length_m")

    @property
    def counts_per_rev(self) -> float | None:
        """Encoder counts per revolution."""
        return self.metadata_number("counts_per_rev")

    def meaning(self, otherwise: SignalMeaning | None = None) -> SignalMeaning:
        """What its voltage and current are: its own lines, and where they are silent what is given otherwise.

        Raises:
            CaptureError: a line says what cannot be.
        """
        try:
            return (otherwise or SignalMeaning()).with_keys(keys_of_texts(self.metadata))
        except BadInputError as error:
            raise capture_error(self.path, f"metadata {error}") from error

    def as_dc(self, meaning: SignalMeaning) -> Capture:
        """The same in a DC motor's voltage and current, at the motor's shaft; its lines say so.

        Args:
            meaning: of its signals as they are.

        Raises:
            CaptureError: a gear on a linear axis.
        """
        if self.axis == "linear" and meaning.gear_ratio != 1.0:
            raise capture_error(self.path, "gear_ratio belongs to a rotary axis")
        block = meaning.converted(self.block())
        channels = {name: getattr(block, name) for name in self.channels}
        return replace(self, metadata={**self.metadata, **as_texts(meaning.as_dc)}, **channels)

    def without_voltage(self) -> Capture:
        """The same as of a drive that does not tell its voltage."""
        return replace(self, voltage_V=None)

    def of_rows(self, rows: NDArray[np.bool_]) -> Capture:
        """Some of its samples, shape (n,): what is left out is a pause."""
        known = None if self.current_known is None else self.current_known[rows]
        kept = {name: getattr(self, name)[rows] for name in ("time_s", *self.channels)}
        return replace(self, current_known=known, **kept)

    def quality(self) -> U8:
        """Shape (n,): `Quality.GAP_BEFORE` where more than `GAP_FACTOR` median periods passed, and
        `Quality.CURRENT_INVALID` where the current is no measurement; else good."""
        distance_s = np.diff(self.time_s)
        quality = np.zeros(len(self), dtype=np.uint8)
        quality[1:][distance_s > GAP_FACTOR * np.median(distance_s)] = Quality.GAP_BEFORE
        if self.current_A is not None and self.current_known is not None:
            quality[~self.current_known] |= np.uint8(Quality.CURRENT_INVALID)
        return quality

    def block(self) -> SampleBlock:
        """All samples as one block (views of the arrays); `sequence` counts from 0, no host time."""
        channels = {name: getattr(self, name) for name in self.channels}
        mean = self.meaning().current == "mean"
        return make_block(self.time_s, quality=self.quality(), current_mean=mean, **channels)

    def blocks(self, samples: int) -> Iterator[SampleBlock]:
        """The capture in blocks of `samples` (the last one may be shorter): `block()` cut up, nothing else."""
        if samples < 1:
            raise ValueError(f"a block needs at least one sample, not {samples}")
        whole = self.block()
        for start in range(0, len(self), samples):
            yield whole.slice(start, start + samples)


#: Counters of a clock, bits and s per tick: micros() and millis() of an Arduino, in s, in their own unit, in between.
COUNTERS: tuple[tuple[int, float, str], ...] = tuple(
    (bits, tick, words)
    for bits in (32, 31, 24, 16)
    for tick, words in ((1e-6, " in µs"), (1e-3, " in ms (or µs, shown so)"), (1.0, ""))
)
#: What passes between two samples, as a share of the counter's range.
_COUNTER_NEAR = 0.02


def time_fault(now: float, before: float) -> str:
    """What is wrong with two successive times of which the second is not later."""
    text = f"time {'is repeated' if now == before else 'jumps back'}: {now!r} after {before!r}"
    for bits, tick, words in COUNTERS:
        if abs((before - now) / (2.0**bits * tick) - 1.0) < _COUNTER_NEAR:
            wrap = f"{2**bits * tick:.12g}"
            return f"{text}: a counter of {bits} bits{words} that starts again; mend: wrap = {wrap} in the map's time_s"
    return text


def time_mend(fault: str) -> str:
    """What to do about a fault of the time in a table, to be put behind it."""
    if "mend:" in fault:
        return ""
    return "; mend: --rate HZ, if the samples are even" if "repeated" in fault else "; mend: cut the file there"


def first_bad_time(time_s: F64) -> int | None:
    """Index of the first sample that is not later than the one before it; None if time increases."""
    bad = np.flatnonzero(np.diff(time_s) <= 0.0)
    return int(bad[0]) + 1 if bad.size else None
