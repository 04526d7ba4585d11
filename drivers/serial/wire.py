"""The binary serial wire, version 1: payloads of description and sample frames, as `docs/protocol.md` defines them.

This file is the format and nothing else: bytes of one payload to and from plain values; `wire_frame` makes frames of
payloads. `wire_decoder` turns a stream of bytes into samples, `wire_encoder` samples into frames,
`deploy/firmware/servo_wire.h` does the latter in C. Every number is little-endian.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.serial.frame import MAX_PAYLOAD
from servo_daemon.errors import WireError
from servo_daemon.samples import CHANNELS, Quality

#: Raised when a frame's layout changes (docs/protocol.md).
PROTOCOL_VERSION = 1


class FrameType(IntEnum):
    """First byte of a payload."""

    SAMPLES = 1
    DESCRIPTION = 2
    ESTIMATES = 3
    COMMAND = 4  # to the device


class Quantity(IntEnum):
    """What a channel of a sample record measures."""

    VOLTAGE = 1
    CURRENT = 2
    POSITION = 3
    VELOCITY = 4
    TEMPERATURE = 5
    TORQUE = 6
    STATUS = 16
    COMMAND = 17  # number of the command that acts, 0: none


#: Quantity -> channel of SampleBlock. Quantities that are not here (yet) are skipped.
CHANNEL_OF: dict[int, str] = {
    Quantity.VOLTAGE: "voltage_V",
    Quantity.CURRENT: "current_A",
    Quantity.POSITION: "position_rad",
    Quantity.VELOCITY: "velocity_rad_s",
    Quantity.TEMPERATURE: "temperature_C",
    Quantity.TORQUE: "torque_Nm",
}

#: Format code -> NumPy type.
FORMATS: dict[int, str] = {1: "u1", 2: "<i2", 3: "<u2", 4: "<i4"}

#: Bits of a status byte that mean the same as the bits of `Quality`; the rest is the device's own business.
STATUS_MASK = int(Quality.VOLTAGE_INVALID | Quality.CURRENT_INVALID | Quality.POSITION_INVALID | Quality.SATURATED)

# type, drive id, session, number of samples, sequence of the first, device time of the first in µs
SAMPLES_HEADER = struct.Struct("<BBBBII")
# type, drive id, session, version, sample period in ns, position modulus, identity, number of channels
DESCRIPTION_HEADER = struct.Struct("<BBBBII16sB")
# quantity, format, scale, offset
CHANNEL_ENTRY = struct.Struct("<BBff")


@dataclass(frozen=True, slots=True)
class Channel:
    """One entry of a description: how an integer of a sample record becomes a value.

    `value = offset + scale * integer`, in the unit of the channel (V, A, rad/s, °C, N·m). For POSITION `scale` is
    counts per revolution instead (1/4096 turn is exact, 2π/4096 is not) and `offset` is in rad; a negative one turns
    the direction round.
    """

    quantity: int
    format: int
    scale: float = 1.0
    offset: float = 0.0

    def __post_init__(self) -> None:
        if self.format not in FORMATS:
            raise WireError(f"quantity {self.quantity}: unknown format {self.format}")
        if not (math.isfinite(self.scale) and math.isfinite(self.offset) and self.scale != 0.0):
            raise WireError(f"quantity {self.quantity}: impossible scale {self.scale} or offset {self.offset}")

    @property
    def unit_per_lsb(self) -> float:
        """Size of one step in the channel's unit, with sign."""
        return 2.0 * math.pi / self.scale if self.quantity == Quantity.POSITION else self.scale


@dataclass(frozen=True)
class Description:
    """What a device tells once a second about itself and its sample frames.

    Attributes:
        drive_id: 0 .. 255, the drive on this line.
        session: changes whenever the device restarts (if it can arrange that) or changes its description.
        channels: layout of a sample record after its `dt_us`, in this order.
        identity: serial number or name of the unit, at most 16 bytes of UTF-8; may be empty.
        sample_period_ns: 0 where the device does not sample regularly.
        position_modulus: the position counter wraps from this minus 1 to 0; 0: at the width of its format.
    """

    drive_id: int
    session: int
    channels: tuple[Channel, ...]
    identity: str = ""
    sample_period_ns: int = 0
    position_modulus: int = 0

    def __post_init__(self) -> None:
        quantities = [c.quantity for c in self.channels]
        if not quantities or len(set(quantities)) != len(quantities):
            raise WireError(f"channels {quantities}: none, or one twice")
        if not any(q in CHANNEL_OF for q in quantities):
            raise WireError(f"channels {quantities}: nothing known is measured")

    def channel(self, quantity: Quantity) -> Channel | None:
        """The channel of that quantity, None where the device lacks it."""
        return next((c for c in self.channels if c.quantity == quantity), None)

    @property
    def channel_names(self) -> tuple[str, ...]:
        """The channels a block of these samples has, in the order of `samples.CHANNELS`."""
        present = {CHANNEL_OF.get(c.quantity) for c in self.channels}
        return tuple(name for name in CHANNELS if name in present)

    @cached_property
    def fields(self) -> tuple[str, ...]:
        """Names of the channels' fields in `record`."""
        return tuple(f"c{i}" for i in range(len(self.channels)))

    @cached_property
    def record(self) -> np.dtype[np.void]:
        """NumPy type of one sample: `dt_us` and a field for every channel."""
        formats = (FORMATS[c.format] for c in self.channels)
        return np.dtype([("dt_us", "<u2"), *zip(self.fields, formats, strict=True)])

    @property
    def max_samples(self) -> int:
        """Most samples one frame can hold."""
        return min(255, (MAX_PAYLOAD - SAMPLES_HEADER.size) // self.record.itemsize)

    @property
    def modulus(self) -> int:
        """Period of the position counter in counts; 0 without a position channel."""
        channel = self.channel(Quantity.POSITION)
        if channel is None:
            return 0
        return self.position_modulus or 256 ** np.dtype(FORMATS[channel.format]).itemsize


@lru_cache(maxsize=64)
def frame_dtype(record: np.dtype[np.void], n: int) -> np.dtype[np.void]:
    """NumPy type of a whole payload with `n` samples and its CRC, so that equal frames decode as one array."""
    return np.dtype(
        [
            ("head", "V4"),
            ("sequence", "<u4"),
            ("t_us", "<u4"),
            ("samples", record, (n,)),
            ("crc", "V2"),
        ]
    )


def encode_description(description: Description) -> bytes:
    """Payload of a description frame.

    Raises:
        ValueError: a field does not fit (drive id, session, an identity longer than 16 bytes, too many channels).
    """
    identity = description.identity.encode()
    if len(identity) > 16:
        raise ValueError(f"identity {description.identity!r} is longer than 16 bytes of UTF-8")
    try:
        header = DESCRIPTION_HEADER.pack(
            FrameType.DESCRIPTION,
            description.drive_id,
            description.session,
            PROTOCOL_VERSION,
            description.sample_period_ns,
            description.position_modulus,
            identity,
            len(description.channels),
        )
        entries = [CHANNEL_ENTRY.pack(c.quantity, c.format, c.scale, c.offset) for c in description.channels]
    except (struct.error, OverflowError) as error:
        raise ValueError(f"description does not fit the wire: {error}") from error
    return header + b"".join(entries)


def decode_description(payload: bytes) -> Description:
    """The description in a payload (without CRC).

    Raises:
        WireError: another protocol version, a wrong length, a format or scale that cannot be.
    """
    if len(payload) < DESCRIPTION_HEADER.size:
        raise WireError(f"description of {len(payload)} bytes is too short")
    kind, drive_id, session, version, period_ns, modulus, identity, count = DESCRIPTION_HEADER.unpack_from(payload)
    if kind != FrameType.DESCRIPTION or version != PROTOCOL_VERSION:
        raise WireError(f"frame type {kind}, protocol version {version}: not a description of version 1")
    if len(payload) != DESCRIPTION_HEADER.size + count * CHANNEL_ENTRY.size:
        raise WireError(f"description of {len(payload)} bytes does not hold {count} channels")
    entries = [
        (quantity, form, _shortest(scale), _shortest(offset))
        for quantity, form, scale, offset in CHANNEL_ENTRY.iter_unpack(payload[DESCRIPTION_HEADER.size :])
    ]
    return Description(
        drive_id=drive_id,
        session=session,
        channels=tuple(Channel(*entry) for entry in entries),
        identity=identity.rstrip(b"\0").decode(errors="replace"),
        sample_period_ns=period_ns,
        position_modulus=modulus,
    )


def _shortest(value: float) -> float:
    """The shortest decimal number that is this 32-bit float: 0.001 as the firmware's source says, not
    0.0010000000474974513."""
    return float(str(np.float32(value)))


def encode_samples(
    description: Description,
    sequence: int,
    t_us: NDArray[np.int64],
    columns: list[NDArray[Any]],
) -> bytes:
    """Payload of one sample frame.

    Args:
        sequence: number of the first sample; wraps at 32 bits.
        t_us: shape (n,), device time of each sample, µs, increasing by at most 65535; wraps at 32 bits.
        columns: one array of shape (n,) of integers a channel, in the description's order; they wrap at the width
            of the channel's format.

    Raises:
        ValueError: no samples, too many for one frame, or times too far apart for one frame.
    """
    n = t_us.shape[0]
    if not 0 < n <= description.max_samples:
        raise ValueError(f"{n} samples: a frame of this description holds 1 .. {description.max_samples}")
    records = np.zeros(n, dtype=description.record)
    steps = np.diff(t_us)
    if n > 1 and not (int(steps.min()) > 0 and int(steps.max()) <= 0xFFFF):
        raise ValueError("times within a frame must increase by 1 .. 65535 µs")
    records["dt_us"][1:] = steps
    for name, column in zip(description.fields, columns, strict=True):
        field = records[name]
        field[:] = column.astype(np.int64).astype(field.dtype)
    header = SAMPLES_HEADER.pack(
        FrameType.SAMPLES,
        description.drive_id,
        description.session,
        n,
        sequence & 0xFFFFFFFF,
        int(t_us[0]) & 0xFFFFFFFF,
    )
    return header + records.tobytes()
