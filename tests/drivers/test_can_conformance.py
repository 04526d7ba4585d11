"""The CAN driver passes the suite of all drivers: our own frames and another maker's on python-can's virtual bus, and
our own through python-can's slcan interface on a pseudo-terminal."""

from __future__ import annotations

import os
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import can
import pytest

from servo_daemon.sim_drive.can_frames import FrameEncoder
from tests.can_tools import RampSource, message_of, new_channel, slcan_drive
from tests.drivers.conformance import DriverConformance

VENDOR_DBC = """
VERSION ""
NS_ :
BS_:
BU_: X
BO_ 272 State: 8 X
 SG_ Counts : 7|24@0- (1,0) [0|0] "" X
 SG_ Micros : 24|32@1+ (1e-06,0) [0|0] "s" X
BO_ 273 Power: 4 X
 SG_ Current : 0|16@1- (0.01,0) [0|0] "A" X
 SG_ Duty : 16|16@1- (0.001,0) [0|0] "" X
"""
GROUP = 5


@contextmanager
def sending(channel: str, group: Callable[[], list[can.Message]]) -> Iterator[None]:
    """Sends what `group` returns on a virtual bus, every 5 ms."""
    stop = threading.Event()

    def send() -> None:
        with can.Bus(interface="virtual", channel=channel, ignore_config=True) as bus:
            start = time.monotonic()
            for k in range(10**9):
                for message in group():
                    bus.send(message)
                if stop.wait(max(0.0, start + (k + 1) * GROUP * 1e-3 - time.monotonic())):
                    return

    thread = threading.Thread(target=send, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(10)


class _Can(DriverConformance):
    kind = "can"

    @pytest.fixture
    def missing_options(self, tmp_path: Path) -> Iterator[dict[str, Any] | None]:
        yield {"interface": "slcan", "channel": str(tmp_path / "nothing")}


class TestOwnFramesOnAVirtualBus(_Can):
    wrong_types = {"drive_id": "1", "channel": 0.5, "bitrate": -1, "bus": [], "counts_per_rev": "4096"}  # noqa: RUF012

    @pytest.fixture
    def options(self) -> Iterator[dict[str, Any]]:
        channel, source = new_channel(), RampSource()
        encoder = FrameEncoder(source.info, 3)

        def group() -> list[can.Message]:
            return [message_of(f.frame_id, f.data) for f in encoder.encode(source.next_block(GROUP))]

        with sending(channel, group):
            yield {"interface": "virtual", "channel": channel, "drive_id": 3}

    @pytest.fixture
    def silent_options(self) -> Iterator[dict[str, Any] | None]:
        yield {"interface": "virtual", "channel": new_channel()}


class TestVendorFramesOnAVirtualBus(_Can):
    wrong_types = {"dbc": 1, "signals": "x", "trigger": 7, "period_s": "1 ms", "stale_s": True}  # noqa: RUF012

    @pytest.fixture
    def mapped(self, tmp_path: Path) -> dict[str, Any]:
        dbc = tmp_path / "vendor.dbc"
        dbc.write_text(VENDOR_DBC)
        return {
            "interface": "virtual",
            "channel": new_channel(),
            "dbc": str(dbc),
            "counts_per_rev": 4096,
            "period_s": 1e-3,
            "signals": {
                "position_counts": "State.Counts",
                "time_s": "State.Micros",
                "current_A": "Power.Current",
                "voltage_V": {"formula": "24 * Duty", "Duty": "Power.Duty"},
            },
        }

    @pytest.fixture
    def options(self, mapped: dict[str, Any]) -> Iterator[dict[str, Any]]:
        index = 0

        def group() -> list[can.Message]:
            nonlocal index
            messages = [message_of(273, struct.pack("<hh", 150, 500))]
            for k in range(index, index + GROUP):
                counts = (-7 * k) & 0xFFFFFF
                messages.append(message_of(272, counts.to_bytes(3, "big") + struct.pack("<IB", 1000 * k, 0)))
            index += GROUP
            return messages

        with sending(mapped["channel"], group):
            yield mapped

    @pytest.fixture
    def silent_options(self, mapped: dict[str, Any]) -> Iterator[dict[str, Any] | None]:
        yield mapped | {"channel": new_channel()}


@pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX")
class TestOwnFramesThroughSlcan(_Can):
    wrong_types = {"drive_id": 99, "channel": [], "bitrate": "fast"}  # noqa: RUF012

    @pytest.fixture
    def options(self, tmp_path: Path) -> Iterator[dict[str, Any]]:
        with slcan_drive(tmp_path / "can0"):
            yield {"interface": "slcan", "channel": str(tmp_path / "can0"), "bitrate": 1_000_000}

    @pytest.fixture
    def silent_options(self) -> Iterator[dict[str, Any] | None]:
        master, slave = os.openpty()
        yield {"interface": "slcan", "channel": os.ttyname(slave), "bitrate": 1_000_000}
        os.close(slave)
        os.close(master)
