"""Requests and their answers, on a line and a clock that the test moves."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from drivers.polling.poller import Answer, Pace, Poller, Reply, Request


class Line:
    """A drive that answers after `delay_s`, whose answers may be lost, and a clock that moves only while waiting."""

    def __init__(self, delay_s: float = 0.002, answers: Callable[[int], bool] = lambda k: True) -> None:
        self.now, self.delay_s, self.answers = 0.0, delay_s, answers
        self.sent: list[tuple[float, bytes]] = []
        self._coming: list[tuple[float, bytes]] = []
        self.waits = 0

    def clock(self) -> float:
        return self.now

    def send(self, data: bytes) -> None:
        if self.answers(len(self.sent)):
            self._coming.append((self.now + self.delay_s, data))
        self.sent.append((self.now, data))

    def pause(self, seconds: float) -> bool:
        self.waits += 1
        self.now += max(seconds, 0.0)
        return False

    def receive(self, timeout_s: float) -> bytes:
        self.waits += timeout_s > 0.0
        if timeout_s <= 0.0:  # all that is there
            data = b"".join(d for arrives, d in self._coming if arrives <= self.now)
            self._coming = [c for c in self._coming if c[0] > self.now]
            return data
        end = self.now + max(timeout_s, 1e-9)
        if self._coming and self._coming[0][0] <= end:
            arrives, data = self._coming.pop(0)
            self.now = max(self.now, arrives)
            return data
        self.now = end
        return b""

    def wake(self) -> None: ...

    def close(self) -> None: ...


class Counting:
    """Asks for the numbers 0, 1, 2, … (modulo 256), with `tags` tags taken in turn."""

    def __init__(self, tags: int = 1) -> None:
        self.asked, self._tags = 0, tags

    def next_request(self) -> Request | None:
        number, self.asked = self.asked, self.asked + 1
        return Request(bytes([number % 256]), number % self._tags)

    def feed(self, data: bytes) -> list[Reply[int]]:
        return [Reply(byte % self._tags, byte) for byte in data]


def run(line: Line, seconds: float, pace: Pace, tags: int = 1) -> tuple[list[Answer[int]], dict[str, int]]:
    extra: dict[str, int] = {}
    poller = Poller(line, Counting(tags), pace, extra, line.clock)
    answers: list[Answer[int]] = []
    while line.now < seconds:
        answers += poller.step(seconds)
    return answers, extra


def test_requests_leave_at_the_rate_and_answers_carry_the_time_of_theirs() -> None:
    answers, extra = run(line := Line(), 3.0, Pace(200.0))
    assert [a.value for a in answers] == [n % 256 for n in range(len(answers))]
    assert 598 <= len(answers) <= 601
    for answer in answers:
        assert answer.sent_s == pytest.approx(answer.number * 0.005, abs=1e-9)
        assert answer.received_s == pytest.approx(answer.sent_s + line.delay_s, abs=1e-9)
    assert (extra["polls_missed"], extra["polls_timed_out"], extra["polls_unasked"]) == (0, 0, 0)
    assert extra["poll_rate_hz"] == 200 and extra["poll_jitter_us"] == 0


def test_requests_are_pipelined_where_the_line_allows_it() -> None:
    """Answers take 8 ms at 200 Hz: one after the other 125 a second come, two together all 200."""
    _, alone = run(Line(0.008), 2.0, Pace(200.0, together=1))
    _, paired = run(Line(0.008), 2.0, Pace(200.0, together=2))
    assert alone["polls_answered"] < 252 and alone["polls_missed"] > 140
    assert paired["polls_answered"] >= 397 and paired["polls_missed"] == 0


def test_a_lost_answer_is_not_taken_for_the_next_ones() -> None:
    for tags, together in ((1, 1), (4, 2)):
        answers, extra = run(Line(0.008, lambda k: k % 50 != 7), 3.0, Pace(200.0, together), tags)
        assert [a.value for a in answers] == [a.number % 256 for a in answers]
        assert 3 <= extra["polls_timed_out"] <= extra["polls_sent"] // 50 + 1
        assert extra["polls_answered"] + extra["polls_timed_out"] >= extra["polls_sent"] - together


def test_a_drive_that_does_not_answer_is_asked_ever_more_seldom_until_it_does() -> None:
    line = Line(answers=lambda k: k >= 14)
    answers, extra = run(line, 20.0, Pace(200.0, together=1, timeout_s=0.05))
    gaps = [b[0] - a[0] for a, b in zip(line.sent[:13], line.sent[1:14], strict=True)]
    assert gaps[0] == pytest.approx(0.1) and gaps[-1] == pytest.approx(1.05)
    assert extra["polls_timed_out"] == 14
    assert answers[0].number == 14 and answers[20].sent_s - answers[10].sent_s == pytest.approx(0.05)


def test_an_answer_nobody_asked_for_is_counted_and_left() -> None:
    line = Line()
    line._coming.append((0.001, b"\x07"))
    extra: dict[str, int] = {}
    poller = Poller(line, Counting(4), Pace(200.0), extra, line.clock)
    poller.step(0.0015)
    assert extra["polls_unasked"] == 1 and extra["polls_answered"] == 0


def test_early_answers_are_read_together_and_waited_for_now_and_then() -> None:
    """One wait a request and not two; each answer still has the time of its own request and round trip."""
    every, _ = run(each := Line(0.0005), 2.2, Pace(500.0, together=2), 4)
    answers, extra = run(line := Line(0.0005), 2.2, Pace(500.0, together=2, watched=4), 4)
    assert len(every) - 4 <= len(answers) <= len(every)
    assert [a.value for a in answers] == [a.value for a in every][: len(answers)]
    for answer in answers:
        assert answer.received_s - answer.sent_s == pytest.approx(0.0005, abs=1e-9)
        assert answer.sent_s == pytest.approx(answer.number * 0.002, abs=1e-9)
    assert line.waits < 0.66 * each.waits
    assert extra["poll_rate_hz"] == pytest.approx(500, abs=3) and extra["poll_jitter_us"] == 0
    assert (extra["polls_missed"], extra["polls_timed_out"], extra["polls_unasked"]) == (0, 0, 0)


def test_a_lost_answer_that_was_not_waited_for_is_not_taken_for_the_next_ones() -> None:
    answers, extra = run(Line(0.0005, lambda k: k % 50 not in (7, 8)), 3.0, Pace(500.0, together=2, watched=4), 4)
    assert [a.value for a in answers] == [a.number % 256 for a in answers]
    assert len(answers) > 600 and extra["polls_timed_out"] > 10  # each time the line gets two time-outs of silence


def test_answers_that_came_while_the_host_paused_are_not_given_up() -> None:
    line = Line(0.0005)
    extra: dict[str, int] = {}
    poller, answers = Poller(line, Counting(4), Pace(500.0, together=2, watched=4), extra, line.clock), []
    while line.now < 2.0:
        answers += poller.step(2.0 if line.now > 0.3 else line.now + 0.05)
        line.now += 0.3 if 0.3 < line.now < 0.31 else 0.0
    assert [a.value for a in answers] == [a.number % 256 for a in answers]
    assert extra["polls_timed_out"] == 0 and extra["polls_unasked"] == 0


def test_answers_that_get_late_are_waited_for() -> None:
    line = Line(0.0005)
    extra: dict[str, int] = {}
    poller, answers = Poller(line, Counting(4), Pace(500.0, together=2, watched=4), extra, line.clock), []
    while line.now < 2.0:
        answers += poller.step(2.0)
        line.delay_s = 0.0005 if line.now < 1.0 else 0.003
    late = [a for a in answers if a.sent_s > 1.02]
    assert len(late) > 450 and all(a.received_s - a.sent_s == pytest.approx(0.003, abs=1e-9) for a in late)
    assert [a.value for a in answers] == [a.number % 256 for a in answers]
