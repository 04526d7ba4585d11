"""Where drives may be: serial ports and CAN buses, and what on them is worth a closer look."""

from __future__ import annotations

import time
from typing import Any

from drivers.base import DriverCounters
from drivers.can.ours.wire import DESCRIPTION_ID, FIRST_DRIVE, LAST_DRIVE, SAMPLE_ID
from drivers.can.port import CanPort, Inbox
from drivers.odrive.listening import ENCODER, HEARTBEAT, NODES
from drivers.odrive.listening import key_of as odrive_key
from drivers.vesc.listening import MESSAGES, STATUS_1, ListenedVesc
from drivers.vesc.listening import key_of as vesc_key
from servo_daemon.commands.scan.finding import Candidate
from servo_daemon.errors import BadInputError

_OWN_DRIVES = range(FIRST_DRIVE, LAST_DRIVE + 1)
_VESC_IDS = range(256)


def on_port(port: str, ask: bool) -> list[Candidate]:
    """Drives on a serial port: those that speak by themselves, and those that answer."""
    listening = [Candidate("serial", {"port": port})]
    asking = [Candidate("vesc", {"port": port}, asks=True), Candidate("odrive", {"port": port}, asks=True)]
    return [*listening, *(asking if ask else ())]


def bus_options(text: str, bitrate: int | None) -> dict[str, Any]:
    """Options of a bus given as interface:channel.

    Raises:
        BadInputError: it is not of that form.
    """
    interface, colon, name = text.partition(":")
    if not colon or not interface or not name:
        raise BadInputError(f"--can {text}: give it as interface:channel, such as socketcan:can0")
    return {"interface": interface, "channel": name} | ({} if bitrate is None else {"bitrate": bitrate})


def on_bus(options: dict[str, Any], seconds: float) -> list[Candidate]:
    """Drives whose frames are heard on a bus. Nothing is sent.

    Raises:
        DriverError: the bus cannot be opened, or goes away.
    """
    heard = _heard(options, seconds)
    own = [n for n in _OWN_DRIVES if {SAMPLE_ID + n - FIRST_DRIVE, DESCRIPTION_ID + n - FIRST_DRIVE} <= heard]
    if own:  # their 11-bit identifiers lie among those that an ODrive's nodes may have
        heard -= {key for key in heard if key < 0x800}
    vescs = [i for i in _VESC_IDS if vesc_key(STATUS_1, i) in heard]
    odrives = [n for n in NODES if {odrive_key(n, ENCODER), odrive_key(n, HEARTBEAT)} <= heard]
    return [
        *(Candidate("can", options | {"drive_id": n}) for n in own),
        *(Candidate("vesc", options | {"can_id": i}) for i in vescs),
        *(Candidate("odrive", options | {"node_id": n}) for n in odrives),
    ]


def _heard(options: dict[str, Any], seconds: float) -> set[int]:
    """Identifiers (`frame_key`) that come within so many seconds."""
    vescs = {vesc_key(message, i) for message in MESSAGES for i in _VESC_IDS}
    inbox = Inbox(frozenset(vescs | set(range(0x800))), DriverCounters())
    port = CanPort.attach(ListenedVesc("scan", options).settings, inbox)
    heard: set[int] = set()
    try:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            batch = port.take(inbox, left, lambda: False)
            if batch is not None:
                heard |= set(batch.keys.tolist())
    except ConnectionError as error:
        raise BadInputError(f"the bus went away: {error}") from error
    finally:
        port.detach(inbox)
    return heard
