"""`GET /drives/{d}/tuning`: gains from the published estimate, computed in a process of its own and kept.

A computation takes 0.3 to 5 s, so there is one at a time for the whole daemon (`computing.py`). Who asks for what is
being computed waits for the same answer, which serves everybody for `FRESH_S`, or until a parameter's status changes:
motors age slowly, and what takes the processor from the pipeline must be rare.
"""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict
from dataclasses import dataclass
from typing import Any, Final

from servo_daemon.api.computing import Computer
from servo_daemon.api.documents import Document, encode
from servo_daemon.api.problems import ProblemError
from servo_daemon.errors import TuningError
from servo_daemon.published.knowledge import LoopFacts, motor_knowledge
from servo_daemon.published.snapshot import Snapshot
from servo_daemon.published.units import iso_utc
from servo_daemon.published.view import DriveView
from servo_daemon.tuning.knowledge import Ask, LoopSetup, MotorKnowledge

#: An answer is at most this much older than the estimates, s.
FRESH_S: Final = 10.0
#: Different asks that are kept for one drive.
_KEPT: Final = 8


@dataclass(frozen=True, slots=True)
class _Answer:
    body: bytes
    made: float
    statuses: tuple[str, ...]


@dataclass(slots=True)
class _Shared:
    """An answer being computed, and how many wait for it."""

    task: asyncio.Task[bytes]
    waiting: int = 0


class TuningAnswers:
    """The answers for one drive. Used by the event loop only."""

    def __init__(self, drive: DriveView, computer: Computer) -> None:
        self._drive, self._computer = drive, computer
        self._answers: OrderedDict[Ask, _Answer] = OrderedDict()
        self._computing: dict[Ask, _Shared] = {}

    async def get(self, asked: Ask) -> bytes:
        """The document as bytes. Cancelled: where nobody else waits for it, the computation ends as well.

        Args:
            asked: in the request; with nothing in it the configuration's.

        Raises:
            ProblemError: 409, what gains need is not known yet; 422, what the request asks for is impossible; 503,
                too much is being computed.
        """
        facts = self._drive.loop
        ask = facts.ask if asked == Ask() else asked
        body = self._kept(ask)
        if body is not None:
            return body
        shared = self._computing.get(ask)
        if shared is None:
            shared = self._computing[ask] = _Shared(asyncio.ensure_future(self._compute(ask, facts)))
            shared.task.add_done_callback(lambda _: self._computing.pop(ask, None))
        shared.waiting += 1
        try:
            return await asyncio.shield(shared.task)
        except _AskError as error:
            status, code = (409, "tuning_impossible") if asked == Ask() else (422, "invalid_parameter")
            raise ProblemError(status, code, str(error)) from error
        except TuningError as error:
            raise ProblemError(409, "tuning_impossible", str(error)) from error
        finally:
            shared.waiting -= 1
            if not shared.waiting and not shared.task.done():
                self._computing.pop(ask, None)
                shared.task.cancel()

    async def _compute(self, ask: Ask, facts: LoopFacts) -> bytes:
        snapshot = self._drive.snapshot()
        motor, setup = _question(self._drive, snapshot, facts, ask)
        tuned = await self._computer.run(tuning_document, motor, setup, ask, facts.log_nominal)
        body = encode(_head(self._drive, snapshot) | tuned)
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


def tuning_document(motor: MotorKnowledge, setup: LoopSetup, ask: Ask, nominal: Any) -> Document:
    """In the computing process: the document without what is of the drive.

    Raises:
        TuningError: no gains can be found.
    """
    from servo_daemon.tuning.document import document
    from servo_daemon.tuning.report import tune

    return document(tune(motor, setup, ask, nominal))


def _question(drive: DriveView, snapshot: Snapshot, facts: LoopFacts, ask: Ask) -> tuple[MotorKnowledge, LoopSetup]:
    """What is to be computed with.

    Raises:
        TuningError: too little is known; `_AskError`: too much is asked for.
    """
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
    return motor, setup


def _head(drive: DriveView, snapshot: Snapshot) -> Document:
    estimate = snapshot.estimate
    return {
        "drive": drive.name,
        "time": None if snapshot.time is None else iso_utc(snapshot.time),
        "samples": 0 if estimate is None else int(estimate.samples),
        "margin_low": None if estimate is None else estimate.health.get("controller_margin_low"),
    }
