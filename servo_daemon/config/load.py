"""From TOML and the environment to a checked `Config`; every complaint is one line that names the place."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from pydantic import ValidationError

from servo_daemon.config.files import FOLDER, ConfigFile, merge, origin, read_files
from servo_daemon.config.sections import Config
from servo_daemon.config_hints import did_you_mean, keys_at
from servo_daemon.errors import ConfigError


def load_config(path: Path | None, environ: Mapping[str, str] = os.environ) -> Config:
    """The configuration from a TOML file with `conf.d/*.toml` beside it (None: defaults) and the environment.

    Raises:
        ConfigError: unreadable, not TOML, unknown or impossible keys, no drive; one line naming the place.
    """
    data, files = ({}, ()) if path is None else merge(read_files(path))
    _apply_environment(data, environ)
    config = _checked(data, files or (ConfigFile("config", "", {}),))
    if path is not None and "drive" not in data:
        also = f" (nor in {FOLDER})" if len(files) > 1 else ""
        raise ConfigError(
            f'{path}: no [[drive]]{also}: add that line and below it driver = "serial", options = {{ port = "…" }}, or '
            'what `servo-daemon scan` prints (driver = "simulated" is a simulated motor)'
        )
    return config


def parse_config(data: Mapping[str, Any], source: str = "config", text: str = "") -> Config:
    """A checked configuration from already parsed TOML.

    Args:
        text: the TOML, to name lines of.

    Raises:
        ConfigError: with one line naming file and key.
    """
    return _checked(data, (ConfigFile(source, text, data),))


def _checked(data: Mapping[str, Any], files: Sequence[ConfigFile]) -> Config:
    try:
        return Config.model_validate(dict(data))
    except ValidationError as error:
        raise ConfigError(_explain(error, files)) from error


_UNKNOWN_KEY: Final = re.compile(r"unknown key '([^']+)'")


def _explain(error: ValidationError, files: Sequence[ConfigFile]) -> str:
    """Pydantic's first complaint as one line that names the place; a misspelt key before the one it leaves missing."""
    complaints = error.errors()
    first = next((e for e in complaints if e["type"] == "extra_forbidden"), complaints[0])
    file, place = origin(files, first["loc"])
    where = ".".join(str(part) for part in place) or "config"
    where = re.sub(r"\.(\d+)", lambda m: f"[{m[1]}]", where)
    if first["type"] == "extra_forbidden":
        told = file.line(place)
        return f"{file.name}: unknown key '{where}'{told}{did_you_mean(str(place[-1]), keys_at(Config, place))}"
    message = first["msg"].removeprefix("Value error, ")
    if unknown := _UNKNOWN_KEY.match(message):  # of a table whose keys are data: parameters, alarms
        message = unknown[0] + file.line((*place, unknown[1])) + message[unknown.end() :]
    if first["type"] == "tuple_type":  # TOML knows none
        message = "must be a list, [[drive]]" if where == "drive" else "must be a list, in brackets"
    more = len(complaints) - 1
    return f"{file.name}: {where}: {message}" + (f" (and {more} more)" if more else "")


def _apply_environment(data: dict[str, Any], environ: Mapping[str, str]) -> None:
    """Overrides from SERVO_DAEMON_<SECTION>_<KEY>; pydantic converts and checks them like the file's own."""
    for section, keys in (("api", ("host", "port")), ("storage", ("state_dir", "save_interval_s"))):
        for key in keys:
            value = environ.get(f"SERVO_DAEMON_{section.upper()}_{key.upper()}")
            if value is not None:
                table = data.setdefault(section, {})
                if isinstance(table, dict):
                    table[key] = value
    if (state_dir := environ.get("SERVO_DAEMON_STATE_DIR")) is not None and isinstance(
        table := data.setdefault("storage", {}), dict
    ):
        table["state_dir"] = state_dir
