"""The `replay` driver: a capture delivered as if its drive were connected, at any speed.

Options: `path` (the capture), `speed` (1 = real time, 10 = ten times as fast, 0 or "max" = as fast as it is read),
`loop` (start over at the end), `block_samples` (samples delivered together, as a wire frame would).
"""

from __future__ import annotations

import bisect
import logging
import math
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from drivers.base import DriveInfo, Driver, disconnected
from servo_daemon.captures import Capture, read_capture
from servo_daemon.errors import BadInputError, DriverConfigError, DriverUnavailableError, EndOfStreamError
from servo_daemon.samples import Quality, SampleBlock
from servo_daemon.signal_meaning import SignalMeaning

log = logging.getLogger(__name__)

#: Block length without `block_samples`: about this much time in real time (100 reads a second cost next to nothing,
#: and 10 ms is far below what anyone sees) ...
_BLOCK_S = 0.010
#: ... and this many samples at full speed, where the cost of a block spreads over them. Also the most that one `read`
#: returns after a pause of the reader.
_BLOCK_MAX = 4096


@dataclass(frozen=True, slots=True)
class _Options:
    path: Path
    speed: float  # 0: as fast as it is read
    loop: bool
    block_samples: int | None


def _checked(drive: str, options: dict[str, Any]) -> _Options:
    def refuse(why: str) -> DriverConfigError:
        return DriverConfigError(f"drive {drive}: replay: {why}")

    known = ("path", "speed", "loop", "block_samples")
    for key in options:
        if key not in known:
            raise refuse(f"unknown option '{key}': known are {', '.join(known)}")
    path, speed = options.get("path"), options.get("speed", 1.0)
    loop, block_samples = options.get("loop", False), options.get("block_samples")
    if not isinstance(path, str | Path) or not str(path):
        raise refuse("option 'path' must name a capture")
    if speed == "max":
        speed = 0.0
    if isinstance(speed, bool) or not isinstance(speed, int | float) or not math.isfinite(speed) or speed < 0:
        raise refuse(f"option 'speed' must be a factor of real time, or 0 or \"max\" for full speed, not {speed!r}")
    if not isinstance(loop, bool):
        raise refuse(f"option 'loop' must be true or false, not {loop!r}")
    if block_samples is not None and (
        isinstance(block_samples, bool) or not isinstance(block_samples, int) or block_samples < 1
    ):
        raise refuse(f"option 'block_samples' must be a whole number from 1 on, not {block_samples!r}")
    return _Options(Path(path), float(speed), loop, block_samples)


def _block_length(options: _Options, sample_period_s: float) -> int:
    """Samples delivered together."""
    if options.block_samples is not None:
        wanted: float = options.block_samples
    elif options.speed > 0:
        wanted = _BLOCK_S * options.speed / sample_period_s
    else:
        wanted = _BLOCK_MAX
    return round(min(max(wanted, 1), _BLOCK_MAX))


class _Playback:
    """One attachment: the capture, its schedule on the host clock, and how far it has been delivered.

    A new lap continues time by one median period; its first sample is flagged as a restart after a gap, because the
    machine jumps from where the capture ends to where it begins. A block never crosses that seam.
    """

    def __init__(self, capture: Capture, options: _Options, *, restarted: bool) -> None:
        self.capture = capture
        self._whole = capture.block()
        self._speed = options.speed
        self._loop = options.loop
        self._per_block = _block_length(options, capture.sample_period_s)
        self._lap_s = capture.duration_s + capture.sample_period_s
        self._start_s = time.monotonic()
        self._lap = 0
        self._next = 0  # index of the first sample not delivered, within the lap
        self._restarted = restarted  # the first sample's time is earlier than what this driver delivered before
        self.ended = False

    def wait_s(self) -> float:
        """Seconds until the next block is due (the time of its last sample); not positive: it is."""
        if self._speed == 0:
            return 0.0
        last = min(self._next + self._per_block, len(self._whole)) - 1
        return self._due_s(last) - time.monotonic()

    def take(self) -> SampleBlock:
        """The due samples in whole blocks, at least the next one (call when `wait_s` is not positive)."""
        stop = min(self._next + self._per_block, len(self._whole))
        if self._speed > 0:
            stop = max(stop, self._due_stop())
        block = self._stamped(self._whole.slice(self._next, stop))
        self._next = stop
        if stop == len(self._whole):
            self._next, self._lap = 0, self._lap + 1
            self.ended = not self._loop
        return block

    def _due_s(self, index: int) -> float:
        """Host time at which a sample is due: from the start, so that lateness never adds up."""
        since_first = float(self._whole.time_s[index] - self._whole.time_s[0]) + self._lap * self._lap_s
        return self._start_s + since_first / self._speed

    def _due_stop(self) -> int:
        """End of the last block that is due by now, at most `_BLOCK_MAX` samples on."""
        n = len(self._whole)
        most = min(self._next + _BLOCK_MAX, n)
        now = time.monotonic()
        stop = bisect.bisect_right(range(n), now, self._next, most, key=self._due_s)
        return stop if stop == n else stop - (stop - self._next) % self._per_block

    def _stamped(self, block: SampleBlock) -> SampleBlock:
        """Host time, and from the second lap on the continued time and numbering."""
        n = len(self._whole)
        changes: dict[str, Any] = {"host_time_s": time.monotonic()}
        if self._lap:
            changes["time_s"] = block.time_s + self._lap * self._lap_s
            changes["sequence"] = block.sequence + self._lap * n
        if self._next == 0 and (self._lap or self._restarted):
            quality = block.quality.copy()
            quality[0] |= np.uint8(Quality.GAP_BEFORE | Quality.TIME_RESTART)
            changes["quality"] = quality
        return replace(block, **changes)


class ReplayDriver(Driver):
    """A capture as a drive. Opening reads the whole file; opening again starts it from the beginning."""

    kind: ClassVar[str] = "replay"

    def __init__(self, name: str, options: dict[str, Any]) -> None:
        super().__init__(name, options)
        self._options = _checked(name, options)
        self._playback: _Playback | None = None
        self._capture: Capture | None = None
        self._closing = threading.Event()

    @property
    def can_wait(self) -> bool:
        """At full speed; a capture that is played at a speed of its own is as a drive is."""
        return self._options.speed == 0

    @property
    def info(self) -> DriveInfo:
        """From the capture once it has been opened; metadata `identity` names the recorded device."""
        capture = self._capture
        if capture is None:
            return DriveInfo(identity=f"capture:{self._options.path.name}")
        return DriveInfo(
            identity=capture.metadata.get("identity", f"capture:{self._options.path.name}"),
            sample_period_s=capture.sample_period_s,
            counts_per_rev=capture.counts_per_rev,
            channels=capture.channels,
        )

    @property
    def meaning(self) -> SignalMeaning | None:
        """As the capture's own lines have it, once it has been opened."""
        return None if self._capture is None else self._capture.meaning()

    @property
    def capture(self) -> Capture | None:
        """The capture being played; None before the first `open`."""
        return self._capture

    def _open(self) -> None:
        path = self._options.path
        try:
            capture = read_capture(path)
        except BadInputError as error:
            if isinstance(error.__cause__, FileNotFoundError):  # it may still be recorded
                raise DriverUnavailableError(f"drive {self.name}: replay: {error}") from error
            raise DriverConfigError(f"drive {self.name}: replay: {error}") from error
        for note in capture.notes:
            log.info("drive %s: %s: %s", self.name, path, note)
        self._closing = threading.Event()
        self._capture = capture
        self._playback = _Playback(capture, self._options, restarted=self.counters.samples > 0)

    def _read(self, timeout_s: float) -> SampleBlock | None:
        playback, closing = self._playback, self._closing
        if playback is None or closing.is_set():
            raise disconnected(self.name, "it was closed")
        if playback.ended:
            raise EndOfStreamError(f"drive {self.name}: end of {self._options.path}")
        wait_s = playback.wait_s()
        if wait_s > 0:
            if closing.wait(min(wait_s, max(timeout_s, 0.0))):
                raise disconnected(self.name, "it was closed")
            if playback.wait_s() > 0:
                return None
        self.counters.frames += 1
        return playback.take()

    def _close(self) -> None:
        self._closing.set()
        self._playback = None
