"""A running daemon asked from a command. The standard library's client: a command must run without extras."""

from __future__ import annotations

import json
import os
import urllib.error
import urllib.request
from collections.abc import Mapping
from typing import Any, Final
from urllib.parse import urlencode

from servo_daemon.errors import BadInputError, ServoDaemonError

URL: Final = "http://127.0.0.1:8077"
#: The token for a daemon that asks for one: not an argument, which everybody on the machine could read.
TOKEN: Final = "SERVO_DAEMON_TOKEN"
_TIMEOUT_S: Final = 30.0
#: Not through a proxy: the daemon is in this network.
_OPENER: Final = urllib.request.build_opener(urllib.request.ProxyHandler({}))


def get(url: str, path: str, params: Mapping[str, str | int] | None = None, accept: str = "application/json") -> bytes:
    """The body of `GET url/api/v1path`.

    Raises:
        BadInputError: no URL, or the daemon says that the question is wrong.
        ServoDaemonError: no answer, or the daemon cannot give one now.
    """
    query = f"?{urlencode(params)}" if params else ""
    try:
        headers = {"Accept": accept}
        if token := os.environ.get(TOKEN):
            headers["Authorization"] = f"Bearer {token}"
        request = urllib.request.Request(f"{url.rstrip('/')}/api/v1{path}{query}", headers=headers)
        with _OPENER.open(request, timeout=_TIMEOUT_S) as answer:
            body: bytes = answer.read()
            return body
    except urllib.error.HTTPError as error:
        with error:
            text = _detail(error.read()) or f"{url} answered with status {error.code}"
            if error.code == 401:
                text = f"{url} asks for a token (servo-daemon token new): set {TOKEN} to one that it knows"
        raise (BadInputError if error.code in {404, 406, 422} else ServoDaemonError)(text) from None
    except urllib.error.URLError as error:
        raise ServoDaemonError(f"no daemon answers at {url}: {error.reason}") from None
    except ValueError as error:
        raise BadInputError(f"{url!r} is no address such as {URL}: {error}") from None
    except OSError as error:  # broken off, or too slow
        raise ServoDaemonError(f"{url}: {error}") from None


def document(url: str, path: str, params: Mapping[str, str | int] | None = None) -> Any:
    """The same as a JSON document. Raises: ServoDaemonError: also where something else answers there."""
    try:
        return json.loads(get(url, path, params))
    except (ValueError, RecursionError):
        raise ServoDaemonError(f"what answers at {url} is no servo-daemon") from None


def _detail(body: bytes) -> str | None:
    try:
        problem = json.loads(body)
        return str(problem["detail"])
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
