"""A configuration as it is shown to people: as TOML, without secrets."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from typing import Any, Final

from servo_daemon.config.sections import Config

HIDDEN: Final = "***"
#: Keys of secrets, as MQTT brokers, webhooks and drivers of others call them; a file's name is none.
_SECRET: Final = re.compile(r"(.*_)?(password|passwd|secret|token|api_?key)", re.IGNORECASE)
_IN_ADDRESS: Final = re.compile(r"(?<=://)([^/?#\s@:]*):[^/?#\s]*@")
_IN_QUERY: Final = re.compile(r"([?&][^=&#\s]*(?:password|secret|token|key)[^=&#\s]*=)[^&#\s]*", re.IGNORECASE)
#: Whoever knows such an address may often post there: a webhook's path is its password.
_PATH: Final = re.compile(r"(https?://[^/?#\s]+/)[^\s]+")
_BARE: Final = re.compile(r"[A-Za-z0-9_-]+")


def shown(config: Config, *, defaults: bool = False) -> dict[str, Any]:
    """What was written, secrets hidden.

    Args:
        defaults: with what was not written, too, as far as it has a value.
    """
    written = config.model_dump(exclude_unset=not defaults, exclude_none=True, mode="json")
    return {key: hidden(key, value) for key, value in written.items()}


def hidden(key: str, value: Any) -> Any:
    """A value as it may be shown: a secret only as that there is one, an address without its password."""
    if isinstance(value, Mapping):
        return {k: hidden(str(k), v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [hidden(key, v) for v in value]
    if isinstance(value, str):
        if _SECRET.fullmatch(key) and value:
            return HIDDEN
        without = _PATH.sub(rf"\g<1>{HIDDEN}", value)
        return _IN_QUERY.sub(rf"\g<1>{HIDDEN}", _IN_ADDRESS.sub(rf"\g<1>:{HIDDEN}@", without))
    return value


def toml(document: Mapping[str, Any]) -> str:
    """As TOML: each table under a header of its own."""
    return "\n".join(_table(document, ())).strip() + "\n"


def _table(table: Mapping[str, Any], place: tuple[str, ...]) -> Iterator[str]:
    inner = {k: v for k, v in table.items() if isinstance(v, Mapping) or (not place and _is_tables(v))}
    yield from (f"{_key(k)} = {as_toml(v)}" for k, v in table.items() if k not in inner)
    for key, value in inner.items():
        here = (*place, key)
        name = ".".join(_key(part) for part in here)
        for one in [value] if isinstance(value, Mapping) else value:
            yield from ("", f"[{name}]" if one is value else f"[[{name}]]", *_table(one, here))


def _is_tables(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(v, Mapping) for v in value)


def _key(key: str) -> str:
    return key if _BARE.fullmatch(key) else as_toml(key)


def as_toml(value: Any) -> str:
    """A value as TOML, on one line."""
    if isinstance(value, Mapping):
        inner = ", ".join(f"{_key(k)} = {as_toml(v)}" for k, v in value.items() if v is not None)
        return f"{{ {inner} }}" if inner else "{}"
    if isinstance(value, list):
        return "[" + ", ".join(as_toml(v) for v in value) + "]"
    if isinstance(value, float):  # TOML has inf and nan, too
        return repr(value)
    # TOML's basic strings are JSON's, with one character more escaped.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
