"""What another configuration changes in a daemon that runs: at once, with a drive that begins again, at a restart."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal

from servo_daemon.config.drive_section import DriveConfig
from servo_daemon.config.sections import ApiConfig, Config
from servo_daemon.config.shown import as_toml, hidden

#: at once; the drive's estimation begins again, with what is saved of it; a drive that was not there; one that goes;
#: not before a restart.
How = Literal["now", "again", "new", "gone", "restart"]

_NOW: Final = frozenset(
    ("log.level", *(f"api.{k}" for k in ("tokens_file", "metrics", "allowed_hosts", "behind_proxy")))
)
_TLS: Final = frozenset(("api.certificate", "api.private_key"))
#: Of a drive: what is looked up when it is needed. Everything else is in its estimators from the start.
_SECTIONS_NOW: Final = ("limits", "controller", "commission")
_ESTIMATION_NOW: Final = ("adopt", "diagnose")
_LONGEST: Final = 80


@dataclass(frozen=True, slots=True)
class Change:
    """One key, or one drive.

    Attributes:
        drive: whose it is; None: the daemon's own.
        what: the key and both values in words, without secrets.
    """

    drive: str | None
    what: str
    how: How

    @property
    def text(self) -> str:
        """The change as one line for the user."""
        whose = "" if self.drive is None else f"drive {self.drive}: "
        after = {"again": " (the drive begins again)", "restart": ": needs a restart"}.get(self.how, "")
        return f"{whose}{self.what}{after}"


def changes(old: Config, new: Config) -> tuple[Change, ...]:
    """From one configuration to another."""
    found = []
    for key, what in _different(_without_drives(old), _without_drives(new)):
        at_once = key in _NOW or (key in _TLS and _has_tls(old.api) == _has_tls(new.api))
        found.append(Change(None, what, "now" if at_once else "restart"))
    before, after = ({d.name: d for d in config.drive} for config in (old, new))
    for name in before.keys() | after.keys():
        if name not in after:
            found.append(Change(name, "removed", "gone"))
        elif name not in before:
            found.append(Change(name, f"new, with driver {after[name].driver}", "new"))
        else:
            found += _of_drive(before[name], after[name])
    order = [None, *before, *after]
    return tuple(sorted(found, key=lambda change: order.index(change.drive)))


def drives_of(changed: Iterable[Change], how: How) -> frozenset[str]:
    """Those of which this is to be done."""
    return frozenset(c.drive for c in changed if c.how == how and c.drive is not None)


def _of_drive(old: DriveConfig, new: DriveConfig) -> Iterator[Change]:
    for key, what in _different(old.model_dump(mode="json"), new.model_dump(mode="json")):
        section, _, inner = key.partition(".")
        now = section in _SECTIONS_NOW or (section == "estimation" and inner in _ESTIMATION_NOW)
        yield Change(old.name, what, "now" if now else "again")


def at_work(old: Config, new: Config) -> Config:
    """The configuration that a daemon of `old` has after it has gone over to `new` without a restart."""
    api: dict[str, Any] = {"host": old.api.host, "port": old.api.port}
    if _has_tls(old.api) != _has_tls(new.api):
        api |= {"certificate": old.api.certificate, "private_key": old.api.private_key}
    kept = {name: getattr(old, name) for name in type(old).model_fields if name not in ("api", "log", "drive")}
    return new.model_copy(update={**kept, "api": new.api.model_copy(update=api)})


def looked_up(drive: DriveConfig, new: DriveConfig) -> DriveConfig:
    """A drive with what of another configuration counts at once; itself where nothing differs."""
    estimation = {key: getattr(new.estimation, key) for key in _ESTIMATION_NOW}
    update: dict[str, Any] = {name: getattr(new, name) for name in _SECTIONS_NOW}
    update["estimation"] = drive.estimation.model_copy(update=estimation)
    return drive if all(getattr(drive, k) == v for k, v in update.items()) else drive.model_copy(update=update)


def _has_tls(api: ApiConfig) -> bool:
    return api.certificate is not None


def _without_drives(config: Config) -> dict[str, Any]:
    return config.model_dump(mode="json", exclude={"drive"})


def _different(old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Keys, dotted, and what has become of each, in words."""
    before, after = dict(_leaves(old, "")), dict(_leaves(new, ""))
    for key in dict.fromkeys((*after, *before)):
        a, b = before.get(key), after.get(key)
        if a == b:
            continue
        if b is None:
            yield key, f"{key}: {_shown(key, a)} is no longer there"
        else:
            yield key, f"{key}: {'absent' if a is None else _shown(key, a)} → {_shown(key, b)}"


def _leaves(table: Mapping[str, Any], place: str) -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{place}{key}.")
        else:
            yield f"{place}{key}", value


def _shown(key: str, value: Any) -> str:
    text = as_toml(hidden(key.rpartition(".")[2], value))
    return text if len(text) <= _LONGEST else text[: _LONGEST - 1] + "…"
