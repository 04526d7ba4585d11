"""Who can reach the API, and whether that is meant: checked before anything starts."""

from __future__ import annotations

import ipaddress
import ssl
from pathlib import Path
from typing import TYPE_CHECKING

from servo_daemon.config import ApiConfig
from servo_daemon.errors import ConfigError

if TYPE_CHECKING:
    from servo_daemon.api.access.tokens import TokenFile


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
            ssl.create_default_context(ssl.Purpose.CLIENT_AUTH).load_cert_chain(api.certificate, api.private_key)
        except (OSError, ssl.SSLError) as error:
            raise ConfigError(f"[api] certificate {api.certificate}, private_key {api.private_key}: {error}") from error
    loopback = ipaddress.ip_address(address.partition("%")[0]).is_loopback
    if not loopback and api.tokens_file is None and not api.behind_proxy:
        raise ConfigError(
            f"[api] host {address} is open to a network: set tokens_file (servo-daemon token new), or behind_proxy = "
            "true where a proxy asks who it is"
        )
