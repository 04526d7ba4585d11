"""What is done with one drive's captures: the documents of `fit` and `diagnose`, made on a worker of the cluster."""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from servo_daemon.errors import BadInputError, ServoDaemonError
from servo_daemon.fleet.units import Unit, filesystem_of

_Work = Callable[[Sequence[Path], tuple[str, ...]], dict[str, Any]]


def fit_unit(unit: Unit, flags: tuple[str, ...]) -> dict[str, Any]:
    """All captures of a drive fitted together, and each alone where there are several.

    Args:
        flags: of `servo-daemon fit`, without captures.

    Returns:
        drive, seconds and fit, each (a document and a capture, or None), or error.
    """
    return _told(unit, flags, _fitted)


def diagnose_unit(unit: Unit, flags: tuple[str, ...]) -> dict[str, Any]:
    """The same for `servo-daemon diagnose`: its document stands under `diagnosis`, its final model under `fit`."""
    return _told(unit, flags, _diagnosed)


def _told(unit: Unit, flags: tuple[str, ...], work: _Work) -> dict[str, Any]:
    """With what went wrong, in words; only what is wrong with the input is caught."""
    began = time.perf_counter()
    document: dict[str, Any]
    try:
        with _local(unit.captures) as paths, contextlib.redirect_stderr(io.StringIO()):
            different, called = _different(paths), dict(zip(paths, unit.captures, strict=True))
            document, unread = _of_readable(list(different.values()), flags, work)
            document["digests"] = [digest for digest, path in different.items() if path not in unread]
            if repeated := [c for path, c in called.items() if path not in different.values()]:
                document["repeated"] = repeated
            if unread:
                document["unread"] = [text.replace(str(path), called[path]) for path, text in unread.items()]
    except ServoDaemonError as error:
        document = {"error": str(error)}
    return {"drive": unit.name, "captures": list(unit.captures), "seconds": time.perf_counter() - began, **document}


def _of_readable(
    paths: list[Path], flags: tuple[str, ...], work: _Work
) -> tuple[dict[str, Any], dict[Path, str]]:  # fmt: skip
    """What came of the captures that can be read, and what is wrong with each of the others: a file that is broken
    costs a drive no other."""
    try:
        return work(paths, flags), {}
    except BadInputError:
        unread = _unread(paths, flags)
        if not unread or len(unread) == len(paths):
            raise
    return work([path for path in paths if path not in unread], flags), unread


def _unread(paths: Sequence[Path], flags: tuple[str, ...]) -> dict[Path, str]:
    from servo_daemon.commands.diagnose.command import add_arguments
    from servo_daemon.commands.shared import common

    parser, unread = argparse.ArgumentParser(add_help=False), {}
    add_arguments(parser)  # of all that `fit` is told, and --budget
    for path in paths:
        try:
            common.read_captures([path], parser.parse_args([str(path), *flags]))
        except BadInputError as error:
            unread[path] = str(error)
    return unread


@contextmanager
def _local(captures: Sequence[str]) -> Iterator[list[Path]]:
    """Paths of this machine; what lies elsewhere is fetched for as long as it is needed."""
    if not any("://" in c for c in captures):
        yield [Path(c) for c in captures]
        return
    with tempfile.TemporaryDirectory(prefix="servo-fleet-") as folder:
        paths = []
        for k, url in enumerate(captures):
            fs, remote = filesystem_of(url)
            path = Path(folder) / f"{k:04d}-{Path(remote).name}"
            try:
                fs.get_file(remote, str(path))
            except OSError as error:
                raise BadInputError(f"{url}: cannot be read: {error}") from error
            paths.append(path)
        yield paths


def _different(paths: Sequence[Path]) -> dict[str, Path]:
    """By its content the first of each: a capture that is there twice would be believed twice.

    Raises:
        BadInputError: one cannot be read.
    """
    out: dict[str, Path] = {}
    for path in paths:
        try:
            with path.open("rb") as file:
                out.setdefault(hashlib.file_digest(file, "sha256").hexdigest(), path)
        except OSError as error:
            raise BadInputError(f"{path}: {error.strerror or error}") from error
    return out


def _fitted(paths: Sequence[Path], flags: Sequence[str]) -> dict[str, Any]:
    from servo_daemon.commands.fit.command import add_arguments
    from servo_daemon.commands.fit.fitting import fitted

    parser = argparse.ArgumentParser(add_help=False)
    add_arguments(parser)

    def fit(chosen: Sequence[Path]) -> dict[str, Any]:
        arguments = parser.parse_args([*map(str, chosen), *flags])
        return fitted(arguments).document

    each: list[dict[str, Any] | None] = []
    for path in paths if len(paths) > 1 else ():
        try:
            each.append(fit([path]))
        except ServoDaemonError:  # too short alone; beside the others it may still tell something
            each.append(None)
    return {"fit": fit(paths), "each": each}


def _diagnosed(paths: Sequence[Path], flags: Sequence[str]) -> dict[str, Any]:
    from servo_daemon.commands.diagnose.command import add_arguments
    from servo_daemon.commands.diagnose.diagnosing import diagnosed

    parser = argparse.ArgumentParser(add_help=False)
    add_arguments(parser)
    document = diagnosed(parser.parse_args([*map(str, paths), *flags])).document
    final = document["extended"] or document["baseline"]
    return {"diagnosis": document, "fit": final, "each": []}
