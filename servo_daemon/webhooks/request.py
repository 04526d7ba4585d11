"""One event as a signed request, in the form of Standard Webhooks (https://www.standardwebhooks.com).

webhook-id         the same in every attempt: who has had it leaves it out
webhook-timestamp  of the attempt, seconds since the epoch
webhook-signature  "v1," and the base64 of HMAC-SHA256 over "<id>.<timestamp>.<body>"
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import urllib.error
import urllib.request
from http.client import HTTPException
from typing import Any, Final

from servo_daemon import __version__
from servo_daemon.config.credentials import file_of
from servo_daemon.errors import ConfigError

#: A receiver that does not answer is given up after this long, s (Standard Webhooks: 15 to 30 s at most).
_TIMEOUT_S: Final = 15.0
#: Answers after which the same request may succeed later (RFC 9110, 15.5.9; RFC 8470; RFC 6585); so may every 5xx.
_LATER: Final = (408, 425, 429)


class RefusedError(Exception):
    """The receiver will never take this request."""


class AwayError(Exception):
    """The receiver cannot take it now."""


def read_secret(path: str) -> bytes:
    """The key in `secret_file`: `whsec_` and base64, or any text.

    Raises:
        ConfigError: unreadable or empty.
    """
    file = file_of(path, "[[webhook]] secret_file")
    try:
        text = file.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"[[webhook]] secret_file {path}: cannot be read: {error}") from error
    if not text:
        raise ConfigError(f"[[webhook]] secret_file {path}: is empty")
    if not text.startswith("whsec_"):
        return text.encode()
    try:
        return base64.b64decode(text.removeprefix("whsec_"), validate=True)
    except binascii.Error as error:
        raise ConfigError(f"[[webhook]] secret_file {path}: after whsec_ comes no base64: {error}") from error


def signature(secret: bytes, identity: str, timestamp: int, body: bytes) -> str:
    """The value of `webhook-signature`."""
    signed = f"{identity}.{timestamp}.".encode() + body
    return "v1," + base64.b64encode(hmac.new(secret, signed, hashlib.sha256).digest()).decode()


def post(url: str, identity: str, body: bytes, secret: bytes | None, now: float) -> None:
    """Send it.

    Args:
        now: UTC seconds since the epoch.

    Raises:
        RefusedError: the answer is no, for good.
        AwayError: no answer, or one that says to try again.
    """
    headers = {
        "Content-Type": "application/json",
        "User-Agent": f"servo-daemon/{__version__}",
        "webhook-id": identity,
        "webhook-timestamp": str(int(now)),
    }
    if secret is not None:
        headers["webhook-signature"] = signature(secret, identity, int(now), body)
    request = urllib.request.Request(url, body, headers, method="POST")
    try:
        with _opener().open(request, timeout=_TIMEOUT_S):
            return
    except urllib.error.HTTPError as error:
        error.close()
        kind = AwayError if error.code >= 500 or error.code in _LATER else RefusedError
        raise kind(f"HTTP {error.code}") from None
    except (OSError, HTTPException) as error:  # URLError is an OSError
        cause = getattr(error, "reason", error)
        raise AwayError(str(getattr(cause, "strerror", None) or cause) or type(error).__name__) from error


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    """What is signed for one address goes to no other."""

    def redirect_request(self, *_arguments: Any) -> None:
        return None


def _opener() -> urllib.request.OpenerDirector:
    return urllib.request.build_opener(_NoRedirect)
