"""CAN frames in blocks: what arrived as arrays, and the signals of a DBC read out of them without a Python loop.

cantools parses the DBC; decoding a frame at a time with it costs tens of microseconds. Here a signal is shift, mask,
sign and scale over all frames of one identifier at once (`Field`), checked against cantools' own decode in
`tests/property/test_can_fields.py`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from servo_daemon.errors import DriverConfigError
from servo_daemon.samples import F64, I64, U8

if TYPE_CHECKING:
    import can
    from cantools.database.can import Database, Message, Signal

Bits = NDArray[np.bool_]
T = TypeVar("T")

#: Marks a 29-bit identifier in a key, as SocketCAN and DBC files do (CAN_EFF_FLAG in linux/can.h).
EXTENDED = 0x8000_0000

#: Most data bytes of a classic frame and of a CAN FD frame (ISO 11898-1).
CLASSIC_BYTES = 8
FD_BYTES = 64


def frame_key(frame_id: int, extended: bool) -> int:
    """The one number that tells frames apart: 11-bit and 29-bit identifiers never meet."""
    return frame_id | EXTENDED if extended else frame_id


def key_text(key: int) -> str:
    """A key as people write it: 0x121, or eight digits for a 29-bit identifier."""
    return f"0x{key & ~EXTENDED:08X}" if key & EXTENDED else f"0x{key:03X}"


@dataclass(frozen=True, slots=True)
class FrameBatch:
    """Data frames in the order in which they arrived, n >= 1.

    Attributes:
        keys: shape (n,), `frame_key` of each.
        data: shape (n, 8), or (n, 64) where a CAN FD frame is among them; zero-padded.
        lengths: shape (n,), bytes each frame really had.
        shortest: the least of them, or `CLASSIC_BYTES` where none has fewer.
        stamp_s: shape (n,), s, python-can's receive time stamps (their zero depends on the interface).
        host_s: s, monotonic host clock when the last of them had been received.
        wall_s: s, wall clock at the same moment.
        whole: all that was received together, where this is one drive's share of it.
    """

    keys: I64
    data: U8
    lengths: I64
    shortest: int
    stamp_s: F64
    host_s: float
    wall_s: float
    whole: FrameBatch | None = None
    _worked_out: dict[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.keys)

    def shared(self, name: str, work: Callable[[FrameBatch], T]) -> T:
        """`work` of all frames that were received together, done once for all the drives that ask for it by `name`."""
        whole = self.whole or self
        if name not in whole._worked_out:  # two threads may both do it: with the same result
            whole._worked_out[name] = work(whole)
        result: T = whole._worked_out[name]
        return result

    def share(self, start: int, stop: int) -> FrameBatch:
        """Frames start..stop-1 as one drive's share of this (views, no copy), at least one."""
        return self.slice(start, stop, self)

    def slice(self, start: int, stop: int, whole: FrameBatch | None = None) -> FrameBatch:
        """Frames start..stop-1 (views, no copy), at least one."""
        cut = slice(start, stop)
        lengths, shortest = self.lengths[cut], self.shortest
        if shortest < CLASSIC_BYTES:  # a short frame of another drive says nothing of these
            shortest = min(int(lengths.min()), CLASSIC_BYTES)
        return FrameBatch(
            self.keys[cut], self.data[cut], lengths, shortest, self.stamp_s[cut], self.host_s, self.wall_s, whole
        )


def batch_of(messages: Sequence[can.Message], host_s: float, wall_s: float) -> FrameBatch:
    """python-can messages (data frames, at least one) as arrays; for the clocks see `FrameBatch`."""
    n = len(messages)
    payloads = [m.data for m in messages]
    shortest, longest = min(map(len, payloads)), max(map(len, payloads))
    if shortest == longest == CLASSIC_BYTES:
        width, joined = CLASSIC_BYTES, b"".join(payloads)
        lengths = np.full(n, CLASSIC_BYTES)
    else:
        width = CLASSIC_BYTES if longest <= CLASSIC_BYTES else FD_BYTES
        lengths = np.array([min(len(p), width) for p in payloads])
        joined = b"".join([bytes(p[:width]).ljust(width, b"\0") for p in payloads])
    return FrameBatch(
        keys=np.array(
            [m.arbitration_id | EXTENDED if m.is_extended_id else m.arbitration_id for m in messages], np.int64
        ),
        data=np.frombuffer(joined, np.uint8).reshape(n, width),
        lengths=lengths,
        shortest=min(shortest, CLASSIC_BYTES),
        stamp_s=np.array([m.timestamp for m in messages], np.float64),
        host_s=host_s,
        wall_s=wall_s,
    )


@dataclass(frozen=True, slots=True)
class Field:
    """Where one signal sits in the frames of one identifier, and how its bits become a number.

    Attributes:
        key: identifier of its message, see `frame_key`.
        name: "Message.Signal".
        message_bytes: a frame shorter than this is no frame of the message.
        first_byte: of the eight-byte window that holds the signal.
        shift: bits below the signal in that window, read in the signal's byte order.
        length: bits.
        scale, offset: physical = raw × scale + offset.
        selected_by: multiplexers, outermost first: the signal is there only where each one's raw value is among
            the given.
    """

    key: int
    name: str
    message_bytes: int
    first_byte: int
    shift: int
    length: int
    big_endian: bool
    signed: bool
    is_float: bool
    scale: float
    offset: float
    selected_by: tuple[tuple[Field, tuple[int, ...]], ...] = ()

    def raw(self, data: U8) -> NDArray[np.generic]:
        """Raw values, shape (n,): int64 if signed, uint64 if not, float64 for an IEEE 754 signal.

        Args:
            data: shape (n, w), frames of this identifier with w >= first_byte + 8.
        """
        window = np.ascontiguousarray(data[:, self.first_byte : self.first_byte + 8])
        word = window.view(">u8" if self.big_endian else "<u8")[:, 0].astype(np.uint64, copy=False)
        unused = 64 - self.length
        if self.is_float:
            bits = (word >> np.uint64(self.shift)).astype(f"u{self.length // 8}")
            return bits.view(f"f{self.length // 8}").astype(np.float64)
        top_aligned = word << np.uint64(unused - self.shift)
        if self.signed:
            return top_aligned.view(np.int64) >> np.int64(unused)  # arithmetic shift: extends the sign
        return top_aligned >> np.uint64(unused)

    def physical(self, data: U8) -> F64:
        """Values in the DBC's unit, shape (n,)."""
        with np.errstate(over="ignore", invalid="ignore"):  # an IEEE 754 signal may carry anything
            return self.raw(data).astype(np.float64) * self.scale + self.offset

    def present(self, data: U8) -> Bits:
        """Where the multiplexers select this signal, shape (n,)."""
        there = np.ones(data.shape[0], np.bool_)
        for multiplexer, values in self.selected_by:
            there &= np.isin(multiplexer.raw(data), np.array(values, np.uint64))
        return there


def load_dbc(path: Path) -> Database:
    """A DBC (or another format cantools reads) from a file.

    Raises:
        DriverConfigError: the file is missing, unreadable or no CAN database; the text names it.
    """
    import cantools
    from cantools.database.can import Database

    try:
        database = cantools.database.load_file(path)
    except OSError as error:
        raise DriverConfigError(f"{path}: cannot be read: {error.strerror or error}") from error
    except Exception as error:  # the parsers raise whatever the text makes them stumble over
        reason = " ".join(str(error).split())
        raise DriverConfigError(f"{path}: not a CAN database cantools can read: {reason}") from error
    if not isinstance(database, Database):
        raise DriverConfigError(f"{path}: holds diagnostics (CDD), not CAN messages")
    if not database.messages:
        raise DriverConfigError(f"{path}: holds no CAN message")
    return database


def find_field(database: Database, name: str, where: str) -> Field:
    """The signal "Message.Signal" of a database.

    Args:
        where: what asks for it, for messages ("axis.dbc: current_A").

    Raises:
        DriverConfigError: no such message or signal (the text lists those there are), or a signal that cannot be
            read in blocks.
    """
    message_name, dot, signal_name = name.partition(".")
    if not dot or not message_name or not signal_name:
        raise DriverConfigError(f'{where}: {name!r} is not of the form "Message.Signal"')
    messages = {m.name: m for m in database.messages}
    if message_name not in messages:
        raise DriverConfigError(
            f"{where}: no signal '{name}': there is no message '{message_name}', only {_listed(messages)}"
        )
    message = messages[message_name]
    signals = {s.name: s for s in message.signals}
    if signal_name not in signals:
        raise DriverConfigError(f"{where}: no signal '{name}': '{message_name}' has {_listed(signals)}")
    return _field(message, signals, signals[signal_name], where)


def _listed(names: dict[str, Any]) -> str:
    shown = sorted(names)
    more = f" and {len(shown) - 20} more" if len(shown) > 20 else ""
    return ", ".join(shown[:20]) + more if shown else "none"


def _field(message: Message, signals: dict[str, Signal], signal: Signal, where: str) -> Field:
    """The place of a cantools signal.

    DBC bit numbers count each byte from its least significant bit; `start` is the least significant bit of a
    little-endian signal and the most significant one of a big-endian signal.
    """
    name = f"{message.name}.{signal.name}"
    big = signal.byte_order == "big_endian"
    width = CLASSIC_BYTES if message.length <= CLASSIC_BYTES else FD_BYTES
    first_byte = min(signal.start // 8, width - 8)
    bits_before = signal.start - 8 * first_byte
    if big:
        bits_before += 7 - 2 * (signal.start % 8)  # counted from the top of the window instead
    shift = 64 - bits_before - signal.length if big else bits_before
    if message.length > FD_BYTES:
        raise DriverConfigError(f"{where}: {name} is in a message of {message.length} bytes; CAN FD ends at {FD_BYTES}")
    if shift < 0 or shift + signal.length > 64:
        raise DriverConfigError(f"{where}: {name} spreads over nine bytes, which is not supported")
    if signal.is_float and signal.length not in (16, 32, 64):
        raise DriverConfigError(f"{where}: {name} is a {signal.length}-bit float; IEEE 754 has 16, 32 and 64")
    scale, offset = float(signal.scale), float(signal.offset)
    if not (math.isfinite(scale) and math.isfinite(offset) and scale):
        raise DriverConfigError(
            f"{where}: {name} has scale {scale:g} and offset {offset:g}, which leave no value of it"
        )
    return Field(
        key=frame_key(message.frame_id, message.is_extended_frame),
        name=name,
        message_bytes=message.length,
        first_byte=first_byte,
        shift=shift,
        length=signal.length,
        big_endian=big,
        signed=signal.is_signed,
        is_float=signal.is_float,
        scale=scale,
        offset=offset,
        selected_by=_multiplexers(message, signals, signal, where),
    )


def _multiplexers(
    message: Message, signals: dict[str, Signal], signal: Signal, where: str
) -> tuple[tuple[Field, tuple[int, ...]], ...]:
    if signal.multiplexer_signal is None or signal.multiplexer_ids is None:
        return ()
    selector = _field(message, signals, signals[signal.multiplexer_signal], where)
    return (*selector.selected_by, (selector, tuple(signal.multiplexer_ids)))
