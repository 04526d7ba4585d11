"""`GET /drives/{d}/tuning`: gains from the published estimate, computed in a thread of its own and kept.

A computation takes about 0.3 s (and importing python-control 1 s, once), so it never runs in the event loop, there is
at most one at a time for the whole daemon, and its answer serves everybody for `FRESH_S`, or until a parameter's
status changes: motors age slowly, and what takes the processor from the pipeline must be rare.
"""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final

from servo_daemon.api.documents import Document, encode
from servo_daemon.api.problems import ProblemError
from servo_daemon.api.times import iso_utc
from servo_daemon.errors import TuningError
from servo_daemon.published.knowledge import LoopFacts, motor_knowledge
from servo_daemon.published.snapshot import Snapshot
from servo_daemon.published.view import DriveView
from servo_daemon.tuning.knowledge import Ask

#: An answer is at most this much older than the estimates, s.
FRESH_S: Final = 10.0
#: Different asks that are kept for one drive.
_KEPT: Final = 8


@dataclass(frozen=True, slots=True)
class _Answer:
    body: bytes
    made: float
    statuses: tuple[str, ...]


class TuningAnswers:
    """The answers for one drive. Used by the event loop only."""

    def __init__(self, drive: DriveView, executor: ThreadPoolExecutor) -> None:
        self._drive, self._executor = drive, executor
        self._answers: OrderedDict[Ask, _Answer] = OrderedDict()
        self._computing = asyncio.Lock()

    async def get(self, asked: Ask) -> bytes:
        """The document as bytes.

        Args:
            asked: in the request; with nothing in it the configuration's.

        Raises:
            ProblemError: 409, what gains need is not known yet; 422, what the request asks for is impossible.
        """
        facts = self._drive.loop
        ask = facts.ask if asked == Ask() else asked
        body = self._kept(ask)
        if body is None:
            async with self._computing:
                body = self._kept(ask)  # made while we waited?
                if body is None:
                    body = await self._compute(ask, facts, asked)
        return body

    async def _compute(self, ask: Ask, facts: LoopFacts, asked: Ask) -> bytes:
        snapshot = self._drive.snapshot()
        loop = asyncio.get_running_loop()
        try:
            body = await loop.run_in_executor(self._executor, _body, self._drive, snapshot, facts, ask)
        except _AskError as error:
            status, code = (409, "tuning_impossible") if asked == Ask() else (422, "invalid_parameter")
            raise ProblemError(status, code, str(error)) from error
        except TuningError as error:
            raise ProblemError(409, "tuning_impossible", str(error)) from error
        self._answers[ask] = _Answer(body, time.monotonic(), _statuses(snapshot))
        self._answers.move_to_end(ask)
        while len(self._answers) > _KEPT:
            self._answers.popitem(last=False)
        return body

    def _kept(self, ask: Ask) -> bytes | None:
        answer = self._answers.get(ask)
        if answer is None or time.monotonic() - answer.made > FRESH_S:
            return None
        return answer.body if answer.statuses == _statuses(self._drive.snapshot()) else None


def _statuses(snapshot: Snapshot) -> tuple[str, ...]:
    return () if snapshot.estimate is None else tuple(p.status for p in snapshot.estimate.parameters)


class _AskError(TuningError):
    """Nothing is wrong with what is known, only with what is asked for."""


def _body(drive: DriveView, snapshot: Snapshot, facts: LoopFacts, ask: Ask) -> bytes:
    """In the executor's thread.

    Raises:
        TuningError: no gains can be found.
    """
    from servo_daemon.tuning.document import document
    from servo_daemon.tuning.report import tune
    from servo_daemon.tuning.search import check_ask

    estimate = snapshot.estimate
    if estimate is None:
        motor = motor_knowledge(drive.initial_parameters, None, drive.model, {})
        setup = facts.setup(None)
    else:
        motor = motor_knowledge(estimate.parameters, estimate.covariance, estimate.model, estimate.state)
        setup = facts.setup(estimate.sample_rate_hz)
    try:
        check_ask(ask, setup.rate_hz)
    except TuningError as error:
        raise _AskError(str(error)) from error
    health = {} if estimate is None else estimate.health
    head: Document = {
        "drive": drive.name,
        "time": None if snapshot.time is None else iso_utc(snapshot.time),
        "samples": 0 if estimate is None else int(estimate.samples),
        "margin_low": health.get("controller_margin_low"),
    }
    return encode(head | document(tune(motor, setup, ask, facts.log_nominal)))
