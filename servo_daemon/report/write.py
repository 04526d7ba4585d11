"""The report as a file, and where it says it comes from."""

from __future__ import annotations

import hashlib
import shlex
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from servo_daemon import __version__
from servo_daemon.errors import BadInputError
from servo_daemon.files import AtomicFile
from servo_daemon.report.document import CaptureFile, Provenance, Report
from servo_daemon.report.page import render_report


def make_provenance(
    arguments: Sequence[str], captures: Sequence[Path] = (), made: datetime | None = None
) -> Provenance:
    """This version of the program, called as `servo-daemon ARGUMENTS…` on these files, at `made` (None: now).

    Raises:
        BadInputError: a capture cannot be read.
    """
    found = []
    for path in captures:
        try:
            with path.open("rb") as file:
                found.append(CaptureFile(path.name, hashlib.file_digest(file, "sha256").hexdigest()))
        except OSError as error:
            raise BadInputError(f"{path}: cannot be read: {error.strerror or error}") from error
    command = shlex.join(["servo-daemon", *arguments])
    return Provenance(command, __version__, made or datetime.now(UTC), tuple(found))


def write_report(path: Path, report: Report) -> None:
    """Write the report as one HTML file, which has its name only when it is complete.

    Raises:
        BadInputError: the file cannot be created there.
        ServoDaemonError: the disk refuses.
        ValueError: see `render_report`.
    """
    content = render_report(report).encode()
    with AtomicFile(path) as output:
        output.write(content)
