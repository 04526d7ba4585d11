"""Who can reach the API, and whether that is meant: checked before anything starts."""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import ssl
from pathlib import Path
from typing import TYPE_CHECKING

from servo_daemon.config import ApiConfig
from servo_daemon.config.credentials import file_of, tokens_of
from servo_daemon.errors import ConfigError

if TYPE_CHECKING:
    from servo_daemon.api.access.tokens import TokenFile

log = logging.getLogger(__name__)

#: Certificates that are renewed by themselves are so days before they end; looked at every so often, s.
_LOOK_EVERY_S = 30.0


def known_tokens(api: ApiConfig) -> TokenFile | None:
    """Those of `tokens_file`; None: there are none.

    Raises:
        ConfigError: the file is wrong, or has none.
    """
    from servo_daemon.api.access.tokens import TokenFile

    path = tokens_of(api.tokens_file)
    return None if path is None else TokenFile(path)


def check_exposure(address: str, api: ApiConfig) -> None:
    """Refuse to be open to a network by accident, and certificates that cannot be used.

    Args:
        address: on which the API listens.

    Raises:
        ConfigError: it is no loopback address, and nobody asks who it is; a file of `[api]` is wrong.
    """
    tokens = known_tokens(api)
    if (files := certificate_files(api)) is not None:
        try:
            _context(files)
        except (OSError, ssl.SSLError) as error:
            raise ConfigError(f"[api] certificate {api.certificate}, private_key {api.private_key}: {error}") from error
    loopback = ipaddress.ip_address(address.partition("%")[0]).is_loopback
    if not loopback and tokens is None and not api.behind_proxy:
        raise ConfigError(
            f"[api] host {address} is open to a network: set tokens_file (servo-daemon token new), or behind_proxy = "
            "true where a proxy asks who it is"
        )


def certificate_files(api: ApiConfig) -> tuple[Path, Path] | None:
    """Certificate and private key; None: no TLS.

    Raises:
        ConfigError: a credential that there is not.
    """
    if api.certificate is None or api.private_key is None:
        return None
    return file_of(api.certificate, "[api] certificate"), file_of(api.private_key, "[api] private_key")


class ServedCertificate:
    """The certificate of a server that runs, which new connections see as it is now. Used by the event loop.

    Args:
        context: the server's.
        files: certificate and private key.
    """

    def __init__(self, context: ssl.SSLContext, files: tuple[Path, Path]) -> None:
        self._context, self._files = context, files
        self._seen = _changed(files)

    async def follow(self) -> None:
        """Read certificate and key again whenever they change."""
        while True:
            await asyncio.sleep(_LOOK_EVERY_S)
            self.look()

    def look(self, files: tuple[Path, Path] | None = None) -> None:
        """Take what has changed. Files that are no pair are not used, and the log says so.

        Args:
            files: other ones from now on; None: the same.
        """
        files = files or self._files
        now = _changed(files)
        if (files, now) == (self._files, self._seen):
            return
        self._seen = now
        try:
            _context(files)
            self._context.load_cert_chain(*files)
            self._files = files
            log.info("%s: read again", files[0])
        except (OSError, ssl.SSLError) as error:
            log.error("%s, %s: %s; the certificate stays as it was", *files, error)


def _changed(files: tuple[Path, Path]) -> tuple[tuple[int, int], ...]:
    states = (file.stat() if file.exists() else None for file in files)
    return tuple((0, 0) if s is None else (s.st_mtime_ns, s.st_ino) for s in states)


def _context(files: tuple[Path, Path]) -> ssl.SSLContext:
    """Raises: OSError, ssl.SSLError: certificate and key cannot be used."""
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(*files)
    return context
