"""A file with named signals, whatever its format: what the readers of all formats offer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from servo_daemon.captures.columns.held import HeldSignal
from servo_daemon.captures.columns.signal_map import SignalRef
from servo_daemon.samples import F64


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """A signal read from a file: shape (n,), with time stamps of its own, shape (n,), or without."""

    values: F64
    time_s: F64 | None = None


class Recording(Protocol):
    """A file with named signals.

    Attributes:
        path: the file.
        kind: what it is, in words ("Excel sheets").
        metadata: what it says of itself.
        held: its signals.
        timed: they have time stamps of their own.
        options: the keys of a signal map it takes, beside `counts_per_rev`.
        header_line: of a text table, the line of its names.
        told: in words, what is unusual in how it is written.
    """

    @property
    def path(self) -> Path: ...
    @property
    def kind(self) -> str: ...
    @property
    def metadata(self) -> Mapping[str, str]: ...
    @property
    def held(self) -> Sequence[HeldSignal]: ...
    @property
    def timed(self) -> bool: ...
    @property
    def options(self) -> tuple[str, ...]: ...
    @property
    def header_line(self) -> int | None: ...
    @property
    def told(self) -> Sequence[str]: ...

    def read(self, ref: SignalRef) -> Series:
        """A signal.

        Raises:
            CaptureError: there is none of this name, or it holds no numbers.
        """

    def place(self, index: int) -> str:
        """Where in the file a sample is, for messages."""
