"""The two clients over httpx."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from datetime import datetime
from types import TracebackType
from typing import Any, Final, Self, TypeVar

try:
    import httpx
except ImportError as error:
    raise ImportError("servo_daemon.client needs httpx: pip install 'servo-daemon[client]'") from error

from servo_daemon.client import steps
from servo_daemon.client.errors import DaemonError, UnreachableError
from servo_daemon.client.records import Diagnosis, Estimates, Event, History, Model

URL: Final = "http://127.0.0.1:8077"
_PREFIX: Final = "/api/v1"
#: A change of the model is answered after up to 30 s (`api/diagnosis.py`); everything else at once.
_TIMEOUT_S: Final = 40.0
#: New events are asked for this often, s.
_POLL_S: Final = 1.0
Found = TypeVar("Found")
When = datetime | str | None


def _decoded(answer: httpx.Response) -> Any:
    """Raises: DaemonError: the answer is a problem."""
    if answer.is_success:
        return answer.json()
    try:
        problem = answer.json()
    except ValueError:
        problem = {}
    raise DaemonError(answer.status_code, problem if isinstance(problem, dict) else {})


def _options(ask: steps.Ask) -> dict[str, Any]:
    return {"params": dict(ask.params), **({} if ask.body is None else {"json": ask.body})}


def _unreachable(url: object, error: httpx.TransportError) -> UnreachableError:
    return UnreachableError(f"no daemon answers at {url}: {error or type(error).__name__}")


class Client:
    """A daemon, asked and waited for. Not for several threads at once. `transport` is httpx's own, for tests.

    Every method raises UnreachableError (no answer) or DaemonError (refused, with the reason).
    """

    def __init__(self, url: str = URL, timeout_s: float = _TIMEOUT_S, transport: httpx.BaseTransport | None = None):
        self._http = httpx.Client(base_url=url, timeout=timeout_s, transport=transport)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the connections."""
        self._http.close()

    def _run(self, todo: steps.Steps[Found]) -> Found:
        answer: Any = None
        try:
            while True:
                step = todo.send(answer)
                answer = None
                if isinstance(step, steps.Wait):
                    time.sleep(step.seconds)
                else:
                    answer = self._ask(step)
        except StopIteration as done:
            found: Found = done.value
            return found

    def _ask(self, ask: steps.Ask) -> Any:
        try:
            return _decoded(self._http.request(ask.method, _PREFIX + ask.path, **_options(ask)))
        except httpx.TransportError as error:
            raise _unreachable(self._http.base_url, error) from error

    def get(self, path: str) -> Any:
        """Any document of the API: `get("/fleet")`."""
        return self._run(steps.document(path))

    def drives(self) -> tuple[str, ...]:
        """Names of the drives."""
        return self._run(steps.drives())

    def estimates(self, drive: str) -> Estimates:
        """The estimates now."""
        return self._run(steps.estimates(drive))

    def history(
        self, drive: str, *names: str, window: str | None = None, start: When = None, end: When = None,
        points: int | None = None, level: str | None = None,
    ) -> History:  # fmt: skip
        """Parameters and state channels over time, from the level that suits (`window="1y"`, `level="1 min"`)."""
        options = {"window": window, "start": start, "end": end, "points": points, "level": level}
        return self._run(steps.history(drive, names, options))

    def events(
        self, drive: str, *kinds: str, since: When = None, follow: bool = False, poll_s: float = _POLL_S
    ) -> Iterator[Event]:
        """Events, oldest first; with `follow` for ever, each new one as it comes."""
        found = self._run(steps.all_events(drive, kinds, since))
        seen = [e for e in found if e.time == found[-1].time]
        yield from found
        while follow:
            time.sleep(poll_s)
            yield from self._run(steps.new_events(drive, kinds, seen))

    def diagnosis(self, drive: str) -> Diagnosis:
        """The last diagnosis."""
        return self._run(steps.diagnosis(drive))

    def diagnose(
        self, drive: str, timeout_s: float = 3600.0, told: Callable[[Diagnosis], object] | None = None
    ) -> Diagnosis:
        """Begin a diagnosis of the last samples and wait for what it says; `told` is called with how far it is.

        Raises:
            TimeoutError: it still runs after so long; it goes on.
        """
        return self._run(steps.diagnose(drive, timeout_s, told))

    def model(self, drive: str) -> Model:
        """The model that the drive has now."""
        return self._run(steps.model(drive))

    def set_model(self, drive: str, effects: Sequence[str], parameters: Mapping[str, Any] | None = None) -> Model:
        """Go over to another model; `parameters` say where new ones begin (`{"Tc": 0.012}`)."""
        return self._run(steps.set_model(drive, effects, parameters or {}))


class AsyncClient:
    """The same, awaited."""

    def __init__(
        self, url: str = URL, timeout_s: float = _TIMEOUT_S, transport: httpx.AsyncBaseTransport | None = None
    ) -> None:
        self._http = httpx.AsyncClient(base_url=url, timeout=timeout_s, transport=transport)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """End the connections."""
        await self._http.aclose()

    async def _run(self, todo: steps.Steps[Found]) -> Found:
        answer: Any = None
        while True:
            try:
                step = todo.send(answer)
            except StopIteration as done:
                found: Found = done.value
                return found
            answer = None
            if isinstance(step, steps.Wait):
                await asyncio.sleep(step.seconds)
            else:
                answer = await self._ask(step)

    async def _ask(self, ask: steps.Ask) -> Any:
        try:
            return _decoded(await self._http.request(ask.method, _PREFIX + ask.path, **_options(ask)))
        except httpx.TransportError as error:
            raise _unreachable(self._http.base_url, error) from error

    async def get(self, path: str) -> Any:
        """Any document of the API: `get("/fleet")`."""
        return await self._run(steps.document(path))

    async def drives(self) -> tuple[str, ...]:
        """Names of the drives."""
        return await self._run(steps.drives())

    async def estimates(self, drive: str) -> Estimates:
        """The estimates now."""
        return await self._run(steps.estimates(drive))

    async def history(
        self, drive: str, *names: str, window: str | None = None, start: When = None, end: When = None,
        points: int | None = None, level: str | None = None,
    ) -> History:  # fmt: skip
        """See `Client.history`."""
        options = {"window": window, "start": start, "end": end, "points": points, "level": level}
        return await self._run(steps.history(drive, names, options))

    async def events(
        self, drive: str, *kinds: str, since: When = None, follow: bool = False, poll_s: float = _POLL_S
    ) -> AsyncIterator[Event]:
        """See `Client.events`."""
        found = await self._run(steps.all_events(drive, kinds, since))
        seen = [e for e in found if e.time == found[-1].time]
        for event in found:
            yield event
        while follow:
            await asyncio.sleep(poll_s)
            for event in await self._run(steps.new_events(drive, kinds, seen)):
                yield event

    async def diagnosis(self, drive: str) -> Diagnosis:
        """The last diagnosis."""
        return await self._run(steps.diagnosis(drive))

    async def diagnose(
        self, drive: str, timeout_s: float = 3600.0, told: Callable[[Diagnosis], object] | None = None
    ) -> Diagnosis:
        """See `Client.diagnose`."""
        return await self._run(steps.diagnose(drive, timeout_s, told))

    async def model(self, drive: str) -> Model:
        """The model that the drive has now."""
        return await self._run(steps.model(drive))

    async def set_model(self, drive: str, effects: Sequence[str], parameters: Mapping[str, Any] | None = None) -> Model:
        """See `Client.set_model`."""
        return await self._run(steps.set_model(drive, effects, parameters or {}))
