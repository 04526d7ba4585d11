"""The capture in a CAN log, by the CAN driver's own decoders.

Without a map, or with one that has no `dbc`, the log is searched for our own frames (docs/protocol-can.md); with `dbc`
and `signals`, as in `[drive.options]` of a CAN drive, another maker's are decoded. The rule that makes samples of
frames is the driver's: each arrival of the trigger message is one, every other signal has the value it last had.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from drivers.base import DriverCounters
from drivers.can.decode import FrameBatch, frame_key, key_text, load_dbc
from drivers.can.map import COUNTS, parse_signal_map
from drivers.can.ours.own import OwnDecoder
from drivers.can.ours.wire import FIRST_DRIVE, LAST_DRIVE, SAMPLE_ID
from drivers.can.pace import LEAST, heard_pace, take, why_not
from drivers.can.vendor import STALE_S, VendorDecoder
from servo_daemon.captures.capture.layout import make_layout
from servo_daemon.captures.capture.model import (
    LINEAR_COLUMNS,
    MIN_SAMPLES,
    Capture,
    capture_error,
    first_bad_time,
    time_fault,
)
from servo_daemon.captures.columns.signal_map import SignalMap
from servo_daemon.captures.formats.can_log import CanLog
from servo_daemon.errors import ConfigError
from servo_daemon.samples import Quality, SampleBlock, concatenate

_OPTIONS = ("dbc", "counts_per_rev", "drive_id", "channel", "trigger", "period_s", "stale_s")
#: Frames are handed on in pieces this long, s, as a live bus does: the decoders' sense for silence rests on it.
_PIECE_S = 0.025
_INVALID = Quality.VOLTAGE_INVALID | Quality.CURRENT_INVALID | Quality.POSITION_INVALID

_HINT = (
    'give a map: --signals MAP.toml with  dbc = "drive.dbc"  and a line such as  '
    'signals = { position_rad = "Feedback.Angle", current_A = "Status.Current", voltage_V = "Status.Voltage" }'
)


def decode_log(log: CanLog, signal_map: SignalMap | None) -> Capture:
    """The capture in a CAN log.

    Raises:
        CaptureError: the frames make no capture; the text says which there are.
        ConfigError: the map or its DBC is wrong.
    """
    signal_map = signal_map or SignalMap(log.path)
    signal_map.only(_OPTIONS, "CAN logs")
    counters = DriverCounters()
    decoder = _decoder(log, signal_map, counters)
    frames = _of_one_channel(log, decoder.keys, signal_map)
    paced = _paced(decoder, log.path, frames, signal_map)
    with np.errstate(all="ignore"):
        blocks = [block for piece in _pieces(frames) for block in decoder.feed(piece)]
    if not blocks:
        raise capture_error(log.path, f"its frames make no sample ({_why_none(decoder)}); it holds {log.heard()}")
    if counters.device_restarts:
        after = next(i for i, block in enumerate(blocks) if block.quality[0] & Quality.TIME_RESTART)
        taken = sum(len(block) for block in blocks[:after])
        message = f"the drive restarted after {taken} samples: a capture cannot go on, cut the log there"
        raise capture_error(log.path, message)
    whole = concatenate(blocks)
    notes = [f"{len(whole)} samples from {counters.frames} frames; each signal has the value it last had"]
    notes += paced
    if counters.samples_lost:
        notes.append(f"{counters.samples_lost} samples are missing in the log")
    if counters.framing_errors:
        notes.append(f"{counters.framing_errors} frames are too short for their message and were passed over")
    info = decoder.info
    metadata = {"identity": info.identity}
    if info.counts_per_rev:
        metadata["counts_per_rev"] = f"{info.counts_per_rev:g}"
    return _checked(log.path, whole, signal_map, {**metadata, **signal_map.metadata}, notes)


def _paced(decoder: OwnDecoder | VendorDecoder, path: Path, frames: FrameBatch, signal_map: SignalMap) -> list[str]:
    """Where a log has its frames in bunches and the map no period: that is learnt, as by the driver; what is said.

    Raises:
        CaptureError: when the frames were sent is not known.
    """
    if not isinstance(decoder, VendorDecoder) or not decoder.dates_by_stamps or signal_map.positive("period_s"):
        return []
    stamp_s = frames.stamp_s[frames.keys == decoder.trigger.key]
    pace = heard_pace(stamp_s) if len(stamp_s) >= LEAST else None
    if pace is None or not pace.bunched:
        return []
    fault = why_not(decoder.trigger.name, pace, None)
    if fault is not None:
        raise capture_error(path, fault)
    return [take(decoder, pace)]


def _checked(
    path: Path, whole: SampleBlock, signal_map: SignalMap, metadata: dict[str, str], notes: list[str]
) -> Capture:
    """The samples that are measurements, as a capture."""
    linear = any(name in signal_map.signals for name in LINEAR_COLUMNS)
    if linear:
        metadata = {"axis": "linear", **metadata}
    names = {field: name for name, field in LINEAR_COLUMNS.items()} if linear else {}
    layout = make_layout(path, ["time_s", *(names.get(c, c) for c in whole.channels)], metadata)
    columns = {name: getattr(whole, name) for name in ("time_s", *whole.channels)}
    good = (whole.quality & int(_INVALID)) == 0
    for column in columns.values():
        good &= np.isfinite(column)
    n = int(np.count_nonzero(good))
    if n < MIN_SAMPLES:
        never = [name for name, column in columns.items() if not np.isfinite(column).any()]
        silent = f"; never heard: {', '.join(never)}" if never else ""
        raise capture_error(
            path, f"{n} of {len(whole)} samples are complete: at least {MIN_SAMPLES} are needed{silent}"
        )
    if n < len(whole):
        notes.append(f"{len(whole) - n} of {len(whole)} samples left out: a signal was not heard yet or too long ago")
        columns = {name: column[good] for name, column in columns.items()}
    bad = first_bad_time(columns["time_s"])
    if bad is not None:
        fault = time_fault(float(columns["time_s"][bad]), float(columns["time_s"][bad - 1]))
        raise capture_error(path, fault, place=f"sample {bad + 1}", column="time_s")
    return Capture(path, axis=layout.axis, metadata=metadata, notes=tuple(notes), **columns)


def _decoder(log: CanLog, signal_map: SignalMap, counters: DriverCounters) -> OwnDecoder | VendorDecoder:
    dbc = signal_map.text("dbc")
    if dbc is None and not signal_map.signals:
        for key in ("trigger", "period_s", "stale_s"):
            if key in signal_map.options:
                raise ConfigError(f"{signal_map.path}: {key} needs dbc and signals")
        return OwnDecoder(_drive_id(log, signal_map), counters, signal_map.counts_per_rev)
    if dbc is None or not signal_map.signals:
        given, missing = ("dbc", "[signals]") if dbc else ("[signals]", "dbc")
        raise ConfigError(f"{signal_map.path}: {given} needs {missing} as well, for a CAN log")
    if "drive_id" in signal_map.options:
        raise ConfigError(f"{signal_map.path}: drive_id is for our own frames, which need no dbc")
    database = signal_map.path.parent / Path(dbc).expanduser()
    table = {LINEAR_COLUMNS.get(name, name): entry for name, entry in signal_map.signals.items()}
    where = f"{signal_map.path}: {dbc}"
    signals = parse_signal_map(table, load_dbc(database), where, signal_map.text("trigger"))
    counts_per_rev = signal_map.counts_per_rev
    if signals.get(COUNTS) is not None and counts_per_rev is None:
        raise ConfigError(f"{signal_map.path}: position_counts needs counts_per_rev")
    return VendorDecoder(
        signals,
        counters,
        counts_per_rev=counts_per_rev,
        period_s=signal_map.positive("period_s"),
        stale_s=signal_map.positive("stale_s") or STALE_S,
    )


def _drive_id(log: CanLog, signal_map: SignalMap) -> int:
    """Which drive's frames of our own are meant: the map says, or there is only one."""
    there = {
        drive
        for drive in range(FIRST_DRIVE, LAST_DRIVE + 1)
        if (log.frames.keys == frame_key(SAMPLE_ID + drive - FIRST_DRIVE, extended=False)).any()
    }
    wanted = signal_map.options.get("drive_id")
    if wanted is not None:
        if isinstance(wanted, bool) or not isinstance(wanted, int) or wanted not in there:
            found = ", ".join(map(str, sorted(there))) or "none"
            raise ConfigError(f"{signal_map.path}: drive_id = {wanted!r}: drives with frames in {log.path}: {found}")
        return wanted
    if not there:
        raise capture_error(log.path, f"no frames of our own among {log.heard()}; {_HINT}")
    if len(there) > 1:
        drives = ", ".join(map(str, sorted(there)))
        raise capture_error(
            log.path, f"holds the frames of drives {drives}: say which in a map: drive_id = {min(there)}"
        )
    return there.pop()


def _of_one_channel(log: CanLog, keys: frozenset[int], signal_map: SignalMap) -> FrameBatch:
    """The frames the decoder wants, of one CAN channel: two may carry the same identifiers."""
    mine = np.isin(log.frames.keys, list(keys))
    channel = signal_map.options.get("channel")
    if channel is not None:
        if isinstance(channel, bool) or not isinstance(channel, int) or channel not in log.channels:
            there = ", ".join(str(c) for c in np.unique(log.channels))
            raise ConfigError(f"{signal_map.path}: channel = {channel!r}: the log has {there}")
        mine &= log.channels == channel
    if not mine.any():
        wanted = ", ".join(key_text(key) for key in sorted(keys))
        raise capture_error(log.path, f"none of the frames needed ({wanted}) among {log.heard()}")
    channels = np.unique(log.channels[mine])
    if len(channels) > 1:
        there = ", ".join(map(str, channels))
        raise capture_error(
            log.path, f"the frames are on channels {there}: say which in a map: channel = {channels[0]}"
        )
    frames = log.frames
    lengths = frames.lengths[mine]
    return FrameBatch(
        frames.keys[mine],
        frames.data[mine],
        lengths,
        min(frames.shortest, int(lengths.min())),
        frames.stamp_s[mine],
        frames.host_s,
        frames.wall_s,
    )


def _pieces(frames: FrameBatch) -> Iterator[FrameBatch]:
    """The frames as they would have arrived, `_PIECE_S` at a time."""
    stamp_s = frames.stamp_s
    start = 0
    while start < len(frames):
        stop = int(np.searchsorted(stamp_s, stamp_s[start] + _PIECE_S, side="right"))
        last_s = float(stamp_s[stop - 1])
        piece = frames.slice(start, stop)
        yield FrameBatch(piece.keys, piece.data, piece.lengths, piece.shortest, piece.stamp_s, last_s, last_s)
        start = stop


def _why_none(decoder: OwnDecoder | VendorDecoder) -> str:
    if isinstance(decoder, VendorDecoder):
        return f"the message that makes one, {decoder.info.identity.partition(':')[2]}, never came whole"
    return "no Sync or not all four pages of the Description came; see docs/protocol-can.md"
