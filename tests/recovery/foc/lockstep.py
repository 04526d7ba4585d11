"""Simulated drives of the makes and their drivers, step by step on one clock: the bytes are those of the wire, the
times those of a perfect host, the load of the machine has no part in it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from drivers.polling.poller import Answer
from drivers.registry import make_driver
from servo_daemon.sim_drive.makes.serve import Device

#: From the request to the answer.
TRIP_S = 2e-4


@dataclass
class Clock:
    """Seconds."""

    now_s: float = 0.0

    def __call__(self) -> float:
        return self.now_s


def polled(driver: Any, dialogue: Any, device: Device, clock: Clock, rate_hz: float, n: int) -> Iterator[Any]:
    """Blocks of about 25 ms of a polling driver: n requests of its dialogue, answered by the device."""
    answers: list[Answer[Any]] = []
    for k in range(n):
        clock.now_s = k / rate_hz
        request = dialogue.next_request()
        if request is not None:
            replies = dialogue.feed(device.receive(request.data))
            answers += [Answer(k, clock.now_s, clock.now_s + TRIP_S, reply.value) for reply in replies]
        if len(answers) >= rate_hz / 40 or (k == n - 1 and answers):
            block = driver._samples(answers)
            answers = []
            if block is not None:
                yield block


def closed(kind: str, **options: Any) -> Any:
    """A driver that is never opened: its port exists in no machine."""
    return make_driver(kind, "axis1", {"port": "lockstep", **options})


def closed_can(kind: str, **options: Any) -> Any:
    """A driver on a bus that is never opened."""
    return make_driver(kind, "axis1", {"interface": "virtual", "channel": "lockstep", **options})
