"""Our own captures in MCAP: a JSON message a sample, with its schema, on one topic a drive."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np

from servo_daemon import __version__
from servo_daemon.captures.formats.mcap import OURS
from servo_daemon.captures.formats.mcap.library import require_mcap
from servo_daemon.samples import F64, I64

_NS: Final = 1e9


def topic_of(drive: str) -> str:
    """Name of the topic of a drive's samples."""
    return f"/servo_daemon/{drive}"


class McapSink:
    """Columns into an open file.

    A message's log time is when its sample was taken by this machine's clock: the first block's last sample now, the
    others by the drive's own clock, which stands in `time_s`.

    Args:
        names: of the columns, `time_s` first.
    """

    def __init__(self, file: BinaryIO, names: Sequence[str], metadata: Mapping[str, str]) -> None:
        path = Path(getattr(file, "name", "capture"))
        self._writer = require_mcap(path, "writer").Writer(file)
        self._writer.start(profile="", library=f"servo-daemon {__version__}")
        properties = {name: {"type": "number"} for name in names}
        schema = {"title": OURS, "type": "object", "properties": properties, "required": list(names)}
        number = self._writer.register_schema(OURS, "jsonschema", json.dumps(schema).encode())
        topic = topic_of(metadata.get("drive", "axis1"))
        self._channel = self._writer.register_channel(topic, "json", number, dict(metadata))
        self._row = ("{" + ", ".join(f'"{name}": %r' for name in names) + "}").__mod__
        self._offset_ns: int | None = None
        self._sequence = 0

    def write(self, columns: Sequence[F64]) -> None:
        """Append equally long columns, in the order of the names."""
        time_ns: I64 = np.rint(columns[0] * _NS).astype(np.int64)
        if self._offset_ns is None:
            self._offset_ns = time.time_ns() - int(time_ns[-1])
        rows = zip(*(column.tolist() for column in columns), strict=True)
        for stamp, row in zip((time_ns + self._offset_ns).tolist(), rows, strict=True):
            self._writer.add_message(self._channel, stamp, self._row(row).encode(), stamp, self._sequence)
            self._sequence += 1

    def finish(self) -> None:
        """Write what is held back and the file's summary; the file itself stays open."""
        self._writer.finish()

    def abandon(self) -> None:
        """Nothing to release."""
