"""Driver "can": a drive on a CAN bus, through python-can with any of its interfaces.

Two kinds of drive. Without `dbc`, one that sends our own frames (`servo.dbc`, docs/protocol-can.md). With `dbc` and
`signals`, another maker's, its signals mapped to channels. Several drives may share a bus; it is opened once.

    [drive.options]
    interface = "socketcan"      # or slcan, gs_usb, pcan, virtual, …
    channel = "can0"
    bitrate = 1_000_000          # where the interface sets it (socketcan: `ip link` does)
    drive_id = 1
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, ClassVar

from drivers.can.decode import load_dbc
from drivers.can.listener import FrameDecoder, needed_text
from drivers.can.map import COUNTS, parse_signal_map
from drivers.can.ours.own import OwnDecoder
from drivers.can.ours.wire import FIRST_DRIVE, LAST_DRIVE
from drivers.can.pace import PacedListener
from drivers.can.vendor import STALE_S, VendorDecoder
from servo_daemon.errors import DriverConfigError

_OWN_OPTIONS = ("drive_id", "counts_per_rev")
_VENDOR_OPTIONS = ("dbc", "signals", "trigger", "counts_per_rev", "period_s", "stale_s")


class CanDriver(PacedListener):
    """One drive on a CAN bus. Options: see docs/protocol-can.md.

    Raises:
        DriverConfigError: unknown or wrong options, a DBC that is missing, unreadable or without a mapped signal.
    """

    kind: ClassVar[str] = "can"

    def __init__(self, name: str, options: dict[str, Any]) -> None:
        own = "dbc" not in options and "signals" not in options
        super().__init__(name, options, _OWN_OPTIONS if own else _VENDOR_OPTIONS)
        self._decoder: FrameDecoder = self._own_decoder() if own else self._vendor_decoder()
        if isinstance(self._decoder, VendorDecoder):
            self._pace(self._decoder, self._decoder, frozenset({self._decoder.trigger.key}), self._positive("period_s"))

    @property
    def _frames(self) -> FrameDecoder:
        return self._paced or self._decoder

    # ---- options

    def _own_decoder(self) -> OwnDecoder:
        drive_id = self.options.get("drive_id", FIRST_DRIVE)
        if isinstance(drive_id, bool) or not isinstance(drive_id, int) or not FIRST_DRIVE <= drive_id <= LAST_DRIVE:
            raise DriverConfigError(
                f"{self._where}: drive_id must be a whole number {FIRST_DRIVE} .. {LAST_DRIVE}, not {drive_id!r}"
            )
        return OwnDecoder(drive_id, self.counters, self._counts_per_rev())

    def _vendor_decoder(self) -> VendorDecoder:
        for first, second in (("dbc", "signals"), ("signals", "dbc")):
            if first in self.options and second not in self.options:
                raise DriverConfigError(f"{self._where}: '{first}' needs '{second}' as well")
        path = Path(needed_text(self.options, "dbc", self._where)).expanduser()
        where = f"{self._where}: {path}"
        signals = parse_signal_map(self.options["signals"], load_dbc(path), where, self.options.get("trigger"))
        counts_per_rev = self._counts_per_rev()
        if signals.get(COUNTS) is not None and counts_per_rev is None:
            raise DriverConfigError(f"{self._where}: position_counts needs counts_per_rev")
        return VendorDecoder(
            signals,
            self.counters,
            counts_per_rev=counts_per_rev,
            period_s=self._positive("period_s"),
            stale_s=self._positive("stale_s") or STALE_S,
        )

    def _counts_per_rev(self) -> float | None:
        """Negative turns the direction round."""
        value = self.options.get("counts_per_rev")
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or not value:
            raise DriverConfigError(f"{self._where}: counts_per_rev must be a number other than 0, not {value!r}")
        return float(value)
