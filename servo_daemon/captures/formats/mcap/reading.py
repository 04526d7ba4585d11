"""Reads MCAP files: our own captures, objects in JSON, and ROS's JointState (CDR, JSON).

Our own channel is a table whose time is its `time_s`. Any other signal is called by its path in the message, behind its
topic where there are several, and has the times of its messages: of their header, else when they were logged.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, Final

import numpy as np

from servo_daemon.captures.capture.bounded import MAX_BYTES, MAX_OBJECTS, check_cells
from servo_daemon.captures.capture.model import MIN_SAMPLES, capture_error
from servo_daemon.captures.capture.read_options import ReadOptions
from servo_daemon.captures.columns.foreign import Series
from servo_daemon.captures.columns.held import HeldSignal, describe
from servo_daemon.captures.columns.recording import parser_failed
from servo_daemon.captures.columns.signal_map import SignalRef
from servo_daemon.captures.formats.mcap import OURS
from servo_daemon.captures.formats.mcap.joint_state import FIELDS, SCHEMAS, JointState, from_cdr, from_json
from servo_daemon.captures.formats.mcap.library import require_mcap
from servo_daemon.captures.formats.rows import Rows, numbers
from servo_daemon.errors import CaptureError
from servo_daemon.samples import F64

#: Of a record as it stands in the file, bytes; writers make chunks of 1 to 4 MB.
_LARGEST: Final = 256 << 20
#: What a JointState's fields are as columns of a capture (REP 103: radians, or metres of a sliding joint).
_ROTARY: Final = {"position": "position_rad", "velocity": "velocity_rad_s"}
_SLIDING: Final = {"position": "position_m", "velocity": "velocity_m_s"}
_EFFORTS: Final = {"current": "current_A", "torque": "torque_Nm", "force": "force_N"}


@dataclass(slots=True)
class _Channel:
    """The messages of one topic."""

    topic: str
    schema: str
    encoding: str
    metadata: Mapping[str, str]
    rows: Rows = field(default_factory=Rows)
    joints: dict[str, None] = field(default_factory=dict)  # in order; empty: no JointState

    @property
    def is_ours(self) -> bool:
        return self.schema == OURS and self.encoding == "json"

    def add(self, log_time_ns: int, data: bytes) -> int:
        """A message; how many numbers it holds.

        Raises:
            ValueError: it is not what its channel says.
        """
        state: JointState | None
        if self.encoding == "cdr":
            state = from_cdr(data)
        else:
            message = json.loads(data)
            if not isinstance(message, dict):
                return 0
            state = None if self.is_ours else from_json(message)
            if state is None and self.schema in SCHEMAS:  # one without a joint
                return 0
        if state is None:
            values, stamp_ns = dict(numbers(message, "")), log_time_ns
        else:
            values, stamp_ns = dict(state.numbers()), state.stamp_ns or log_time_ns
            self.joints |= dict.fromkeys(state.names)
        self.rows.add(stamp_ns, values)
        return len(values)


class McapRecording:
    """The signals of an MCAP file."""

    kind: ClassVar[str] = "MCAP files"
    options: ClassVar[tuple[str, ...]] = ("time_base",)
    header_line: ClassVar[int | None] = None

    def __init__(self, path: Path, channels: list[_Channel], options: ReadOptions | None, told: list[str]) -> None:
        self.path, self.told = path, told
        ours = [c for c in channels if c.is_ours]
        if options is None:  # a map may name any signal
            chosen = channels[0] if len(channels) == len(ours) == 1 else None
        else:
            chosen = _chosen(path, ours, options.joint) if ours else None
        self.timed = chosen is None
        self.metadata: Mapping[str, str] = {} if chosen is None else chosen.metadata
        self._sources: dict[str, tuple[_Channel, str]] = {}
        self._clocks: dict[int, tuple[np.ndarray[Any, Any], F64]] = {}
        used = channels if chosen is None else [chosen]
        self._first_ns = min(min(c.rows.numbers) for c in used)
        plain = {} if options is None else _plain_names(path, used, options)
        held = []
        for channel in used:
            for name, column in channel.rows.columns.items():
                whole = name if len(used) == 1 else f"{channel.topic}.{name}"
                self._sources[whole] = (channel, name)
                held.append(HeldSignal(whole, str(len(column)), plain=plain.get(name, name)))
        self.held = tuple(held)

    def read(self, ref: SignalRef) -> Series:
        source = self._sources.get(ref.signal)
        if source is None or ref.label != ref.signal:
            raise capture_error(self.path, f"no such signal; there are {describe(self.held)}", column=ref.label)
        channel, name = source
        values = np.array(channel.rows.columns[name])
        if not self.timed:
            return Series(values)
        order, time_s = self._clock(channel)
        values = values[order]
        there = np.isfinite(values)
        return Series(values, time_s) if there.all() else Series(values[there], time_s[there])

    def _clock(self, channel: _Channel) -> tuple[np.ndarray[Any, Any], F64]:
        """The order of its messages in time, and their times from the first of the file on, s: one array for all its
        signals."""
        known = self._clocks.get(id(channel))
        if known is None:
            stamps = np.array(channel.rows.numbers, np.int64)
            order = np.argsort(stamps, kind="stable")
            known = self._clocks[id(channel)] = (order, (stamps[order] - self._first_ns) / 1e9)
        return known

    def place(self, index: int) -> str:
        return f"message {index + 1}"


def _chosen(path: Path, ours: list[_Channel], name: str | None) -> _Channel:
    """The drive that is meant: the last part of its topic."""
    by_name = {c.topic.rpartition("/")[2]: c for c in ours}
    if name is None and len(by_name) == 1:
        return next(iter(by_name.values()))
    if name not in by_name:
        there = ", ".join(by_name)
        wrong = f"no drive {name!r}: it holds" if name else "several drives:"
        raise capture_error(path, f"{wrong} {there}: --joint says which")
    return by_name[name]


def _plain_names(path: Path, channels: list[_Channel], options: ReadOptions) -> dict[str, str]:
    """What the numbers of the joint that is meant are as columns of a capture."""
    joints = {joint: None for channel in channels for joint in channel.joints}
    if not joints:
        return {}
    joint = options.joint or (next(iter(joints)) if len(joints) == 1 else None)
    if joint not in joints:
        there = ", ".join(joints)
        wrong = f"no joint {joint!r}; there are" if joint else "several joints:"
        raise capture_error(path, f'{wrong} {there}: --joint NAME, or a signal map with "NAME.{FIELDS[0]}"')
    effort = f"{joint}.effort"
    if options.effort is None and any(effort in channel.rows.columns for channel in channels):
        raise capture_error(path, f"{effort} may be a current or a torque: --effort current|torque (or force)")
    columns = _SLIDING if options.effort == "force" else _ROTARY
    names = {f"{joint}.{name}": column for name, column in columns.items()}
    return names | ({effort: _EFFORTS[options.effort]} if options.effort else {})


def read_mcap(path: Path, raw: BinaryIO, options: ReadOptions | None) -> McapRecording:
    """The signals of an open MCAP file. One that is cut off is read as far as it is whole, and says so.

    Args:
        options: None: a signal map names the signals, and nothing is asked.

    Raises:
        CaptureError: damaged, nothing that could be read, or it has to be told what is meant.
        BadInputError: the library is not installed.
    """
    require_mcap(path, "stream_reader")
    channels: dict[int, _Channel] = {}
    passed_over: dict[str, None] = {}
    told = ["MCAP"]
    cells = 0
    try:
        for schema, channel, message in _messages(path, raw):
            name = "" if schema is None else schema.name
            mine = channels.get(channel.id)
            if mine is None:
                if not (channel.message_encoding == "json" or (channel.message_encoding == "cdr" and name in SCHEMAS)):
                    passed_over[f"{channel.topic} ({name or channel.message_encoding})"] = None
                    continue
                new = _Channel(channel.topic, name, channel.message_encoding, dict(channel.metadata))
                mine = channels[channel.id] = new
            try:
                cells += mine.add(message.log_time, message.data)
            except (ValueError, RecursionError) as error:
                where = f"{mine.topic}, message {len(mine.rows.numbers) + 1}"
                raise capture_error(path, f"{where}: {error}") from error
            check_cells(path, cells, 1, MAX_OBJECTS)
    except CaptureError:
        raise
    except Exception as error:  # the parser raises whatever the bytes make it stumble over
        if raw.read(1):
            raise parser_failed(path, "MCAP file", error) from error
        told.append("cut off: what came before is read")
    whole = [c for c in channels.values() if len(c.rows.numbers) >= MIN_SAMPLES and c.rows.columns]
    if not whole:
        there = f"; it holds {', '.join(passed_over)}" if passed_over else ""
        raise capture_error(path, f"no {MIN_SAMPLES} messages in JSON or of a JointState{there}")
    return McapRecording(path, whole, options, told)


def _messages(path: Path, raw: BinaryIO) -> Iterator[tuple[Any, Any, Any]]:
    """Schema, channel and message, in the order of the file; no chunk is unpacked that is too large."""
    stream, records = require_mcap(path, "stream_reader"), require_mcap(path, "records")
    schemas: dict[int, Any] = {}
    channels: dict[int, Any] = {}
    unpacked = 0
    reader = stream.StreamReader(raw, emit_chunks=True, record_size_limit=_LARGEST)
    for record in reader.records:
        if isinstance(record, records.Chunk):
            unpacked += record.uncompressed_size
            if unpacked > MAX_BYTES:
                raise capture_error(path, f"more than {MAX_BYTES >> 20} MB, unpacked: cut the capture up")
            inside = stream.breakup_chunk(_bounded(record), validate_crc=True)
        else:
            inside = [record]
        for one in inside:
            if isinstance(one, records.Schema):
                schemas[one.id] = one
            elif isinstance(one, records.Channel):
                channels[one.id] = one
            elif isinstance(one, records.Message):
                channel = channels[one.channel_id]
                yield schemas.get(channel.schema_id), channel, one


def _bounded(chunk: Any) -> Any:
    """A chunk that becomes no larger than it says, whatever its bytes hold.

    Raises:
        ValueError: it would.
    """
    if chunk.compression == "zstd":
        size = importlib.import_module("zstandard").frame_content_size(chunk.data)
        if size > chunk.uncompressed_size:
            raise ValueError(f"a chunk of {chunk.uncompressed_size} bytes that unpacks to {size}")
    elif chunk.compression == "lz4":
        unpacker = importlib.import_module("lz4.frame").LZ4FrameDecompressor()
        data = unpacker.decompress(chunk.data, max_length=chunk.uncompressed_size)
        if not unpacker.eof:
            raise ValueError(f"a chunk that is not {chunk.uncompressed_size} bytes, or cut off")
        return replace(chunk, compression="", data=data)
    return chunk
