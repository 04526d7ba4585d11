"""What a client does, without doing it: generators that yield requests and pauses, and return what came of them. The
two clients carry them out, one waiting, one awaiting.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Final, TypeVar
from urllib.parse import quote

from servo_daemon.client.records import Capture, Diagnosis, Estimates, Event, History, Model, Samples, moment

Found = TypeVar("Found")


@dataclass(frozen=True, slots=True)
class Ask:
    """One request below the API's prefix; what comes back is its JSON document, or of a file its bytes."""

    path: str
    params: Mapping[str, str | int] = field(default_factory=dict)
    method: str = "GET"
    body: object | None = None
    is_file: bool = False


@dataclass(frozen=True, slots=True)
class Wait:
    """A pause, s."""

    seconds: float


Steps = Generator["Ask | Wait", Any, Found]

#: A diagnosis takes minutes: looked at so often, s.
_LOOK_EVERY_S: Final = 0.5


def _drive(name: str, rest: str = "") -> str:
    return f"/drives/{quote(name, safe='')}{rest}"


def document(path: str) -> Steps[Any]:
    """Ask for a document and return it as it is."""
    return (yield Ask(path))


def drives() -> Steps[tuple[str, ...]]:
    """Names, in the order of the configuration."""
    found = yield Ask("/drives")
    return tuple(d["name"] for d in found["drives"])


def estimates(drive: str) -> Steps[Estimates]:
    """Ask for the estimates as they are now."""
    return Estimates.of((yield Ask(_drive(drive, "/estimates"))))


def history(drive: str, names: Sequence[str], options: Mapping[str, Any]) -> Steps[History]:
    """Ask for the series of parameters over time."""
    if not names:
        raise ValueError("name at least one parameter or state channel")
    params: dict[str, str | int] = {"parameter": ",".join(names)}
    params |= {key: _text(value) for key, value in options.items() if value is not None}
    return History.of((yield Ask(_drive(drive, "/history"), params)))


def event_page(
    drive: str, kinds: Sequence[str], since: datetime | str | None, before: str | None
) -> Steps[tuple[list[Event], str | None]]:
    """One page, and what asks for the one before it."""
    params: dict[str, str | int] = {"limit": 1000}
    if kinds:
        params["kinds"] = ",".join(kinds)
    if since is not None:
        params["since"] = _text(since)
    if before is not None:
        params["before"] = before
    found = yield Ask(_drive(drive, "/events"), params)
    return [Event.of(e) for e in found["events"]], found["next"]


def all_events(drive: str, kinds: Sequence[str], since: datetime | str | None) -> Steps[list[Event]]:
    """All pages, oldest first."""
    pages: list[list[Event]] = []
    before: str | None = None
    while True:
        page, before = yield from event_page(drive, kinds, since, before)
        pages.append(page)
        if before is None:
            return [event for page in reversed(pages) for event in page]


def new_events(drive: str, kinds: Sequence[str], seen: list[Event]) -> Steps[list[Event]]:
    """Those after the last that was seen; `seen` becomes those of the newest moment."""
    since = seen[-1].time if seen else None
    fresh = [e for e in (yield from all_events(drive, kinds, since)) if e not in seen]
    if fresh:
        newest = fresh[-1].time
        seen[:] = [e for e in (*seen, *fresh) if e.time == newest]
    return fresh


def diagnosis(drive: str) -> Steps[Diagnosis]:
    """Ask for the last diagnosis."""
    return Diagnosis.of((yield Ask(_drive(drive, "/diagnosis"))))


def diagnose(drive: str, timeout_s: float, told: Callable[[Diagnosis], object] | None) -> Steps[Diagnosis]:
    """Begin one and wait for its end.

    Raises:
        TimeoutError: it still runs.
    """
    found = Diagnosis.of((yield Ask(_drive(drive, "/diagnosis"), method="POST")))
    waited = 0.0
    while found.status == "running":
        if told is not None:
            told(found)
        if waited >= timeout_s:
            raise TimeoutError(f"the diagnosis of {drive} still runs after {waited:.0f} s; it goes on")
        yield Wait(_LOOK_EVERY_S)
        waited += _LOOK_EVERY_S
        found = yield from diagnosis(drive)
    return found


def model(drive: str) -> Steps[Model]:
    """Ask for the model as it is now."""
    found = yield Ask(_drive(drive))
    return Model(tuple(found["model"]), moment(found["time"]), True)


def set_model(drive: str, effects: Sequence[str], parameters: Mapping[str, Any]) -> Steps[Model]:
    """Exchange the model."""
    body = {"effects": list(effects), "parameters": dict(parameters)}
    found = yield Ask(_drive(drive, "/model"), method="POST", body=body)
    return Model(tuple(found["model"]), moment(found["time"]), found["done"])


def stream_path(drive: str) -> str:
    """Where the estimates come by themselves."""
    return _drive(drive, "/stream")


def samples(drive: str, seconds: float, trigger: str | None, level: float, edge: str, before: float) -> Steps[Samples]:
    """Ask for the last samples."""
    params: dict[str, str | int] = {"seconds": str(seconds)}
    if trigger is not None:
        params |= {"trigger": trigger, "level": str(level), "edge": edge, "before": str(before)}
    return Samples.of((yield Ask(_drive(drive, "/samples"), params)))


def captures(drive: str) -> Steps[tuple[Capture, ...]]:
    """Ask which captures are kept."""
    found = yield Ask(_drive(drive, "/captures"))
    return tuple(map(Capture.of, found["captures"]))


def capture(drive: str, wanted: Capture | str) -> Steps[bytes]:
    """Fetch one capture as a file."""
    name = wanted if isinstance(wanted, str) else wanted.id
    found: bytes = yield Ask(_drive(drive, f"/captures/{quote(name, safe='')}"), is_file=True)
    return found


def record(drive: str, seconds: float) -> Steps[Capture]:
    """Have a new capture recorded."""
    return Capture.of((yield Ask(_drive(drive, "/captures"), method="POST", body={"seconds": seconds})))


def report(drive: str) -> Steps[str]:
    """That of the last diagnosis."""
    found: bytes = yield Ask(_drive(drive, "/diagnosis/report"), is_file=True)
    return found.decode()


def reset(drive: str) -> Steps[None]:
    """The estimation begins anew."""
    yield Ask(_drive(drive, "/reset"), method="POST")


def _text(value: object) -> str | int:
    if isinstance(value, datetime):
        return str(value.timestamp()) if value.tzinfo else value.isoformat()
    return value if isinstance(value, int) else str(value)
