"""Driver "cia402": a CANopen drive with the profile CiA 402.

Its transmit PDOs are listened to (`pdo` or `eds` says what they hold; with `sync_s` this driver sends the SYNC that
makes the drive send them); without them the objects are read by SDO. What is sent is SYNC, if it is asked for, and
those reads; the drive's set-up stays as it is.

    [drive.options]
    interface = "socketcan"
    channel = "can0"
    node_id = 5
    counts_per_rev = 8192
    rated_torque_Nm = 0.64       # object 0x6076, in mN·m there
    pdo = { "0x185" = ["statusword", "position", "torque"] }
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Sequence
from typing import Any, ClassVar

import can
import numpy as np

from drivers.base import DriveInfo, Driver
from drivers.can.map import COUNTS
from drivers.can.pace import PacedListener
from drivers.can.unwrap import WrappedPosition
from drivers.can.vendor import VendorDecoder
from drivers.cia402.objects import STANDARD, VOLTAGES, Object, Scales, pdo_map, usable
from drivers.cia402.options import OPTIONS, node_id_of, pdos_of, voltage_of
from drivers.cia402.sdo import ANSWER_ID, Uploads, upload
from drivers.polling.can_link import CanLink, Frame
from drivers.polling.driver import PollingDriver
from drivers.polling.link import Link
from drivers.polling.placing import Placing
from drivers.polling.poller import Answer, Pace
from servo_daemon.errors import DriverConfigError, DriverError
from servo_daemon.samples import CHANNELS, F64, Quality, SampleBlock
from servo_daemon.signal_meaning import SignalMeaning

#: SYNC (CiA 301): its default identifier, no data.
SYNC = Frame(0x80, b"")


def may_send(node_id: int, objects: Sequence[Object]) -> frozenset[Frame]:
    """Everything that may be put on the bus: SYNC, and reads of these objects."""
    return frozenset({SYNC, *(upload(node_id, o) for o in objects)})


class _Listening(PacedListener):
    """PDOs; with `sync_s` a thread sends SYNC."""

    kind = "cia402"

    def __init__(self, name: str, options: dict[str, Any]) -> None:
        super().__init__(name, options, OPTIONS)
        self.pdos = pdos_of(options, self._where)
        self._sync_s = self._positive("sync_s")
        counts = self._positive("counts_per_rev")
        period_s = self._positive("period_s") or self._sync_s
        decoder = None if self.pdos is None else pdo_map(self.pdos, self.scales, self._where)
        if decoder is not None:
            frames = VendorDecoder(decoder, self.counters, counts_per_rev=counts, period_s=period_s)
            self._pace(frames, frames, frozenset({frames.trigger.key}), period_s)
        self._stop = threading.Event()
        self._sender: threading.Thread | None = None

    @property
    def scales(self) -> Scales:
        return Scales(*(self._positive(key) for key in ("velocity_unit", "rated_current_A", "rated_torque_Nm")))

    def _open(self) -> None:
        super()._open()
        port = self._port
        if self._sync_s is not None and port is not None:
            period_s = self._sync_s
            self._stop = stop = threading.Event()

            def run() -> None:
                due_s = time.monotonic()
                while not stop.wait(max(0.0, due_s - time.monotonic())):
                    due_s = max(due_s + period_s, time.monotonic() - 1.0)
                    try:
                        port.send(can.Message(arbitration_id=SYNC.key, data=SYNC.data, is_extended_id=False))
                    except OSError:  # the receiving side tells that the bus is gone
                        self.counters.extra["sync_not_sent"] = self.counters.extra.get("sync_not_sent", 0) + 1

            self._sender = threading.Thread(target=run, name="canopen-sync", daemon=True)
            self._sender.start()

    def _close(self) -> None:
        sender, self._sender = self._sender, None
        self._stop.set()
        if sender is not None:
            sender.join()
        super()._close()


class _Asking(PollingDriver[float]):
    """Objects read by SDO; every round of them is a sample, at the time of its first request."""

    kind = "cia402"

    def __init__(self, checked: _Listening) -> None:
        super().__init__(checked.name, checked.options)
        self.counters, self._settings, where = checked.counters, checked._settings, f"drive {checked.name}"
        self._node_id = node_id_of(checked.options, where)
        self._counts_per_rev = checked._positive("counts_per_rev")
        self._rate_hz = checked._positive("rate_hz") or 100.0
        scales, voltage = checked.scales, voltage_of(checked.options, where)
        wanted = [STANDARD[n] for n in ("position", "torque", "current", "velocity")] + ([voltage] if voltage else [])
        self.objects = [o for o in wanted if scales.of(o) is not None]
        if {"torque_Nm", "current_A"} <= {o.channel for o in self.objects} and voltage is None:
            self.objects.remove(STANDARD["current"])  # the torque says more: it needs no torque constant
        usable([o.channel for o in self.objects], where)
        self._units = [scales.of(o) or 1.0 for o in self.objects]
        self._placing = Placing(self.counters)
        self._new_dialogue()

    @property
    def info(self) -> DriveInfo:
        channels = {"position_rad" if o.channel == COUNTS else o.channel for o in self.objects}
        return DriveInfo(
            f"cia402:{self._settings['interface']}:{self._settings.get('channel')}:{self._node_id}",
            sample_period_s=1.0 / self._rate_hz,
            counts_per_rev=self._counts_per_rev,
            channels=tuple(c for c in CHANNELS if c in channels),
        )

    @property
    def remark(self) -> str | None:
        if not self._uploads.refused:
            return None
        (index, sub), code = next(iter(self._uploads.refused.items()))
        return f"the drive refuses its object 0x{index:04X}:{sub:02X} (abort code 0x{code:08X})"

    @property
    def _pace(self) -> Pace:
        return Pace(self._rate_hz * len(self.objects))

    def _open_link(self) -> Link:
        try:
            return CanLink(self._settings, frozenset({ANSWER_ID + self._node_id}), self.counters)
        except DriverError as error:
            raise type(error)(f"drive {self.name}: {error}") from error

    def _new_dialogue(self) -> Uploads:
        self._placing.reopen()
        self._wrapped = WrappedPosition(math.ldexp(1.0, STANDARD["position"].bits))
        self._round: list[Answer[float]] = []
        self._uploads = Uploads(self._node_id, self.objects)
        return self._uploads

    def _samples(self, answers: list[Answer[float]]) -> SampleBlock | None:
        self.counters.frames += len(answers)
        strange, self._uploads.strange = self._uploads.strange, 0
        self.counters.framing_errors += strange
        n, firsts, rows = len(self.objects), [], []
        for a in answers:
            if a.number % n == 0:
                self._round = []
            self._round.append(a)
            if len(self._round) == n and self._round[0].number == a.number - n + 1:
                first = self._round[0]
                firsts.append(Answer(first.number // n, first.sent_s, a.received_s, 0.0))
                rows.append([r.value for r in self._round])
        if not rows:
            return None
        time_s, number, quality = self._placing.place(firsts)
        columns: dict[str, F64] = {}
        for thing, unit, value in zip(self.objects, self._units, np.array(rows).T, strict=True):
            if thing.channel == COUNTS:
                quality[~np.isfinite(value)] |= np.uint8(Quality.POSITION_INVALID)
                turn = 2.0 * math.pi / (self._counts_per_rev or 1.0)
                columns["position_rad"] = self._wrapped.unwrap(value) * turn
            else:
                invalid = Quality.VOLTAGE_INVALID if thing.channel == "voltage_V" else Quality.CURRENT_INVALID
                quality[~np.isfinite(value)] |= np.uint8(invalid)
                columns[thing.channel] = value * unit
        return SampleBlock(
            time_s, number, quality, firsts[-1].received_s,
            voltage_V=columns.get("voltage_V"), current_A=columns.get("current_A"), torque_Nm=columns.get("torque_Nm"),
            position_rad=columns.get("position_rad"), velocity_rad_s=columns.get("velocity_rad_s"),
        )  # fmt: skip


class Cia402Driver(Driver):
    """A CiA 402 drive. Options beside the bus's: see docs/drives.md.

    Raises:
        DriverConfigError: an option is unknown, missing or impossible.
    """

    kind: ClassVar[str] = "cia402"

    def __init__(self, name: str, options: dict[str, Any]) -> None:
        super().__init__(name, options)
        listening = _Listening(name, options)
        node_id_of(options, f"drive {name}")
        for key in ("rate_hz", "sync_s", "period_s"):
            listening._positive(key)
        if listening._positive("counts_per_rev") is None:
            raise DriverConfigError(f"drive {name}: counts_per_rev is needed: counts of 0x6064 for one turn")
        self._inner: _Listening | _Asking = _Asking(listening) if listening.pdos is None else listening
        self._voltage = voltage_of(options, f"drive {name}")
        self.counters = self._inner.counters

    @property
    def meaning(self) -> SignalMeaning | None:
        if self._voltage is None:
            return None
        q_axis = self._voltage == VOLTAGES["beckhoff_ax8000"]
        return SignalMeaning("instant", "instant", "dq" if q_axis else "dc")

    @property
    def info(self) -> DriveInfo:
        return self._inner.info

    @property
    def remark(self) -> str | None:
        return self._inner.remark

    @property
    def learnt(self) -> str | None:
        return self._inner.learnt

    def _open(self) -> None:
        self._inner.open()

    def _read(self, timeout_s: float) -> SampleBlock | None:
        return self._inner._read(timeout_s)

    def _close(self) -> None:
        self._inner.close()
