"""The client that waits, over httpx."""

from __future__ import annotations

import ssl
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import datetime
from types import TracebackType
from typing import Any, Final, Self, TypeVar

import httpx

from servo_daemon.client import answers, steps
from servo_daemon.client.records import Capture, Diagnosis, Estimates, Event, History, Model, Samples

URL: Final = "http://127.0.0.1:8077"
#: A change of the model and a capture are answered after up to 30 s (`api/diagnosis.py`); everything else at once.
TIMEOUT_S: Final = 40.0
#: New events are asked for this often, s.
POLL_S: Final = 1.0
#: Of device time in a capture that is asked for, s: the API's own.
CAPTURE_S: Final = 60.0
Found = TypeVar("Found")
When = datetime | str | None
Verify = bool | ssl.SSLContext


class Client:
    """A daemon, asked and waited for. Not for several threads at once.

    Every method raises UnreachableError (no answer) or DaemonError (refused, with the reason).

    Args:
        token: of `servo-daemon token new`, where the daemon asks for one.
        verify: certificates that are trusted besides the system's: `ssl.create_default_context(cafile=…)`.
        transport: httpx's own, for tests.
    """

    def __init__(
        self, url: str = URL, timeout_s: float = TIMEOUT_S, transport: httpx.BaseTransport | None = None, *,
        token: str | None = None, verify: Verify = True,
    ) -> None:  # fmt: skip
        self._http = httpx.Client(
            base_url=url, timeout=timeout_s, transport=transport, headers=answers.headers(token), verify=verify
        )

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
            answer = self._http.request(ask.method, answers.address(ask.path), **answers.options(ask))
        except httpx.TransportError as error:
            raise answers.unreachable(self._http.base_url, error) from error
        return answers.content(ask, answer)

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
        self, drive: str, *kinds: str, since: When = None, follow: bool = False, poll_s: float = POLL_S
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

    def stream(self, drive: str) -> Iterator[Estimates]:
        """The estimates now, and again whenever there are new ones, until the daemon stops."""
        try:
            with self._http.stream("GET", answers.address(steps.stream_path(drive))) as answer:
                if not answer.is_success:
                    answer.read()
                answers.check(answer)
                for line in answer.iter_lines():
                    yield from answers.estimates_in(line)
        except httpx.TransportError as error:
            raise answers.unreachable(self._http.base_url, error) from error

    def samples(
        self, drive: str, seconds: float = 1.0, *, trigger: str | None = None, level: float = 0.0,
        edge: str = "rising", before: float = 0.2,
    ) -> Samples:  # fmt: skip
        """The last samples, or those about the last time that the channel `trigger` crossed `level`; at most 5 s."""
        return self._run(steps.samples(drive, seconds, trigger, level, edge, before))

    def captures(self, drive: str) -> tuple[Capture, ...]:
        """The recordings that are kept, oldest first."""
        return self._run(steps.captures(drive))

    def capture(self, drive: str, capture: Capture | str) -> bytes:
        """One of them (or of its `id`) as the file that `fit` and `diagnose` open: `Path(c.file).write_bytes(…)`."""
        return self._run(steps.capture(drive, capture))

    def record(self, drive: str, seconds: float = CAPTURE_S) -> Capture:
        """Keep the last samples; there when this returns."""
        return self._run(steps.record(drive, seconds))

    def report(self, drive: str) -> str:
        """The report of the last diagnosis, a page of HTML."""
        return self._run(steps.report(drive))

    def reset(self, drive: str) -> None:
        """Begin the estimation anew."""
        self._run(steps.reset(drive))
