"""The files of the dashboard, read once when the application is made and answered from memory."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Final

from fastapi import APIRouter, Request
from starlette.responses import Response

from servo_daemon.api.problems import ProblemError

_MEDIA_TYPES: Final = {
    "html": "text/html; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "svg": "image/svg+xml",
    "LICENSE": "text/plain; charset=utf-8",
}


@dataclass(frozen=True, slots=True)
class Asset:
    """One file: its bytes, media type and entity tag."""

    body: bytes
    media_type: str
    etag: str


def _collect(folder: Traversable, prefix: str, found: dict[str, Asset]) -> None:
    for entry in folder.iterdir():
        if entry.is_dir():
            _collect(entry, f"{prefix}{entry.name}/", found)
        elif media_type := _MEDIA_TYPES.get(entry.name.rpartition(".")[2]):
            body = entry.read_bytes()
            etag = f'"{hashlib.sha256(body).hexdigest()[:32]}"'
            found[prefix + entry.name] = Asset(body, media_type, etag)


def load_assets() -> dict[str, Asset]:
    """All files of the dashboard that a browser may ask for, by path below the dashboard's folder.

    Raises:
        FileNotFoundError: the package was installed without them.
    """
    found: dict[str, Asset] = {}
    _collect(files("servo_daemon.api") / "dashboard", "", found)
    if "index.html" not in found:
        raise FileNotFoundError("the dashboard's page index.html is missing: install servo-daemon again")
    return found


def _answer(request: Request, asset: Asset) -> Response:
    # "no-cache" means: keep it, but ask before use. On the next release no browser runs half of the old page.
    headers = {"ETag": asset.etag, "Cache-Control": "no-cache"}
    known = [tag.strip().removeprefix("W/") for tag in request.headers.get("if-none-match", "").split(",")]
    if asset.etag in known or "*" in known:
        return Response(status_code=304, headers=headers)
    return Response(asset.body, headers=headers, media_type=asset.media_type)


def make_router() -> APIRouter:
    """`/` and `/assets/...`; nothing outside the table of files can be reached."""
    assets = load_assets()
    router = APIRouter(include_in_schema=False)

    @router.api_route("/", methods=["GET", "HEAD"])
    async def index(request: Request) -> Response:
        return _answer(request, assets["index.html"])

    @router.api_route("/assets/{path:path}", methods=["GET", "HEAD"])
    async def asset(request: Request, path: str) -> Response:
        if path not in assets:
            raise ProblemError(404, "unknown_path", f"The dashboard has no file {path!r}.")
        return _answer(request, assets[path])

    return router
