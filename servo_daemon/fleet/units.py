"""Which drives there are, and which captures belong to each."""

from __future__ import annotations

import hashlib
import importlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from servo_daemon.errors import BadInputError, ServoDaemonError

#: Endings of what `read_capture` reads; a folder may hold other files as well.
ENDINGS = (".csv", ".txt", ".log", ".tsv", ".jsonl", ".parquet", ".mat", ".mf4", ".xlsx", ".blf", ".asc", ".mcap")


@dataclass(frozen=True, slots=True)
class Unit:
    """One drive: its name, its captures (paths or URLs, sorted), and what each of them changes with: its size in bytes
    and, where it is known, when it was written."""

    name: str
    captures: tuple[str, ...]
    versions: tuple[str, ...]

    def key(self, asked: str) -> str:
        """The same for the same captures and the same question (`asked`), and for no other."""
        text = "\n".join([asked, self.name, *self.captures, *self.versions])
        return hashlib.blake2b(text.encode(), digest_size=12).hexdigest()


def find_units(places: Sequence[str], drive_from: str | None = None) -> tuple[Unit, ...]:
    """The drives of files, folders and URLs.

    A sub-folder that holds captures is a drive, named by its path; a capture that lies directly in a place that was
    given is a drive of its own.

    Args:
        places: files, folders or URLs (`s3://…`, `file://…`: whatever fsspec opens).
        drive_from: a regular expression; its first group, found in a capture's path, is its drive's name.

    Raises:
        BadInputError: nothing is there, or the expression is wrong or does not match.
        ServoDaemonError: a URL without fsspec.
    """
    pattern = _compiled(drive_from)
    found: dict[str, list[tuple[str, str]]] = {}
    for place in places:
        for path, name, version in _captures_of(place):
            found.setdefault(name if pattern is None else _named(pattern, path), []).append((path, version))
    units = []
    for name, several in sorted(found.items()):
        files = sorted(set(several))
        units.append(Unit(name, tuple(path for path, _ in files), tuple(version for _, version in files)))
    return tuple(units)


def _compiled(text: str | None) -> re.Pattern[str] | None:
    if text is None:
        return None
    try:
        pattern = re.compile(text)
    except re.error as error:
        raise BadInputError(f"--drive-from {text}: {error}") from error
    if pattern.groups < 1:
        raise BadInputError(f"--drive-from {text}: has no group: put the drive's name in parentheses")
    return pattern


def _named(pattern: re.Pattern[str], path: str) -> str:
    match = pattern.search(path)
    if match is None or not match.group(1):
        raise BadInputError(f"{path}: --drive-from {pattern.pattern} finds no drive's name in it")
    return match.group(1)


def _captures_of(place: str) -> Iterator[tuple[str, str, str]]:
    """Path, drive and version of the captures at a place."""
    if "://" in place:
        yield from _of_url(place)
        return
    root = Path(place)
    if root.is_file():
        yield place, _stem(root.name), _version_of(root)
        return
    if not root.is_dir():
        raise BadInputError(f"{place}: there is no such file or folder")
    yield from _in_folder(place, ((str(p), _version_of(p)) for p in root.rglob("*") if p.is_file()))


def _version_of(path: Path) -> str:
    stat = path.stat()
    return f"{stat.st_size} {stat.st_mtime_ns}"


#: Under these names file systems tell when a file was written, or which version of it this is.
_WRITTEN = ("ETag", "LastModified", "last_modified", "mtime", "created")


def _version_told(about: Mapping[str, Any]) -> str:
    written = next((about[key] for key in _WRITTEN if about.get(key)), "")
    return f"{int(about['size'])} {written}"


def _of_url(url: str) -> Iterator[tuple[str, str, str]]:
    fs, root = filesystem_of(url)
    try:
        if fs.isfile(root):
            yield fs.unstrip_protocol(root), _stem(PurePosixPath(root).name), _version_told(fs.info(root))
            return
        files = {path: _version_told(about) for path, about in fs.find(root, detail=True).items()}
    except OSError as error:
        raise BadInputError(f"{url}: cannot be read: {error}") from error
    for path, name, version in _in_folder(root, files.items(), url):
        yield fs.unstrip_protocol(path), name, version


def filesystem_of(url: str) -> tuple[Any, str]:
    """The file system of a URL and the path in it.

    Raises:
        ServoDaemonError: fsspec, or its part for this kind of URL, is not installed.
    """
    try:
        fs, path = importlib.import_module("fsspec.core").url_to_fs(url)
    except ImportError as error:
        raise ServoDaemonError(f"{url}: needs fsspec: pip install 'servo-daemon[dask]' ({error})") from error
    except (ValueError, OSError) as error:
        raise BadInputError(f"{url}: {error}") from error
    return fs, str(path)


def _in_folder(root: str, files: Iterable[tuple[str, str]], told: str | None = None) -> Iterator[tuple[str, str, str]]:
    """Raises BadInputError where no file of the folder is a capture by its name."""
    none = True
    for path, version in sorted(files):
        inside = PurePosixPath(path).relative_to(PurePosixPath(root))
        if _is_capture(inside.name):
            none = False
            folder = inside.parent.as_posix()
            yield path, _stem(inside.name) if folder == "." else folder, version
    if none:
        raise BadInputError(f"{told or root}: holds no capture ({', '.join(ENDINGS)})")


def _is_capture(name: str) -> bool:
    return not name.startswith(".") and name.removesuffix(".gz").lower().endswith(ENDINGS)


def _stem(name: str) -> str:
    plain = name.removesuffix(".gz")
    return plain[: -len(end)] if (end := PurePosixPath(plain).suffix) else plain
