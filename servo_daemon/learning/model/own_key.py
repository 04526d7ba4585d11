"""The key with which this installation marks the models that it has made (HMAC-SHA256, RFC 2104).

It lies in the state directory, readable by its owner alone. A file without the mark may be used where a person names
it, and is not picked up by itself.
"""

from __future__ import annotations

import hashlib
import hmac
import logging
import os
import secrets
import stat
from contextlib import suppress
from pathlib import Path

from servo_daemon.plant.compiler import cache_directory

log = logging.getLogger(__name__)

#: File of the key, and its length: as long as the digest of SHA-256.
_NAME, _BYTES = "model.key", 32


def mark(content: bytes) -> bytes:
    """Of what this installation has made, 64 hexadecimal digits. The key is made where there is none.

    Raises:
        OSError: a key can neither be read nor kept.
    """
    return hmac.new(_key(), content, hashlib.sha256).hexdigest().encode()


def is_ours(content: bytes, found: bytes) -> bool:
    """Whether this is our mark of this content; in constant time."""
    try:
        return hmac.compare_digest(mark(content), found)
    except OSError as error:
        log.warning("models cannot be checked: %s", error)
        return False


def _directory() -> Path:
    """systemd's STATE_DIRECTORY, else the user's; where neither can be made, the cache."""
    base = os.environ.get("STATE_DIRECTORY")
    home = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    path = Path(base.split(":")[0]) if base else Path(home) / "servo-daemon"
    with suppress(OSError):
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        if os.access(path, os.W_OK):
            return path
    return cache_directory()


def _key() -> bytes:
    path = _directory() / _NAME
    with suppress(FileNotFoundError):
        with path.open("rb") as file:
            private = not stat.S_IMODE(os.fstat(file.fileno()).st_mode) & 0o077 or os.name == "nt"
            key = file.read(_BYTES + 1)
        if private and len(key) == _BYTES:
            return key
        log.warning("%s: others could read it, or it is damaged: a new one is made, and models are trained again", path)
        path.unlink()
    fresh = path.with_name(f".{_NAME}.{secrets.token_hex(8)}")
    try:
        with os.fdopen(os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(secrets.token_bytes(_BYTES))
            file.flush()
            os.fsync(file.fileno())
        with suppress(FileExistsError):  # another process was first
            os.link(fresh, path)
        return path.read_bytes()
    finally:
        fresh.unlink(missing_ok=True)
