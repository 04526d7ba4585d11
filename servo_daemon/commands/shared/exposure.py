"""Who can reach the API, and whether that is meant: checked before anything starts."""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import ssl
from pathlib import Path
from typing import TYPE_CHECKING

from servo_daemon.config import ApiConfig
from servo_daemon.errors import ConfigError

if TYPE_CHECKING:
    import uvicorn

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

    return None if api.tokens_file is None else TokenFile(Path(api.tokens_file))


def check_exposure(address: str, api: ApiConfig) -> None:
    """Refuse to be open to a network by accident, and certificates that cannot be used.

    Args:
        address: on which the API listens.

    Raises:
        ConfigError: it is no loopback address, and nobody asks who it is; a file of `[api]` is wrong.
    """
    known_tokens(api)
    if api.certificate is not None and api.private_key is not None:
        try:
            _context(api)
        except (OSError, ssl.SSLError) as error:
            raise ConfigError(f"[api] certificate {api.certificate}, private_key {api.private_key}: {error}") from error
    loopback = ipaddress.ip_address(address.partition("%")[0]).is_loopback
    if not loopback and api.tokens_file is None and not api.behind_proxy:
        raise ConfigError(
            f"[api] host {address} is open to a network: set tokens_file (servo-daemon token new), or behind_proxy = "
            "true where a proxy asks who it is"
        )


async def follow_certificate(config: uvicorn.Config, api: ApiConfig) -> None:
    """Read certificate and key again whenever they change. Those that are no pair are not used, and the log says so."""
    if api.certificate is None or api.private_key is None:
        return
    files = Path(api.certificate), Path(api.private_key)
    seen = _changed(files)
    while True:
        await asyncio.sleep(_LOOK_EVERY_S)
        now = _changed(files)
        if now == seen or config.ssl is None:
            continue
        seen = now
        try:
            _context(api)
            config.ssl.load_cert_chain(*files)
            log.info("%s: read again", files[0])
        except (OSError, ssl.SSLError) as error:
            log.error("%s, %s: %s; the certificate stays as it was", *files, error)


def _changed(files: tuple[Path, ...]) -> list[int]:
    return [file.stat().st_mtime_ns if file.exists() else 0 for file in files]


def _context(api: ApiConfig) -> ssl.SSLContext:
    """Raises: OSError, ssl.SSLError: certificate and key cannot be used."""
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(api.certificate or "", api.private_key)
    return context
