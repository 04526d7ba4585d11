"""Requests at a steady pace, and the answers that belong to them.

Requests leave at absolute deadlines, so that a late one does not delay those after it; a few may be on their way
together. A drive that does not answer is asked more and more seldom, until it does.

When an answer's values were taken lies between the request's leaving and the answer's arrival. The sample gets the
time at which its request left: the drive takes its values an almost constant time later, while arrival also waits for
the line and for the host. How much longer than the shortest the round trips take is published as the jitter.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, NamedTuple, Protocol, TypeVar

from drivers.polling.link import Link

V = TypeVar("V")

#: So many requests in a row without an answer, and the drive is asked half as often, down to once in so many seconds.
_PATIENCE = 3
_LONGEST_PAUSE_S = 1.0
#: Rate and jitter are those of so long a time.
_WINDOW_S = 2.0
#: An answer need not be waited for where the last so many that were came within this share of the period.
_KNOWN, _EARLY = 4, 0.5


@dataclass(frozen=True, slots=True)
class Request:
    """What is sent. An answer with another tag is not the answer to it."""

    data: bytes
    tag: int = 0


class Reply(NamedTuple, Generic[V]):
    """What came back: the tag of its request, and the value."""

    tag: int
    value: V


class Answer(NamedTuple, Generic[V]):
    """A reply with its place in time.

    Attributes:
        number: of its request, counted from 0; a missing one was asked and not answered.
        sent_s, received_s: monotonic host clock. Of an answer that was not waited for, `received_s` is when it had come
            by what the last round trips took.
    """

    number: int
    sent_s: float
    received_s: float
    value: V


class Dialogue(Protocol[V]):
    """What one kind of drive is asked and how it answers; knows nothing of time."""

    def next_request(self) -> Request | None:
        """What to send now; None: nothing at this time."""
        ...

    def feed(self, data: bytes) -> list[Reply[V]]:
        """The replies that these bytes complete. Bytes that are none are counted, never raised."""
        ...


@dataclass(frozen=True, slots=True)
class Pace:
    """How a drive is asked.

    Attributes:
        rate_hz: requests a second.
        together: requests that may be on their way at once; 1 where the line carries one direction at a time, or where
            one answer looks like the next (all have one tag): a lost one would shift all that follow.
        timeout_s: a request without an answer for so long is given up.
        watched: one of so many answers is waited for; the others, where they come early, are read together before the
            next of these requests. No two of so many requests in a row have one tag.
    """

    rate_hz: float
    together: int = 1
    timeout_s: float = 0.1
    watched: int = 1


class Poller(Generic[V]):
    """Asks over a link and collects the answers.

    Args:
        extra: counted up here: polls sent, answered, timed out, missed (not sent: no room or too late) and answers
            that nobody asked for; `poll_rate_hz` and `poll_jitter_us` are those of the last seconds.
        clock: monotonic host clock, s.
    """

    def __init__(
        self,
        link: Link,
        dialogue: Dialogue[V],
        pace: Pace,
        extra: dict[str, int],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._link, self._dialogue, self._pace, self._extra, self._clock = link, dialogue, pace, extra, clock
        self._due_s = clock()
        self._on_their_way: deque[tuple[int, int, float, float]] = deque()  # number, tag, before and after it was sent
        self._number = 0
        self._resting = False  # the last request's answer is not waited for
        self._last_trips: deque[float] = deque(maxlen=_KNOWN)
        self._unanswered = 0  # in a row
        self._period_s = 1.0 / pace.rate_hz
        self._window = (clock(), 0)  # when it began, answered before
        self._trips: list[float] = []  # what they took, of those in the window that were waited for
        for name in ("sent", "answered", "timed_out", "missed", "unasked"):
            extra.setdefault(f"polls_{name}", 0)

    @property
    def period_s(self) -> float:
        """From one request to the next now."""
        return self._period_s

    def _slower(self, unanswered: int) -> None:
        """So many requests in a row have not been answered."""
        self._unanswered = unanswered
        halvings = max(0, self._unanswered - _PATIENCE + 1)
        slowest = max(1 / self._pace.rate_hz, _LONGEST_PAUSE_S)
        self._period_s = min(slowest, 2.0 ** min(halvings, 30) / self._pace.rate_hz)

    def step(self, until_s: float) -> list[Answer[V]]:
        """Send what is due and wait for answers: until there are some, at most until then, or until the link is woken.

        Raises:
            OSError: the link is gone.
        """
        clock = self._clock
        now = clock()
        while True:
            answers = self._come() if self._has_to_look(now) else []
            self._give_up(now)
            if now >= self._due_s:
                self._send_due(now)
                now = clock()
            if answers:
                return answers
            if self._may_rest():
                self._resting = True
                if self._link.pause(min(until_s, self._due_s) - now) or (now := clock()) >= until_s:
                    return []
                continue
            wait_s = min(until_s, self._next_event())
            data = self._link.receive(wait_s - now)
            if data and (answers := self._matched(self._dialogue.feed(data))):
                return answers
            now = clock()
            if now >= until_s or (not data and now < wait_s):
                return []

    def _is_watched(self, number: int) -> bool:
        return number % self._pace.watched == 0

    def _has_to_look(self, now: float) -> bool:
        """Whether it is time for the answers that were not waited for; and, after a pause of the host, for those that
        came meanwhile, before they are given up."""
        return self._is_overdue(now) or (self._resting and now >= self._due_s and self._is_watched(self._number))

    def _is_overdue(self, now: float) -> bool:
        return bool(self._on_their_way) and now >= self._on_their_way[0][2] + self._pace.timeout_s

    def _may_rest(self) -> bool:
        """Whether nothing has to be waited for but the next request's time."""
        trips, pace = self._last_trips, self._pace
        if not self._on_their_way or self._is_watched(self._number - 1) or len(trips) < _KNOWN:
            return False
        return max(trips) < _EARLY * self._period_s < _EARLY * pace.timeout_s / pace.watched

    def _come(self) -> list[Answer[V]]:
        """The answers that are there. Where one has not come the next ones are waited for."""
        data = self._link.receive(0.0)
        answers = self._matched(self._dialogue.feed(data)) if data else []
        self._resting = False
        if self._on_their_way:
            self._last_trips.clear()
        return answers

    def _next_event(self) -> float:
        if not self._on_their_way:
            return self._due_s
        oldest = self._on_their_way[0][2] + self._pace.timeout_s
        return min(self._due_s, oldest) if len(self._on_their_way) < self._pace.together else oldest

    def _give_up(self, now: float) -> None:
        """After a time-out nothing that is on its way is waited for, and the line has time to fall silent: a late
        answer must not be taken for the answer to a later request."""
        if self._is_overdue(now):
            self._count("timed_out", len(self._on_their_way))
            self._on_their_way.clear()
            self._slower(self._unanswered + 1)
            self._due_s = now + max(self.period_s, self._pace.timeout_s)

    def _send_due(self, now: float) -> None:
        if now - self._due_s >= self._period_s:
            late = int((now - self._due_s) / self._period_s)
            self._count("missed", late)
            self._due_s += late * self._period_s
        if len(self._on_their_way) >= self._pace.together and not self._resting:
            return
        self._due_s += self._period_s
        request = self._dialogue.next_request()
        if request is None:
            return
        began_s = self._clock()
        self._link.send(request.data)
        self._on_their_way.append((self._number, request.tag, began_s, self._clock()))
        self._number += 1
        self._count("sent")

    def _matched(self, replies: list[Reply[V]]) -> list[Answer[V]]:
        now = self._clock()
        waiting, answers = self._on_their_way, []
        for reply_tag, value in replies:
            if not any(sent[1] == reply_tag for sent in waiting):
                self._count("unasked")
                continue
            number, tag, sent_s, gone_s = waiting.popleft()
            while tag != reply_tag:  # drives answer in the order in which they were asked: that answer is lost
                self._count("timed_out")
                number, tag, sent_s, gone_s = waiting.popleft()
            if self._unanswered:
                self._slower(0)
            received_s = now
            if self._resting:
                received_s = min(now, gone_s + max(self._last_trips))
            else:
                self._last_trips.append(now - sent_s)
                self._trips.append(now - sent_s)
            answers.append(Answer(number, sent_s, received_s, value))
        self._count("answered", len(answers))
        if now - self._window[0] >= _WINDOW_S:
            self._measure(now)
        return answers

    def _measure(self, now: float) -> None:
        """Rate and jitter, once in `_WINDOW_S`."""
        (began_s, before), answered, trips = self._window, self._extra["polls_answered"], self._trips
        self._extra["poll_rate_hz"] = round((answered - before) / (now - began_s))
        if trips:
            least = min(trips)
            mean_square = sum((took - least) ** 2 for took in trips) / len(trips)
            self._extra["poll_jitter_us"] = round(math.sqrt(mean_square) * 1e6)
        self._window, self._trips = (now, answered), []

    def _count(self, what: str, n: int = 1) -> None:
        self._extra[f"polls_{what}"] += n
