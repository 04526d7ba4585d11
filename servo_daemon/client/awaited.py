"""The client that is awaited, over httpx."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from types import TracebackType
from typing import Any, Self, TypeVar

import httpx

from servo_daemon.client import answers, steps
from servo_daemon.client.clients import CAPTURE_S, POLL_S, TIMEOUT_S, URL, Verify, When
from servo_daemon.client.records import Capture, Diagnosis, Estimates, Event, History, Model, Samples

Found = TypeVar("Found")


class AsyncClient:
    """As `Client`, with coroutines."""

    def __init__(
        self, url: str = URL, timeout_s: float = TIMEOUT_S, transport: httpx.AsyncBaseTransport | None = None, *,
        token: str | None = None, verify: Verify = True,
    ) -> None:  # fmt: skip
        self._http = httpx.AsyncClient(
            base_url=url, timeout=timeout_s, transport=transport, headers=answers.headers(token), verify=verify
        )

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
            answer = await self._http.request(ask.method, answers.address(ask.path), **answers.options(ask))
        except httpx.TransportError as error:
            raise answers.unreachable(self._http.base_url, error) from error
        return answers.content(ask, answer)

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
        self, drive: str, *kinds: str, since: When = None, follow: bool = False, poll_s: float = POLL_S
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

    async def stream(self, drive: str) -> AsyncIterator[Estimates]:
        """See `Client.stream`."""
        try:
            async with self._http.stream("GET", answers.address(steps.stream_path(drive))) as answer:
                if not answer.is_success:
                    await answer.aread()
                answers.check(answer)
                async for line in answer.aiter_lines():
                    for found in answers.estimates_in(line):
                        yield found
        except httpx.TransportError as error:
            raise answers.unreachable(self._http.base_url, error) from error

    async def samples(
        self, drive: str, seconds: float = 1.0, *, trigger: str | None = None, level: float = 0.0,
        edge: str = "rising", before: float = 0.2,
    ) -> Samples:  # fmt: skip
        """See `Client.samples`."""
        return await self._run(steps.samples(drive, seconds, trigger, level, edge, before))

    async def captures(self, drive: str) -> tuple[Capture, ...]:
        """See `Client.captures`."""
        return await self._run(steps.captures(drive))

    async def capture(self, drive: str, capture: Capture | str) -> bytes:
        """See `Client.capture`."""
        return await self._run(steps.capture(drive, capture))

    async def record(self, drive: str, seconds: float = CAPTURE_S) -> Capture:
        """See `Client.record`."""
        return await self._run(steps.record(drive, seconds))

    async def report(self, drive: str) -> str:
        """See `Client.report`."""
        return await self._run(steps.report(drive))

    async def reset(self, drive: str) -> None:
        """See `Client.reset`."""
        await self._run(steps.reset(drive))
