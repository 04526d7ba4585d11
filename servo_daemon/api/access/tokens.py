"""Who may ask: tokens, of which the daemon knows only hashes, each with what it allows.

A file of lines `NAME SCOPE SHA-256`. A token is 32 random bytes, so that its hash needs no salt and no slow function:
there is nothing to guess. A file that has changed is read again.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import logging
import os
import re
import secrets
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, get_args

from servo_daemon.errors import ConfigError

log = logging.getLogger(__name__)

#: Each allows what those before it do: to look, to ask for a reset or a diagnosis, to exchange the model.
Scope = Literal["read", "operate", "configure"]
SCOPES: Final[tuple[Scope, ...]] = get_args(Scope)
NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.@-]{0,63}")
_HASH: Final = re.compile(r"[0-9a-f]{64}")
_PREFIX: Final = "sd_"  # by which people and scanners of repositories know one
_LARGEST: Final = 1 << 20


@dataclass(frozen=True, slots=True)
class Token:
    """One line of the token file."""

    name: str
    scope: Scope
    sha256: str

    @property
    def line(self) -> str:
        return f"{self.name} {self.scope} {self.sha256}\n"

    def allows(self, scope: Scope) -> bool:
        return SCOPES.index(scope) <= SCOPES.index(self.scope)


def new_token(name: str, scope: Scope) -> tuple[Token, str]:
    """A token for the file, and the secret, which is known nowhere else."""
    secret = _PREFIX + secrets.token_urlsafe(32)
    return Token(name, scope, _hash(secret)), secret


def read_tokens(path: Path) -> tuple[Token, ...]:
    """The tokens in a file.

    Raises:
        ConfigError: it cannot be read, others may write it, or a line is none; the text names file and line.
    """
    try:
        with path.open("rb") as file:
            mode = stat.S_IMODE(os.fstat(file.fileno()).st_mode)
            text = file.read(_LARGEST).decode()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if os.name != "nt" and mode & 0o022:
        raise ConfigError(f"{path}: others than its owner may write it: chmod 640 it")
    tokens: dict[str, Token] = {}
    for number, line in enumerate(text.splitlines(), 1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        if len(words) != 3 or not NAME.fullmatch(words[0]) or words[1] not in SCOPES or not _HASH.fullmatch(words[2]):
            raise ConfigError(
                f"{path}, line {number}: not 'NAME read|operate|configure SHA-256': servo-daemon token new"
            )
        if words[0] in tokens:
            raise ConfigError(f"{path}, line {number}: a second token of the name {words[0]}")
        tokens[words[0]] = Token(words[0], SCOPES[SCOPES.index(words[1])], words[2])
    return tuple(tokens.values())


class TokenFile:
    """The tokens of a file, as it is now.

    Raises:
        ConfigError: see `read_tokens`; at the start only. Later what was good stays, and the log says why.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._tokens = read_tokens(path)
        self._seen = self._state()

    @property
    def number(self) -> int:
        """How many tokens there are."""
        return len(self._tokens)

    def same_as(self, other: TokenFile | None) -> bool:
        """Whether both hold the same."""
        return other is not None and self._tokens == other._tokens

    def find(self, authorization: str) -> Token | None:
        """Whose an Authorization header is: `Bearer TOKEN`, or as a browser sends it, `Basic` with it as password."""
        secret = _secret(authorization)
        if secret is None:
            return None
        state = self._state()
        if state != self._seen:
            self._seen = state
            try:
                self._tokens = read_tokens(self._path)
                log.info("%s: read again, %d tokens", self._path, len(self._tokens))
            except ConfigError as error:
                log.error("%s; the tokens stay as they were", error)
        found, digest = None, _hash(secret)
        for token in self._tokens:  # all of them, whichever it is
            if hmac.compare_digest(token.sha256, digest):
                found = token
        return found

    def _state(self) -> tuple[int, int, int] | None:
        try:
            status = self._path.stat()
        except OSError:
            return None
        return status.st_mtime_ns, status.st_size, status.st_ino


def _hash(secret: str) -> str:
    return hashlib.sha256(secret.encode("utf-8", "replace")).hexdigest()


def _secret(authorization: str) -> str | None:
    kind, _, value = authorization.strip().partition(" ")
    value = value.strip()
    if kind.lower() == "bearer":
        return value or None
    if kind.lower() == "basic":
        try:
            return base64.b64decode(value, validate=True).decode().partition(":")[2] or None
        except (binascii.Error, UnicodeDecodeError):
            return None
    return None
