"""The application: REST API, stream, metrics and dashboard over a `DaemonView`. The caller runs it under uvicorn."""

from __future__ import annotations

from typing import Any, Final

from fastapi import FastAPI
from starlette.responses import HTMLResponse, JSONResponse

from servo_daemon.api import assets, problems
from servo_daemon.api.access.guard import Guard
from servo_daemon.api.access.permission import Access, Permission
from servo_daemon.api.access.request_limits import RequestLimits
from servo_daemon.api.answers import NO_STORE
from servo_daemon.api.computing import Computer, ProcessComputer
from servo_daemon.api.head import Head
from servo_daemon.api.problems import PREFIX
from servo_daemon.api.reference import reference_page
from servo_daemon.api.routes import api_router, metrics_router
from servo_daemon.api.schemas import diagnosis as diagnosis_schemas
from servo_daemon.api.schemas import estimates as schemas
from servo_daemon.api.schemas import kept as kept_schemas
from servo_daemon.api.schemas import past as past_schemas
from servo_daemon.api.schemas import recorded as recorded_schemas
from servo_daemon.api.schemas import trend as trend_schemas
from servo_daemon.published.view import DaemonView

_DESCRIPTION: Final = """
Electrical and mechanical parameters of live DC servo drives, each with a standard deviation and a status.

SI units; `_std` is 1 σ in the parameter's unit. Times are UTC, ISO 8601 with Z. A number that is not known is null; no
answer ever holds NaN. Errors are RFC 9457 problem details (`application/problem+json`). Any request may be refused
before it reaches its route: 401 and 403 (no token, or one that does not allow it; another site's page), 408, 413, 414
and 431 (too slow, too large), 421 (a stranger's name for this machine).
"""


def create_app(
    daemon: DaemonView,
    access: Access | None = None,
    computer: Computer | None = None,
) -> FastAPI:
    """The ASGI application. It only ever reads published records, and asks for a reset, a diagnosis or
    another model.

    Args:
        daemon: what it shows. `daemon.stopping()` must be true before the server is told to exit, so that the open
            streams end and the server need not wait for them.
        access: who may ask for what; None: whoever reaches the daemon may.
        computer: carries out what takes long; the caller closes it. None: a process of its own, which ends with this
            one.
    """
    app = FastAPI(
        title="servo-daemon",
        version=daemon.version,
        description=_DESCRIPTION,
        openapi_url="/openapi.json",
        docs_url=None,  # both pages load their scripts from a CDN; `reference.py` has ours
        redoc_url=None,
        redirect_slashes=False,
    )
    access = access or Access()
    problems.install(app)
    app.include_router(api_router(daemon, PREFIX, computer or ProcessComputer()), prefix=PREFIX)
    app.include_router(metrics_router(daemon))
    app.include_router(assets.make_router())
    app.add_middleware(Head)
    app.add_middleware(RequestLimits)
    app.add_middleware(Permission, access=access)
    app.add_middleware(Guard, allowed_hosts=lambda: access.hosts)
    _describe(app)
    return app


def _describe(app: FastAPI) -> None:
    """OpenAPI as the API really is, also under the API's own prefix; made at the first request."""
    generate = app.openapi
    cache: dict[str, Any] = {}

    def openapi() -> dict[str, Any]:
        if not cache:
            cache.update(_corrected(generate()))
        return cache

    app.openapi = openapi  # type: ignore[method-assign]  # FastAPI's documented way to extend the schema

    @app.get(f"{PREFIX}/openapi.json", include_in_schema=False)
    async def openapi_json() -> JSONResponse:
        return JSONResponse(openapi())

    @app.get("/docs", include_in_schema=False)
    async def docs() -> HTMLResponse:
        return HTMLResponse(reference_page(openapi()), headers=NO_STORE)


#: By name; those with examples are asked for.
_MODELS: Final[dict[str, Any]] = {
    **vars(schemas),
    **vars(diagnosis_schemas),
    **vars(past_schemas),
    **vars(kept_schemas),
    **vars(recorded_schemas),
    **vars(trend_schemas),
}


def _corrected(document: dict[str, Any]) -> dict[str, Any]:
    """What FastAPI cannot know: errors are problem documents, and nulls in the examples are meant."""
    described = document["components"]["schemas"]
    for name in ("HTTPValidationError", "ValidationError"):
        described.pop(name, None)
    described["ProblemDocument"] = schemas.ProblemDocument.model_json_schema()
    for name, schema in described.items():
        if "examples" in schema:
            extra = _MODELS[name].model_config["json_schema_extra"]
            schema["examples"] = extra["examples"]
    for operations in document["paths"].values():
        for operation in operations.values():
            invalid = operation["responses"].get("422", {}).get("content", {})
            if "application/json" in invalid:
                del operation["responses"]["422"]
    return document
