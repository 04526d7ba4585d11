"""The folder of kept captures: one file each, named by when and why, the oldest removed beyond the quota.

What is there is known by the names alone, so that nothing has to agree with anything else after a power failure.
"""

from __future__ import annotations

import importlib.util
import logging
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from servo_daemon.captures import CaptureWriter
from servo_daemon.errors import BusyError, ServoDaemonError
from servo_daemon.published.archive import KeptCapture
from servo_daemon.samples import SampleBlock

log = logging.getLogger(__name__)

#: 20261127T023001123Z-60000ms-alarm.parquet: first sample, how long, why.
_NAME: Final = re.compile(r"(?P<id>(?P<start>\d{8}T\d{9})Z-(?P<ms>\d{1,9})ms-(?P<kind>[a-z_]+))\.(parquet|csv\.gz)")
_START: Final = "%Y%m%dT%H%M%S"
#: Of a file that was being written when the process ended.
_UNFINISHED: Final = ".*.part"


class CaptureFolder:
    """The kept captures of all drives. `store` belongs to one thread; `of` may be called from any.

    Args:
        folder: has one folder a drive; made when the first capture is stored.
        quota_bytes: of all drives together.
    """

    def __init__(self, folder: Path, quota_bytes: float) -> None:
        self._folder, self._quota = folder, quota_bytes
        self._kept: dict[str, tuple[KeptCapture, ...]] = {}
        try:
            for path in folder.glob(f"*/{_UNFINISHED}"):
                path.unlink()
            found = [kept for path in folder.glob("*/*") if (kept := _of_file(path)) is not None]
        except OSError as error:
            log.warning("%s: cannot be read: %s", folder, error.strerror or error)
            found = []
        for kept in sorted(found, key=lambda k: k.id):
            self._kept[kept.drive] = (*self._kept.get(kept.drive, ()), kept)

    def of(self, drive: str) -> Sequence[KeptCapture]:
        """Those of that drive, oldest first."""
        return self._kept.get(drive, ())

    def store(
        self,
        drive: str,
        kind: str,
        start: float,
        end: float,
        blocks: Sequence[SampleBlock],
        metadata: Mapping[str, str],
    ) -> KeptCapture:
        """Write one, and remove the oldest beyond the quota: Parquet where pyarrow is installed, else gzipped CSV.

        Args:
            kind: of the event.
            start, end: UTC, seconds since the epoch.

        Raises:
            BusyError: no sample is a measurement.
            CaptureError: a drive's channels are no capture.
            ServoDaemonError: the disk refuses, or it alone is more than the quota.
        """
        ending = "parquet" if importlib.util.find_spec("pyarrow") else "csv.gz"
        path = self._folder / drive / f"{_name(start, end, kind)}.{ending}"
        try:
            path.parent.mkdir(mode=0o750, parents=True, exist_ok=True)
        except OSError as error:
            raise ServoDaemonError(f"{path.parent}: {error.strerror or error}") from error
        with CaptureWriter(path, metadata=metadata) as writer:
            for block in blocks:
                writer.write(block)
        kept = _of_file(path) if writer.samples else None
        if kept is None:
            raise BusyError("no sample of the recording is a measurement")
        self._kept[drive] = (*(k for k in self.of(drive) if k.id != kept.id), kept)
        self._make_room()
        if not path.exists():
            raise ServoDaemonError(f"{path}: {kept.size / 1e6:.1f} MB are more than [history] captures_quota_MB")
        return kept

    def _make_room(self) -> None:
        """Delete the oldest, whosever they are; also from the list where somebody else has deleted them."""
        kept = sorted((k for of in self._kept.values() for k in of), key=lambda k: k.start)
        size = sum(k.size for k in kept)
        for oldest in kept:
            if size <= self._quota:
                return
            size -= oldest.size
            try:
                oldest.path.unlink(missing_ok=True)
            except OSError as error:
                log.warning("%s: cannot be removed: %s", oldest.path, error.strerror or error)
            self._kept[oldest.drive] = tuple(k for k in self.of(oldest.drive) if k.id != oldest.id)


def _name(start: float, end: float, kind: str) -> str:
    ms = round(start * 1000)
    when = datetime.fromtimestamp(ms // 1000, UTC).strftime(_START)
    return f"{when}{ms % 1000:03d}Z-{max(0, round((end - start) * 1000))}ms-{kind}"


def _of_file(path: Path) -> KeptCapture | None:
    """What a file is by its name; None: none of ours."""
    match = _NAME.fullmatch(path.name)
    if match is None:
        return None
    try:
        start = datetime.strptime(match["start"][:-3], _START).replace(tzinfo=UTC).timestamp()
        size = path.stat().st_size
    except (ValueError, OSError):
        return None
    start += int(match["start"][-3:]) / 1000
    end = start + int(match["ms"]) / 1000
    return KeptCapture(match["id"], path.parent.name, match["kind"], start, end, size, path)
