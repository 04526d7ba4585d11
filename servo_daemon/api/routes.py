"""The routes of `/api/v1` and `/metrics`. Each one reads the last published records and returns at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Final

from fastapi import APIRouter, Path, Query, Request
from pydantic import BaseModel
from starlette.responses import Response, StreamingResponse

from servo_daemon.api import diagnosis, documents
from servo_daemon.api.answers import (
    INVALID,
    NO_STORE,
    REFUSED,
    UNKNOWN_DRIVE,
    Responses,
    json_response,
    problem_answer,
    tagged,
)
from servo_daemon.api.computing import Computer, while_connected
from servo_daemon.api.fleet import FleetEncoder
from servo_daemon.api.past import kept
from servo_daemon.api.past import routes as past
from servo_daemon.api.per_drive import PerDrive
from servo_daemon.api.problems import ProblemError, parameter_problem
from servo_daemon.api.recorded import routes as recorded
from servo_daemon.api.schemas import estimates as schemas
from servo_daemon.api.schemas import past as past_schemas
from servo_daemon.api.schemas import trend as trend_schemas
from servo_daemon.api.schemas import tuning as tuning_schemas
from servo_daemon.api.stream import StreamSlots, estimates_stream
from servo_daemon.api.trend import trend_document
from servo_daemon.api.tuning import TuningAnswers
from servo_daemon.published import exposition
from servo_daemon.published.metrics import render_metrics
from servo_daemon.published.view import DaemonView, DriveView
from servo_daemon.tuning.knowledge import Ask

#: nginx would otherwise hold events back until its buffer is full.
_STREAM_HEADERS: Final = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}

DriveName = Annotated[str, Path(description="The drive's name in the configuration.", examples=["axis1"])]
BandwidthHz = Annotated[
    float | None,
    Query(gt=0, allow_inf_nan=False, description="−3 dB bandwidth that each loop is to have, Hz.", examples=[10.0]),
]
SettlingS = Annotated[
    float | None,
    Query(gt=0, allow_inf_nan=False, description="Time until a small step stays within 2 %, s; not with a bandwidth."),
]


_NOT_YET: Final[Responses] = {
    409: problem_answer("What the gains need is not known (yet); `detail` says what and why."),
    503: problem_answer("Too much is being computed; `Retry-After` says when to ask again."),
}


class Routes:
    """The handlers, bound to one daemon. All are coroutines without blocking work: they run in the event loop;
    `tuning` hands its work to `computer`."""

    def __init__(self, daemon: DaemonView, computer: Computer) -> None:
        self._daemon = daemon
        self._encoders = PerDrive(daemon, documents.EstimatesEncoder)
        self._fleet = FleetEncoder(daemon)
        self._slots = StreamSlots()
        self._tuning = PerDrive(daemon, lambda drive: TuningAnswers(drive, computer))

    def find(self, name: str) -> DriveView:
        """The drive of that name.

        Raises:
            ProblemError: 404, naming the drives there are.
        """
        drive = self._daemon.drives.get(name)
        if drive is None:
            known = list(self._daemon.drives)
            detail = f"There is no drive {name!r}; the drives are {', '.join(known)}."
            raise ProblemError(404, "unknown_drive", detail, known=known)
        return drive

    async def health(self) -> Response:
        """Whether the daemon itself works: 200, or 503 with its problems. A drive that is away is not one."""
        document = documents.health_document(self._daemon)
        return json_response(document, 503 if document["problems"] else 200)

    async def ready(self) -> Response:
        """200 from the first samples of any drive on; 503 before, and while all lines are down, with what each drive
        waits for."""
        ready, document = documents.ready_document(self._daemon)
        if ready:
            return json_response(document)
        waiting = "; ".join(f"{name}: {d['reason']}" for name, d in document["drives"].items())
        raise ProblemError(503, "not_ready", f"No drive delivers samples: {waiting}.", **document)

    async def drives(self) -> Response:
        """The configured drives."""
        return json_response({"drives": [documents.drive_summary(d) for d in self._daemon.drives.values()]})

    async def fleet(self, request: Request) -> Response:
        """All drives at a glance: how each is connected, what is known, which parameter to look at first and why. An
        answer is up to half a second old."""
        return tagged(request, self._fleet())

    async def drive(self, drive: DriveName) -> Response:
        """One drive in full; a simulated one with the true values of its motor."""
        return json_response(documents.drive_document(self.find(drive)))

    async def estimates(self, drive: DriveName) -> Response:
        """The estimates now. Before the first samples: nominal values or null, status `estimating`."""
        view = self.find(drive)
        return Response(self._encoders.of(view)(view.newest()), headers=NO_STORE, media_type="application/json")

    async def tuning(
        self, request: Request, drive: DriveName, bandwidth_hz: BandwidthHz = None, settling_s: SettlingS = None
    ) -> Response:
        """Controller gains for the motor as it is, and the margins of the gains in use. With neither bandwidth nor
        settling time: as `[drive.controller]` asks, else half of what each loop can reach.

        Computed from the published estimate; an answer is up to ten seconds older than it.
        """
        view = self.find(drive)
        if bandwidth_hz is not None and settling_s is not None:
            raise parameter_problem("settling_s", "give bandwidth_hz or settling_s, not both")
        body = await while_connected(request, self._tuning.of(view).get(Ask(bandwidth_hz, settling_s)))
        return Response(body, headers=NO_STORE, media_type="application/json")

    async def trend(self, request: Request, drive: DriveName) -> Response:
        """How the parameters age, season and temperature taken out, and when they reach their limits; found every hour
        from the history."""
        return tagged(request, documents.encode(trend_document(self.find(drive))))

    async def stream(self, drive: DriveName) -> Response:
        """The estimates document as server-sent events (`event: estimates`), each new one, at most ten a second.

        The event's id is the document's `time`: after a lost connection, `/history?start=<id>` has what was missed.
        """
        view = self.find(drive)
        if self._slots.full:
            detail = f"{self._slots.limit} streams are open already."
            raise ProblemError(503, "too_many_streams", detail, {"Retry-After": "5"})

        def over() -> bool:
            return self._daemon.stopping() or self._daemon.drives.get(drive) is not view

        events = estimates_stream(view.snapshot, self._encoders.of(view), over, self._slots)
        return StreamingResponse(events, headers=_STREAM_HEADERS, media_type="text/event-stream")

    async def reset(self, drive: DriveName) -> Response:
        """Forget what was learned of this drive and start from the nominal values. Answers before it is done."""
        self.find(drive).request_reset()
        return json_response({"drive": drive, "accepted": True}, 202)


_STREAM_DOC: Final[Responses] = {
    200: {
        "description": "Endless; `data` is the estimates document.",
        "content": {
            "text/event-stream": {
                "example": 'id: 2026-11-21T12:45:21.103Z\nevent: estimates\ndata: {"drive":"axis1", ...}\n\n'
            }
        },
    }
}
_METRICS_DOC: Final[Responses] = {
    200: {
        "description": "Prometheus text format 0.0.4.",
        "content": {"text/plain": {"example": 'servo_daemon_resistance_ohm{drive="axis1"} 0.6391\n'}},
    }
}


def api_router(daemon: DaemonView, prefix: str, computer: Computer) -> APIRouter:
    """The routes under `prefix`, which is added by the caller."""
    routes = Routes(daemon, computer)
    router = APIRouter()
    get = ["GET"]
    failing: Responses = {503: {"model": schemas.HealthDocument, "description": "The daemon has a problem of its own."}}
    not_ready: Responses = {503: problem_answer("No drive has delivered samples yet, or every line is down.")}
    router.add_api_route(
        "/health", routes.health, methods=get, response_model=schemas.HealthDocument, responses=failing
    )
    router.add_api_route("/ready", routes.ready, methods=get, response_model=schemas.ReadyDocument, responses=not_ready)
    router.add_api_route("/drives", routes.drives, methods=get, response_model=schemas.DrivesDocument)
    router.add_api_route("/fleet", routes.fleet, methods=get, response_model=past_schemas.FleetDocument)
    of_a_drive: tuple[tuple[str, Callable[..., Any], type[BaseModel], Responses], ...] = (
        ("", routes.drive, schemas.DriveDocument, {}),
        ("/estimates", routes.estimates, schemas.EstimatesDocument, {}),
        ("/trend", routes.trend, trend_schemas.TrendDocument, {}),
        ("/tuning", routes.tuning, tuning_schemas.TuningDocument, {**INVALID, **_NOT_YET}),
    )
    for path, handler, model, responses in of_a_drive:
        router.add_api_route(
            f"/drives/{{drive}}{path}",
            handler,
            methods=get,
            response_model=model,
            responses={**UNKNOWN_DRIVE, **responses},
        )
    past.add_routes(router, past.PastRoutes(daemon, routes.find))
    kept.add_routes(router, kept.KeptRoutes(daemon.archive, routes.find, prefix))
    recorded.add_routes(router, recorded.RecordedRoutes(daemon, routes.find, prefix))
    diagnosis.add_routes(router, diagnosis.DiagnosisRoutes(routes.find, prefix, daemon.stopping))
    _add_stream_and_reset(router, routes)
    return router


def _add_stream_and_reset(router: APIRouter, routes: Routes) -> None:
    too_many: Responses = {503: problem_answer("Too many streams are open.")}
    router.add_api_route(
        "/drives/{drive}/stream",
        routes.stream,
        methods=["GET"],
        response_model=None,
        response_class=StreamingResponse,
        responses={**_STREAM_DOC, **UNKNOWN_DRIVE, **too_many},
    )
    router.add_api_route(
        "/drives/{drive}/reset",
        routes.reset,
        methods=["POST"],
        status_code=202,
        response_model=schemas.ResetDocument,
        responses={**UNKNOWN_DRIVE, **REFUSED},
    )


def metrics_router(daemon: DaemonView) -> APIRouter:
    """`/metrics`, at the root where Prometheus looks for it."""
    router = APIRouter()

    @router.get("/metrics", response_class=Response, responses=_METRICS_DOC)
    async def metrics() -> Response:
        """Everything that is published, for Prometheus."""
        headers = {**NO_STORE, "Content-Type": exposition.CONTENT_TYPE}
        return Response(render_metrics(daemon), headers=headers)

    return router
