"""The files of a configuration as one: the file that is named, and `conf.d/*.toml` beside it, sorted by name.

Tables are merged, lists of tables (`[[drive]]`) go on where those of the file before end, and of any other key the
later file's value counts, with a line in the log. Two drives of one name are an error.
"""

from __future__ import annotations

import logging
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from servo_daemon.config_hints import line_of
from servo_daemon.errors import ConfigError

log = logging.getLogger(__name__)

FOLDER: Final = "conf.d"
#: Of a drive without one; `DriveConfig.name`.
_UNNAMED: Final = "axis1"

Place = Sequence[str | int]


@dataclass(frozen=True, slots=True)
class ConfigFile:
    """One file.

    Attributes:
        name: for messages.
        first: of each list of tables, the number that this file's first one has among those of all files.
    """

    name: str
    text: str
    data: Mapping[str, Any]
    first: Mapping[str, int] = field(default_factory=dict)

    def inside(self, place: Place) -> Place | None:
        """A place of the whole configuration as one of this file; None: the file has nothing to say there."""
        if len(place) > 1 and isinstance(place[1], int) and (first := self.first.get(str(place[0]))) is not None:
            place = (place[0], place[1] - first, *place[2:])
        node: Any = self.data
        for part in place:
            if isinstance(part, int):
                node = node[part] if isinstance(node, list) and 0 <= part < len(node) else None
            else:
                node = node.get(part) if isinstance(node, Mapping) else None
            if node is None:
                return None
        return place

    def line(self, place: Place) -> str:
        """ ", line 3" of a place in this file; empty where it cannot be told."""
        number = line_of(self.text, place)
        return "" if number is None else f", line {number}"


def read_files(path: Path) -> tuple[ConfigFile, ...]:
    """The file and what is in `conf.d` beside it.

    Raises:
        ConfigError: one cannot be read or is not TOML.
    """
    folder = path.parent / FOLDER
    paths = [path, *sorted(folder.glob("*.toml"))]
    return tuple(ConfigFile(str(p), *_read(p)) for p in paths)


def _read(path: Path) -> tuple[str, dict[str, Any]]:
    try:
        text = path.read_text(encoding="utf-8-sig")
        return text, tomllib.loads(text)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not UTF-8 text: {error}") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from error
    except RecursionError:
        raise ConfigError(f"{path}: not valid TOML: brackets or braces are nested too deeply") from None


def merge(files: Sequence[ConfigFile]) -> tuple[dict[str, Any], tuple[ConfigFile, ...]]:
    """What the files say together, and each with its place in that.

    Raises:
        ConfigError: two drives have one name; both places are named.
    """
    whole: dict[str, Any] = {}
    placed: list[ConfigFile] = []
    for file in files:
        first = {key: len(_tables(whole.get(key))) for key, value in file.data.items() if _tables(value)}
        placed.append(ConfigFile(file.name, file.text, file.data, first))
        _add(whole, file.data, (), placed)
    _names_differ(whole, placed)
    return whole, tuple(placed)


def _tables(value: Any) -> list[Mapping[str, Any]]:
    return value if isinstance(value, list) and value and all(isinstance(v, Mapping) for v in value) else []


def _add(into: dict[str, Any], more: Mapping[str, Any], place: tuple[str, ...], files: Sequence[ConfigFile]) -> None:
    *before, this = files
    for key, value in more.items():
        here, old = (*place, key), into.get(key)
        if isinstance(value, Mapping) and isinstance(old, Mapping):
            _add(into[key], value, here, files)
        elif isinstance(value, Mapping):
            into[key] = {}
            _add(into[key], value, here, files[-1:])
        elif not place and _tables(value):
            into[key] = [*_tables(old), *value]
        else:
            if old is not None and old != value:
                whose = next(f for f in reversed(before) if f.inside(here) is not None)
                text = "%s%s: %s takes the place of that of %s%s"
                log.info(text, this.name, this.line(here), ".".join(here), whose.name, whose.line(here))
            into[key] = value


def _names_differ(whole: Mapping[str, Any], files: Sequence[ConfigFile]) -> None:
    seen: dict[Any, str] = {}
    for number, drive in enumerate(_tables(whole.get("drive"))):
        file, place = origin(files, ("drive", number))
        where, name = f"{file.name}{file.line(place)}", drive.get("name", _UNNAMED)
        if isinstance(name, str) and name in seen:
            raise ConfigError(f"{where}: two drives are named '{name}': the first is in {seen[name]}")
        seen[name if isinstance(name, str) else number] = where


def origin(files: Sequence[ConfigFile], place: Place) -> tuple[ConfigFile, Place]:
    """The file whose word counts at a place, and the place in it; the first one where none says anything."""
    for file in reversed(files):
        if (inside := file.inside(place)) is not None:
            return file, inside
    return files[0], place
