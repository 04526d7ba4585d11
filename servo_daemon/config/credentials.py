"""Files that systemd hands to the service alone: `LoadCredential=NAME:/path`, `SetCredential=` and their like.

They stand in $CREDENTIALS_DIRECTORY, which only the service can read, whoever owns the original; systemd.exec(5).
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from servo_daemon.errors import ConfigError

PREFIX: Final = "credential:"
#: The credential that is `[api] tokens_file` where that is not set.
TOKENS: Final = "servo-daemon.tokens"


def file_of(text: str, key: str, environ: Mapping[str, str] = os.environ) -> Path:
    """The file of a key whose value may be `credential:NAME`.

    Raises:
        ConfigError: there is no such credential.
    """
    if not text.startswith(PREFIX):
        return Path(text)
    name, folder = text.removeprefix(PREFIX), environ.get("CREDENTIALS_DIRECTORY")
    if not folder:
        raise ConfigError(f'{key} = "{text}": there is no $CREDENTIALS_DIRECTORY: LoadCredential= of a systemd unit')
    path = Path(folder, name)
    if not name or path.parent != Path(folder) or not path.is_file():
        there = ", ".join(sorted(p.name for p in Path(folder).glob("*"))) or "none"
        raise ConfigError(f'{key} = "{text}": no such credential; there are: {there}')
    return path


def tokens_of(text: str | None) -> Path | None:
    """The file of `[api] tokens_file`; without one the credential `servo-daemon.tokens`, if there is one.

    Raises:
        ConfigError: see `file_of`.
    """
    if text is not None:
        return file_of(text, "[api] tokens_file")
    folder = os.environ.get("CREDENTIALS_DIRECTORY")
    path = None if not folder else Path(folder, TOKENS)
    return path if path is not None and path.is_file() else None
