"""Simulated drives of the makes and their drivers, step by step on one clock: the bytes are those of the wire, the
times those of a perfect host, the load of the machine has no part in it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from drivers.base import Driver
from drivers.polling.poller import Answer, Reply
from drivers.registry import make_driver
from servo_daemon.config import DriveConfig
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.samples import SampleBlock, concatenate
from servo_daemon.sim_drive.makes.foc import Pmsm
from servo_daemon.sim_drive.makes.serve import Device

#: From the request to the answer.
TRIP_S = 2e-4
#: From one frame to the next, CAN FD at 1 and 5 Mbit/s behind USB.
FD_FRAME_S = 2.5e-4


@dataclass
class Clock:
    """Seconds."""

    now_s: float = 0.0

    def __call__(self) -> float:
        return self.now_s


#: Carries a request to the device, moves the clock on by what that takes, and has its dialogue read what comes back.
Exchange = Callable[[bytes], Sequence[Reply[Any]]]


def polled(driver: Any, dialogue: Any, device: Device, clock: Clock, rate_hz: float, n: int) -> Iterator[Any]:
    """Blocks of about 25 ms of a polling driver: n requests of its dialogue, answered by the device."""

    def exchange(data: bytes) -> Sequence[Reply[Any]]:
        replies: Sequence[Reply[Any]] = dialogue.feed(device.receive(data))
        clock.now_s += TRIP_S
        return replies

    return exchanged(driver, dialogue, exchange, clock, rate_hz, n)


def by_lines(dialogue: Any, device: Any, clock: Clock) -> Exchange:
    """Of a device that takes frames as lines of text, each of which takes its time."""

    def exchange(data: bytes) -> list[Reply[Any]]:
        replies: list[Reply[Any]] = []
        for command in data.splitlines(keepends=True):
            clock.now_s += FD_FRAME_S
            replies += dialogue.feed(device.receive(command))
        return replies

    return exchange


def exchanged(driver: Any, dialogue: Any, exchange: Exchange, clock: Clock, rate_hz: float, n: int) -> Iterator[Any]:
    """The same over any line."""
    answers: list[Answer[Any]] = []
    for k in range(n):
        clock.now_s = sent_s = k / rate_hz
        request = dialogue.next_request()
        if request is not None:
            replies = exchange(request.data)
            answers += [Answer(k, sent_s, clock.now_s, reply.value) for reply in replies]
        if len(answers) >= rate_hz / 40 or (k == n - 1 and answers):
            block = driver._samples(answers)
            answers = []
            if block is not None:
                yield block


def joined(blocks: Iterable[SampleBlock], most: int = 40) -> Iterator[SampleBlock]:
    """So many blocks in one, as they queue up for a worker; a pipeline says the same of them."""
    waiting: list[SampleBlock] = []
    for block in blocks:
        if waiting and (len(waiting) == most or waiting[-1].channels != block.channels):
            yield concatenate(waiting)
            waiting = []
        waiting.append(block)
    if waiting:
        yield concatenate(waiting)


def claimed(driver: Driver, blocks: Iterable[SampleBlock]) -> dict[str, tuple[float, float]]:
    """What is tracked at the end: value and standard deviation by name."""
    pipeline: Pipeline | None = None
    for block in joined(blocks):
        pipeline = pipeline or Pipeline(DriveConfig(), driver.info, meaning=driver.meaning)
        pipeline.process(block, rows=False)
    assert pipeline is not None
    estimate = pipeline.finish() or pipeline.current()
    assert estimate is not None
    tracked = {p.name: (p.value, p.std) for p in estimate.parameters if p.status == "tracking"}
    return {name: (value, std) for name, (value, std) in tracked.items() if value is not None and std is not None}


def assert_told_by_its_voltage(motor: Pmsm, driver: Driver, blocks: Iterable[SampleBlock], most: float = 0.01) -> None:
    """R and K are claimed and no inductance; all that is lies within `most` of the truth and 4 of its std."""
    truth = {"R": 1.5 * motor.R, "K": motor.Kt, "J": motor.J, "B": motor.B}
    found = claimed(driver, blocks)
    assert {"K", "R"} <= set(found) <= set(truth)
    for name, (value, std) in found.items():
        off = abs(value - truth[name])
        assert off < most * truth[name] and off < 4.0 * std, (name, value / truth[name], std)


def closed(kind: str, **options: Any) -> Any:
    """A driver that is never opened: its port exists in no machine."""
    return make_driver(kind, "axis1", {"port": "lockstep", **options})


def closed_can(kind: str, **options: Any) -> Any:
    """A driver on a bus that is never opened."""
    return make_driver(kind, "axis1", {"interface": "virtual", "channel": "lockstep", **options})
