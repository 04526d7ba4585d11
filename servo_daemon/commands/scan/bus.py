"""What is on a CAN bus: the drives whose frames are heard, and of CANopen nodes what they answer."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from drivers.base import DriverCounters
from drivers.can.decode import EXTENDED
from drivers.can.listener import bus_settings
from drivers.can.ours.wire import DESCRIPTION_ID, FIRST_DRIVE, LAST_DRIVE, SAMPLE_ID
from drivers.can.port import CanPort, Inbox
from drivers.cia402.identity import PROFILE, options_of, read_identity
from drivers.mit import MODELS, robstride_keys, robstride_motor
from drivers.odrive.listening import ENCODER, HEARTBEAT, NODES
from drivers.odrive.listening import key_of as odrive_key
from drivers.vesc.listening import MESSAGES, STATUS_1
from drivers.vesc.listening import key_of as vesc_key
from servo_daemon.commands.scan.finding import Candidate
from servo_daemon.errors import BadInputError

#: Length and first byte of frames, by identifier (`frame_key`).
Traffic = Mapping[int, frozenset[tuple[int, int]]]

#: Ids that a drive of the own wire and a VESC can have, and the bytes of an ODrive's messages.
_OWN_DRIVES = range(FIRST_DRIVE, LAST_DRIVE + 1)
_VESC_IDS = range(256)
#: CiA 301: a node's heartbeat, one byte: its state, or 0 when it starts.
_CANOPEN_HEARTBEAT, _CANOPEN_STATES = 0x700, {0x00, 0x04, 0x05, 0x7F}
_ODRIVE_BYTES = 8
#: The master's identifier to which MIT mode actuators answer by default, and how long their frames are.
_MIT_REPLY, _MIT_BYTES = 0, (6, 8)


def bus_options(text: str, bitrate: int | None) -> dict[str, Any]:
    """Options of a bus given as interface:channel.

    Raises:
        BadInputError: it is not of that form.
    """
    interface, colon, name = text.partition(":")
    if not colon or not interface or not name:
        raise BadInputError(f"--can {text}: give it as interface:channel, such as socketcan:can0")
    return {"interface": interface, "channel": name} | ({} if bitrate is None else {"bitrate": bitrate})


def on_bus(options: dict[str, Any], seconds: float, ask: bool) -> list[Candidate | str]:
    """Drives whose frames are heard on a bus; a text: what is there of which nothing else is known.

    Args:
        ask: CANopen nodes that are heard are also asked what they are. Nobody else is asked: to another drive the
            identifier of such a read may be a command.

    Raises:
        DriverError: the bus cannot be opened.
        BadInputError: it goes away.
    """
    settings = bus_settings(options, "scan")
    try:
        traffic = _heard(settings, seconds)
        own = [
            n for n in _OWN_DRIVES if {SAMPLE_ID + n - FIRST_DRIVE, DESCRIPTION_ID + n - FIRST_DRIVE} <= set(traffic)
        ]
        if own:  # their 11-bit identifiers lie among those that others may have
            traffic = {key: shapes for key, shapes in traffic.items() if key & EXTENDED}
        vescs = [i for i in _VESC_IDS if vesc_key(STATUS_1, i) in traffic]
        return [
            *(Candidate("can", options | {"drive_id": n}) for n in own),
            *(Candidate("vesc", options | {"can_id": i}) for i in vescs),
            *(Candidate("odrive", options | {"node_id": n}) for n in _odrives(traffic)),
            *_actuators(options, traffic),
            *(_canopen(options, settings, n, ask) for n in _canopen_nodes(traffic)),
        ]
    except OSError as error:
        raise BadInputError(f"the bus went away: {error}") from error


def _odrives(traffic: Traffic) -> list[int]:
    def sends(key: int) -> bool:
        return any(length == _ODRIVE_BYTES for length, _ in traffic.get(key, ()))

    return [n for n in NODES if sends(odrive_key(n, ENCODER)) and sends(odrive_key(n, HEARTBEAT))]


def _actuators(options: dict[str, Any], traffic: Traffic) -> list[Candidate]:
    """MIT mode actuators: which model, and so how much a step of their codes is, no frame tells."""
    found = []
    standard = {first for length, first in traffic.get(_MIT_REPLY, ()) if length in _MIT_BYTES}
    robstride = {motor for key in traffic if (motor := robstride_motor(key)) is not None}
    for motors, layouts, some in ((standard, ("mit", "damiao"), "AK80-9"), (robstride, ("robstride",), "CyberGear")):
        models = ", ".join(name for name, limits in MODELS.items() if limits.layout in layouts)
        missing = {"model": f"one of {models}; or limits with layout (docs/drives.md)"}
        found += [Candidate("mit", options | {"motor_id": m}, False, {"model": some}, missing) for m in sorted(motors)]
    return found


def _canopen_nodes(traffic: Traffic) -> list[int]:
    beats = {(1, state) for state in _CANOPEN_STATES}
    return [n for n in range(1, 128) if traffic.get(_CANOPEN_HEARTBEAT + n, frozenset()) & beats]


def _canopen(options: dict[str, Any], settings: dict[str, Any], node_id: int, ask: bool) -> Candidate | str:
    where = f"{options['interface']}:{options['channel']}: CANopen node {node_id}"
    if not ask:
        return f"{where} sends its heartbeat; --ask also asks what it is"
    identity = read_identity(settings, node_id)
    profile = int(identity.get("device_type", 0.0)) & 0xFFFF
    if profile != PROFILE:
        return f"{where}: " + (f"its profile is {profile}, not CiA 402" if identity else "does not answer SDO reads")
    told = options_of(identity)
    if "counts_per_rev" not in told:
        return f"{where}: a CiA 402 drive that does not tell its encoder's counts (0x608F): give counts_per_rev"
    return Candidate("cia402", options | {"node_id": node_id} | told, asks=True)


def _heard(settings: dict[str, Any], seconds: float) -> Traffic:
    """What comes within so many seconds."""
    vescs = {vesc_key(message, i) for message in MESSAGES for i in _VESC_IDS}
    inbox = Inbox(frozenset(vescs | robstride_keys() | set(range(0x800))), DriverCounters())
    port = CanPort.attach(settings, inbox)
    heard: dict[int, frozenset[tuple[int, int]]] = {}
    try:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            batch = port.take(inbox, left, lambda: False)
            if batch is not None:
                for key, length, first in np.unique(
                    np.c_[batch.keys, batch.lengths, batch.data[:, 0]], axis=0
                ).tolist():
                    heard[key] = heard.get(key, frozenset()) | {(length, first)}
    finally:
        port.detach(inbox)
    return heard
