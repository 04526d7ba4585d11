"""One line of servos, shared by the drives on it: one thread asks for all of them together."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar

from drivers.base import DriverCounters
from drivers.polling.driver import GATHER_S
from drivers.polling.link import Link
from drivers.polling.poller import Answer, Pace, Poller, Reply, Request
from drivers.servo_bus.families import Family
from servo_daemon.errors import DriverConfigError

#: Tags of requests: the registers of all servos, or the model of one.
_STATE, _IDENTITY = -1, 0
#: A servo that misses so many rounds in a row is left out of them, and asked by itself now and then.
_PATIENCE_ROUNDS = 3
_AGAIN_S = 1.0
#: Answers that wait for a drive that does not read: half a minute at 250 Hz.
_MOST_WAITING = 8192


@dataclass(frozen=True, slots=True)
class State:
    """Registers of one servo, and its error byte."""

    data: bytes
    error: int


@dataclass(slots=True, eq=False)
class Place:
    """A drive's place in the chain: its answers wait here."""

    servo: int
    counters: DriverCounters
    answers: deque[Answer[State]] = field(default_factory=lambda: deque(maxlen=_MOST_WAITING))
    model: int | None = None  # its number, once it has said it


Round = dict[int, State]


class ChainDialogue:
    """What the servos are asked: each for its model first, then all that answer for their registers."""

    def __init__(self, family: Family, servos: tuple[int, ...]) -> None:
        self._family = family
        self._decoder = family.decoder()
        self._absent = dict.fromkeys(servos, 0.0)  # when it is to be asked for its model
        self._missed = dict.fromkeys(servos, 0)
        self._asked: tuple[int, ...] = ()
        self._round: Round = {}
        self.models: dict[int, int] = {}

    @property
    def errors(self) -> tuple[int, int]:
        """Wrong check sums, and runs of bytes that are no packet, so far."""
        return self._decoder.crc_errors, self._decoder.framing_errors

    def next_request(self) -> Request | None:
        self._close_round()
        now, family = time.monotonic(), self._family
        due = [servo for servo, when in self._absent.items() if when <= now]
        if due:
            self._absent[due[0]] = now + _AGAIN_S
            self._asked = ()
            return Request(family.read(due[0], *family.identity), _IDENTITY + due[0])
        self._asked = tuple(servo for servo in self._missed if servo not in self._absent)
        self._round = {}
        if not self._asked:
            return None
        if len(self._asked) == 1:
            return Request(family.read(self._asked[0], family.address, family.length), _STATE)
        return Request(family.sync_read(self._asked), _STATE)

    def _close_round(self) -> None:
        """Who has not answered in the last round."""
        for servo in self._asked:
            self._missed[servo] = 0 if servo in self._round else self._missed[servo] + 1
            if self._missed[servo] >= _PATIENCE_ROUNDS:
                self._absent[servo] = time.monotonic()
        self._asked = ()

    def feed(self, data: bytes) -> list[Reply[Round]]:
        replies: list[Reply[Round]] = []
        for servo, error, content in self._decoder.feed(data):
            if servo in self._absent and len(content) == self._family.identity[1]:
                self.models[servo] = int.from_bytes(content[:2], "little")
                del self._absent[servo]
                self._missed[servo] = 0
                replies.append(Reply(_IDENTITY + servo, {}))
            elif servo in self._asked and len(content) == self._family.length:
                self._round[servo] = State(content, error)
                if servo == self._asked[-1]:  # they answer in the order in which they are asked
                    replies.append(Reply(_STATE, self._round))
        return replies


class Chain:
    """An open line and its thread; made by `join`, gone with its last drive."""

    _open: ClassVar[dict[str, Chain]] = {}
    _open_lock: ClassVar[threading.Lock] = threading.Lock()

    def __init__(self, link: Link, settings: tuple[object, ...], family: Family, pace: Pace) -> None:
        self._link, self._settings, self._family, self._pace = link, settings, family, pace
        self._ready = threading.Condition()
        self._places: tuple[Place, ...] = ()
        self._stopping = self._released = False
        self._failure: str | None = None
        self._extra: dict[str, int] = {}  # counts of all its pollers, one after the other
        self._thread = threading.Thread(target=self._run, name="servo-chain", daemon=True)

    @classmethod
    def join(
        cls, port: str, settings: tuple[object, ...], place: Place, open_link: Callable[[], Link], family: Family,
        pace: Pace,
    ) -> Chain:  # fmt: skip
        """The chain on this port, opened if no other drive has it open.

        Args:
            settings: what all its drives must agree on.

        Raises:
            DriverUnavailableError: the port cannot be opened now.
            DriverConfigError: it can never be, or is open with other settings, or the servo has a drive already.
        """
        with cls._open_lock:
            chain = cls._open.get(port)
            if chain is None or chain._failure is not None:
                chain = cls(open_link(), settings, family, pace)
                chain._places = (place,)
                cls._open[port] = chain
                chain._thread.start()
                return chain
            if chain._settings != settings:
                raise DriverConfigError(f"{port} is open for another drive with other settings")
            if any(p.servo == place.servo for p in chain._places):
                raise DriverConfigError(f"{port}: servo {place.servo} has a drive already")
            with chain._ready:
                chain._places = (*chain._places, place)
            return chain

    def leave(self, place: Place) -> None:
        """Take a drive away; the last one closes the line. Never raises."""
        with self._open_lock:
            with self._ready:
                self._places = tuple(p for p in self._places if p is not place)
                self._stopping = not self._places
                if self._stopping and not self._released:
                    self._link.wake()
                self._ready.notify_all()
            if self._stopping:
                for port, chain in tuple(self._open.items()):
                    if chain is self:
                        del self._open[port]
                self._thread.join()

    def wait(self, place: Place, timeout_s: float, closed: Callable[[], bool]) -> list[Answer[State]]:
        """The answers of a drive's servo, within `timeout_s`; none at its end.

        Raises:
            ConnectionError: the line is gone.
        """
        with self._ready:
            self._ready.wait_for(lambda: place.answers or self._failure is not None or closed(), timeout_s)
            taken = list(place.answers)
            place.answers.clear()
            if not taken and self._failure is not None and not closed():
                raise ConnectionError(self._failure)
            return taken

    def _run(self) -> None:
        try:
            while not self._stopping:
                self._ask(self._places)
        except Exception as error:  # whatever the port raises, the drives must hear of it
            with self._ready:
                self._failure = f"{type(error).__name__}: {error}"
                self._ready.notify_all()
        finally:
            with self._ready:
                self._released = True
                self._link.close()

    def _ask(self, places: tuple[Place, ...]) -> None:
        """Ask for these drives, until there are others."""
        dialogue = ChainDialogue(self._family, tuple(p.servo for p in places))
        numbered = self._extra.get("polls_sent", 0)  # requests of pollers before this one
        poller = Poller(self._link, dialogue, self._pace, self._extra)
        errors, answers = (0, 0), list[Answer[Round]]()
        while self._places is places and not self._stopping:
            now = time.monotonic()
            until_s = answers[0].received_s + GATHER_S if answers else now + _AGAIN_S
            answers += poller.step(until_s)
            fresh = dialogue.errors
            if fresh != errors or (answers and time.monotonic() >= answers[0].received_s + GATHER_S):
                for place in places:
                    place.counters.crc_errors += fresh[0] - errors[0]
                    place.counters.framing_errors += fresh[1] - errors[1]
                self._hand_out(places, answers, dialogue, numbered)
                errors, answers = fresh, []
        self._hand_out(places, answers, dialogue, numbered)

    def _hand_out(
        self, places: tuple[Place, ...], answers: list[Answer[Round]], dialogue: ChainDialogue, numbered: int
    ) -> None:
        with self._ready:
            for place in places:
                place.model = dialogue.models.get(place.servo, place.model)
                place.counters.extra |= self._extra
                servo = place.servo
                place.answers += [
                    Answer(numbered + a.number, a.sent_s, a.received_s, a.value[servo])
                    for a in answers
                    if servo in a.value
                ]
            self._ready.notify_all()
