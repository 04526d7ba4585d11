"""What takes long is computed in a process: one at a time, few in the queue, ended with whoever asked and at a stop."""

from __future__ import annotations

import asyncio
import math
import os
import time
from collections.abc import Iterator

import pytest

from servo_daemon.api.computing import QUEUE, ProcessComputer
from servo_daemon.api.problems import ProblemError

ENDLESS = (time.sleep, 3600.0)


@pytest.fixture
def computer() -> Iterator[ProcessComputer]:
    computer = ProcessComputer()
    yield computer
    computer.close()


def test_it_computes_elsewhere_and_what_fails_fails_here(computer: ProcessComputer) -> None:
    async def inside() -> None:
        pid = await computer.run(os.getpid)
        assert pid != os.getpid() and await computer.run(os.getpid) == pid, "one process, kept"
        assert await computer.run(math.hypot, 3.0, 4.0) == 5.0
        with pytest.raises(ValueError, match="math domain"):
            await computer.run(math.sqrt, -1.0)
        task = asyncio.ensure_future(computer.run(*ENDLESS))
        await asyncio.sleep(0)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert await asyncio.wait_for(computer.run(os.getpid), 30) != pid, "the one at work for nobody was ended"

    asyncio.run(inside())


def test_few_wait_and_a_stop_ends_all(computer: ProcessComputer) -> None:
    async def inside() -> None:
        tasks = [asyncio.ensure_future(computer.run(*ENDLESS)) for _ in range(QUEUE + 1)]
        await asyncio.sleep(0)
        with pytest.raises(ProblemError) as refused:
            await computer.run(os.getpid)
        assert refused.value.status == 503 and refused.value.headers == {"Retry-After": "5"}
        computer.close()
        ended = await asyncio.wait_for(asyncio.gather(*tasks, return_exceptions=True), 30)
        assert all(isinstance(e, ProblemError) and e.status == 503 for e in ended)

    asyncio.run(inside())
