"""MDF measurement files (versions 2 to 4) by asammdf: each channel with the time stamps of its group."""

from __future__ import annotations

import gc
import logging
import sys
import traceback
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import numpy as np

from servo_daemon.captures.capture.bounded import check_cells
from servo_daemon.captures.capture.model import Capture, capture_error
from servo_daemon.captures.capture.read_options import ReadOptions
from servo_daemon.captures.columns.foreign import Series
from servo_daemon.captures.columns.held import HeldSignal
from servo_daemon.captures.columns.recording import assemble, parser_failed
from servo_daemon.captures.columns.signal_map import SignalMap, SignalRef
from servo_daemon.errors import ServoDaemonError
from servo_daemon.extras import require
from servo_daemon.samples import F64


class MdfRecording:
    """An open MDF file. Groups count from 0, as asammdf and its viewer number them."""

    kind: ClassVar[str] = "MDF files"
    options: ClassVar[tuple[str, ...]] = ("time_base",)
    timed: ClassVar[bool] = True
    metadata: ClassVar[Mapping[str, str]] = {}
    header_line: ClassVar[int | None] = None
    told: ClassVar[tuple[str, ...]] = ()

    def __init__(self, path: Path, file: Any) -> None:
        self.path, self._file = path, file
        self._masters = set(file.masters_db.items())
        self._clocks: dict[int, F64] = {}
        held = []
        cells = sum(int(group.channel_group.cycles_nr) * len(group.channels) for group in file.groups)
        check_cells(path, cells, 1)
        for number, group in enumerate(file.groups):
            for index, channel in enumerate(group.channels):
                if (number, index) not in self._masters:
                    samples = int(group.channel_group.cycles_nr)
                    held.append(HeldSignal(channel.name, f"{samples}, group {number}", _unit(channel)))
        self.held = tuple(held)

    def read(self, ref: SignalRef) -> Series:
        if ref.column is not None or ref.row is not None:
            raise capture_error(self.path, "an MDF channel has no 'column' or 'row'", column=ref.label)
        group, index = self._find(ref)
        signal = self._file.get(group=group, index=index)
        if signal.invalidation_bits is not None:
            signal = signal.validate()
        values = np.asarray(signal.samples)
        if values.ndim != 1 or values.dtype.kind not in "biuf":
            what = "text" if values.dtype.kind in "SU" else "arrays"
            raise capture_error(self.path, f"holds {what}, not numbers", column=ref.label)
        time_s = np.asarray(signal.timestamps, np.float64)
        # One array for each group: that its channels have the same time is then seen at once.
        known = self._clocks.setdefault(group, time_s)
        return Series(values.astype(np.float64), known if np.array_equal(known, time_s) else time_s)

    def place(self, index: int) -> str:
        return f"sample {index + 1}"

    def _find(self, ref: SignalRef) -> tuple[int, int]:
        """Group and channel number of a signal."""
        found = list(self._file.channels_db.get(ref.signal, ()))
        if not found:
            names = ", ".join(dict.fromkeys(signal.name for signal in self.held[:24])) or "none"
            raise capture_error(self.path, f"no such channel; there are {names}", column=ref.label)
        chosen = [place for place in found if ref.group in (None, place[0], self._group_name(place[0]))]
        if not chosen:
            places = ", ".join(self._group_text(group) for group, _ in found)
            raise capture_error(self.path, f"not in group {ref.group!r}, but in {places}", column=ref.label)
        if len(chosen) > 1:
            places = ", ".join(self._group_text(group) for group, _ in chosen)
            message = (
                f"the channel is in several groups ({places}): add  group = {chosen[0][0]}  to its line of the map"
            )
            raise capture_error(self.path, message, column=ref.label)
        group, index = chosen[0]
        return int(group), int(index)

    def _group_name(self, group: int) -> str:
        return str(getattr(self._file.groups[group].channel_group, "acq_name", None) or "")

    def _group_text(self, group: int) -> str:
        name = self._group_name(group)
        return f"{group} ({name})" if name else str(group)


def read_mdf(path: Path, raw: BinaryIO, signal_map: SignalMap | None, options: ReadOptions | None) -> Capture:
    """The capture in an open MDF file.

    Raises:
        CaptureError: damaged, or not usable; one line naming file, sample and channel.
        BadInputError: asammdf is not installed.
    """
    asammdf = require("asammdf", "asammdf", "mdf", f"{path}: MDF", "export CSV")
    with _quiet():
        try:
            with asammdf.MDF(raw) as file:
                return assemble(MdfRecording(path, file), signal_map, options)
        except ServoDaemonError:
            raise
        except Exception as error:  # the parser raises whatever the bytes make it stumble over, channels included
            failure = parser_failed(path, "MDF file", error)
            traceback.clear_frames(error.__traceback__)
        gc.collect()  # a half-made file complains when it goes, and is held by a cycle: here it goes unheard
    raise failure


@contextmanager
def _quiet() -> Iterator[None]:
    """Without asammdf's own log lines, and what its destructors raise on damaged files: an error is one line."""
    log, hook = logging.getLogger("asammdf"), sys.unraisablehook
    level = log.level
    log.setLevel(logging.CRITICAL + 1)
    sys.unraisablehook = lambda _: None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        sys.unraisablehook = hook
        log.setLevel(level)


def _unit(channel: Any) -> str:
    """The unit beside the channel or, as often, in its conversion."""
    unit = getattr(channel, "unit", "") or getattr(getattr(channel, "conversion", None), "unit", "")
    return str(unit or "")
