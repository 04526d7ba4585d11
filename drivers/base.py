"""The contract every driver keeps: public methods here, `info` and three private hooks to fill in.

A driver knows samples and errors, nothing else: no estimator, no API, no reconnect policy. The daemon has one
reader thread a drive, which calls `open`, then `read` in a loop, and on `DriverDisconnectedError` closes, waits
(back-off) and opens again. A driver object survives any number of open/close cycles.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, ClassVar

from servo_daemon.errors import DriverDisconnectedError, DriverError
from servo_daemon.samples import SampleBlock
from servo_daemon.signal_meaning import SignalMeaning


@dataclass(frozen=True, slots=True)
class DriveInfo:
    """What a driver knows of the device behind it. None: not known (yet).

    `identity` names the device itself (drive id on the wire, serial number), so that persisted knowledge is not
    given to another motor. Resolutions are one least significant bit.
    """

    identity: str
    sample_period_s: float | None = None
    counts_per_rev: float | None = None
    current_lsb_A: float | None = None
    voltage_lsb_V: float | None = None
    channels: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class OnboardEstimates:
    """What a drive says of its motor's parameters that it estimates itself: `values` (value, 1 σ or None) by name, in
    SI units; `heard_s` on the host's monotonic clock."""

    status: str
    values: Mapping[str, tuple[float, float | None]]
    heard_s: float


@dataclass(slots=True)
class DriverCounters:
    """What happened on the line since the driver object was made. Only ever counts up; read by any thread."""

    samples: int = 0  # samples delivered by `read`
    frames: int = 0  # good frames
    samples_lost: int = 0  # missing in the device's own numbering
    samples_repeated: int = 0  # frames or samples seen twice, delivered once
    crc_errors: int = 0  # complete frames with a wrong checksum
    framing_errors: int = 0  # bytes that are no frame: half frames, garbage, wrong baud rate, CAN error frames
    unknown_frames: int = 0  # well-formed, but not ours (another drive's id, an unmapped CAN id)
    device_restarts: int = 0  # device time or sequence jumped back
    extra: dict[str, int] = field(default_factory=dict)  # counters only this kind of driver has


class Driver(ABC):
    """One drive's source of samples. Used as `with driver: ... driver.read(0.1)`, or `open`/`read`/`close`.

    Args:
        name: the drive's name in the configuration; for messages only.
        options: the `[drive.options]` table; a subclass validates it in its constructor and refuses unknown keys by
            name with `DriverConfigError`. The constructor touches no device.
    """

    #: The name in the configuration's `driver = "..."`.
    kind: ClassVar[str]

    def __init__(self, name: str, options: dict[str, Any]) -> None:
        self.name = name
        self.options = dict(options)
        self.counters = DriverCounters()
        self._is_open = False

    @classmethod
    def made(cls, name: str, options: dict[str, Any]) -> Driver:
        """A closed driver for these options; a drive that is reached in several ways chooses its class here.

        Raises:
            DriverConfigError: the options are wrong; the text names the drive and the option.
        """
        return cls(name, options)

    @property
    def is_open(self) -> bool:
        return self._is_open

    @property
    def can_wait(self) -> bool:
        """Whether samples that are not read yet wait without being lost (a file): then they are read no faster than
        they are worked off."""
        return False

    @property
    def is_buffered(self) -> bool:
        """Whether what arrives waits for some seconds without being lost, and `read(0)` takes all of it without
        waiting: then many of these can be read in turn by one thread."""
        return False

    @property
    def remark(self) -> str | None:
        """In words, what is wrong with what it hears, or lacks, whether samples come or not; None: nothing to say."""
        return None

    @property
    def unread(self) -> str | None:
        """In words, what came last of what cannot be read (`framing_errors`), and what would be; None: nothing, or
        no words."""
        return None

    @property
    def silence(self) -> str:
        """In words, what to look at where an open drive brings no samples."""
        return self.remark or self.unread or self._nothing_comes

    @property
    def _nothing_comes(self) -> str:
        if self.counters.framing_errors:
            return "what comes cannot be read: are the port, the baudrate and the kind of drive right?"
        if self.counters.unknown_frames:
            return "frames come, but none of this drive: is its number right, and does it send what is read?"
        return "nothing comes: is it switched on, and are port, baudrate and its number right?"

    @property
    def learnt(self) -> str | None:
        """In words, what it has found out of the drive that an option could have told; None: nothing."""
        return None

    @property
    def onboard(self) -> OnboardEstimates | None:
        """What the drive itself has estimated last; None: it does not, or has not yet."""
        return None

    @property
    def meaning(self) -> SignalMeaning | None:
        """What its voltage and current are, where the kind of drive decides it; blocks stay as the drive reports them.
        Keys of `[drive.signals]` stand above it. None: held voltage, a DC motor's."""
        return None

    @property
    @abstractmethod
    def info(self) -> DriveInfo:
        """What is known of the device now; more may be known after the first frames."""

    def open(self) -> None:
        """Open the device. Does nothing when it is open.

        Raises:
            DriverUnavailableError: it cannot be opened now; trying later may help.
            DriverConfigError: it can never be opened with these options.
        """
        if not self._is_open:
            self._open()
            self._is_open = True

    def read(self, timeout_s: float) -> SampleBlock | None:
        """The next samples: whatever has arrived, at least one; None if nothing came within `timeout_s`.

        Blocks for at most about `timeout_s` (0 polls). Never raises for bad bytes: those are counted in `counters`
        and the decoder resynchronises. Returns as soon as something is there; it does not wait for a full block.

        Raises:
            DriverError: the driver is not open.
            DriverDisconnectedError: the device went away; `close`, then `open` again.
            EndOfStreamError: a finite source has no more samples.
        """
        if not self._is_open:
            raise DriverError(f"drive {self.name}: read before open")
        block = self._read(timeout_s)
        if block is not None:
            self.counters.samples += len(block)
        return block

    def close(self) -> None:
        """Release the device. Idempotent, never raises, safe while another thread is inside `read`
        (that `read` then returns None or raises DriverDisconnectedError soon)."""
        if self._is_open:
            self._is_open = False
            self._close()

    def truth(self) -> dict[str, float] | None:
        """True parameter values at this moment, where a simulation knows them. For display only: the daemon hands
        them to the API and never to an estimator."""
        return None

    @abstractmethod
    def _open(self) -> None:
        """Hook: open the device, reset decoder state (a new attachment may be another device)."""

    @abstractmethod
    def _read(self, timeout_s: float) -> SampleBlock | None:
        """Hook of `read`: the samples that arrive within this time; None: none did."""

    @abstractmethod
    def _close(self) -> None:
        """Hook: release everything `_open` took; must not raise."""

    def __enter__(self) -> Driver:
        self.open()
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        self.close()


def disconnected(name: str, why: object) -> DriverDisconnectedError:
    """The one wording for a device that went away."""
    return DriverDisconnectedError(f"drive {name}: device went away: {why}")
