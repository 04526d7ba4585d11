"""What takes seconds to compute: in a process of its own, one at a time, and no longer than somebody waits for it.

A thread would take the interpreter from the pipelines, go on after its client has gone and hold up a stop. The process
starts with the first question, at low priority, and ends when none has come for a while.
"""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing
import os
import signal
from collections.abc import Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import Any, Final, Protocol, TypeVar, cast

from fastapi import Request

from servo_daemon.api.problems import ProblemError

T = TypeVar("T")

#: Questions that wait beside the one being computed; a computation takes 0.3 to 5 s.
QUEUE: Final = 4
_RETRY_S: Final = 5
#: Added to the daemon's nice value: whoever reads samples comes first.
_NICE: Final = 10
#: The process, with its libraries 150 MB, ends when it was not asked for so long, s.
_IDLE_S: Final = 120.0


class Computer(Protocol):
    """Where computations are carried out."""

    async def run(self, function: Callable[..., T], *arguments: object) -> T: ...

    def close(self) -> None: ...


async def while_connected(request: Request, work: Coroutine[Any, Any, T]) -> T:
    """The result of `work`, which is cancelled when the client of this request goes away.

    Raises:
        ProblemError: it has gone; nobody reads that.
    """
    task, gone = asyncio.ensure_future(work), asyncio.ensure_future(_gone(request))
    try:
        await asyncio.wait({task, gone}, return_when=asyncio.FIRST_COMPLETED)
        if task.done():
            return task.result()
        raise ProblemError(503, "client_gone", "The client has gone.")
    finally:
        gone.cancel()
        task.cancel()


async def _gone(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass


def busy(detail: str) -> ProblemError:
    """The answer to a question for which there is no room now."""
    return ProblemError(503, "busy", detail, {"Retry-After": str(_RETRY_S)})


class ProcessComputer:
    """Runs one function at a time in another process. Functions and arguments are pickled: module-level functions,
    frozen records.

    Used by one event loop; `close` by any thread, for good.
    """

    def __init__(self) -> None:
        self._turn = asyncio.Lock()
        self._asked = 0
        self._closed = False
        self._worker: _Worker | None = None
        # It only waits for the process, whose end ends the wait.
        self._waiter = ThreadPoolExecutor(1, "computing")

    async def run(self, function: Callable[..., T], *arguments: object) -> T:
        """`function(*arguments)`, computed in the process.

        Raises:
            ProblemError: 503, too many ask already, or the process has ended.
            Exception: what the function raises.
        """
        if self._asked > QUEUE:
            raise busy(f"{self._asked} computations are waited for already.")
        self._asked += 1
        try:
            async with self._turn:
                return await self._compute(function, arguments)
        finally:
            self._asked -= 1

    async def _compute(self, function: Callable[..., T], arguments: tuple[object, ...]) -> T:
        if self._closed:
            raise busy("The daemon is stopping.")
        if self._worker is None or not self._worker.alive:
            self._worker = _Worker()
        worker = self._worker
        try:
            answer = await asyncio.get_running_loop().run_in_executor(self._waiter, worker.ask, function, arguments)
        except (EOFError, OSError) as error:
            worker.kill()
            raise busy("The computation was ended.") from error
        except asyncio.CancelledError:
            worker.kill()
            raise
        if isinstance(answer, Exception):
            raise answer
        return cast("T", answer)

    def close(self) -> None:
        """End what is being computed; nothing is computed from now on. Idempotent."""
        self._closed = True
        if self._worker is not None:
            self._worker.kill()
        self._waiter.shutdown(wait=False)


class _Worker:
    """The process and the line to it."""

    def __init__(self) -> None:
        # A fresh process: a forked one would inherit the daemon's sockets, locks and threads' halves of work.
        context = multiprocessing.get_context("spawn")
        self._line, theirs = context.Pipe()
        self._killed = False
        self._process = context.Process(target=_serve, args=(theirs,), daemon=True, name="computing")
        self._process.start()
        theirs.close()

    @property
    def alive(self) -> bool:
        return not self._killed and self._process.is_alive()

    def ask(self, function: Callable[..., object], arguments: tuple[object, ...]) -> object:
        """The answer, or the exception that is one. Blocks.

        Raises:
            EOFError, OSError: the process has ended.
        """
        self._line.send((function, arguments))
        answer: object = self._line.recv()
        return answer

    def kill(self) -> None:
        self._killed = True
        self._process.kill()


def _serve(line: Connection) -> None:
    """In the process: answer until nobody asks any more, or the daemon has ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the daemon ends this process
    with contextlib.suppress(OSError, AttributeError):
        os.nice(_NICE)
    with contextlib.suppress(EOFError, OSError):
        while line.poll(_IDLE_S):
            function, arguments = line.recv()
            try:
                answer: object = function(*arguments)
            except Exception as error:
                answer = error
            line.send(answer)
