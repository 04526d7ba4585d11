"""The estimates of one drive as server-sent events.

https://html.spec.whatwg.org/multipage/server-sent-events.html

Every event is `event: estimates`, its data the estimates document, its id the document's `time`: a client that lost the
connection asks `/history?start=<last id>` for what it missed. Documents are never queued: a client that reads slowly
gets fewer of them, each the newest at that moment.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from typing import Final

from servo_daemon.published.snapshot import Snapshot
from servo_daemon.published.units import iso_utc

#: How often a stream looks for a new snapshot, and so the most it sends: 10 a second is more than an eye follows.
PERIOD_S: Final = 0.1
#: A comment after so much silence keeps proxies from closing the stream and finds clients that went away.
HEARTBEAT_S: Final = 10.0
#: What clients are told to wait before they connect again.
RETRY_MS: Final = 2000
#: Streams at the same time; a client that opens more is broken, and each costs memory.
MAX_STREAMS: Final = 64


class StreamSlots:
    """Counts the open streams of one application; used by its event loop only."""

    def __init__(self, limit: int = MAX_STREAMS) -> None:
        self.limit = limit
        self.open = 0

    @property
    def full(self) -> bool:
        return self.open >= self.limit


def frame(snapshot: Snapshot, body: bytes) -> bytes:
    """One event. Before the first samples the id is empty, which for a client means that it has none."""
    event_id = "" if snapshot.time is None else iso_utc(snapshot.time)
    return b"id: %b\nevent: estimates\ndata: %b\n\n" % (event_id.encode(), body)


async def estimates_stream(
    snapshot: Callable[[], Snapshot],
    encode: Callable[[Snapshot], bytes],
    over: Callable[[], bool],
    slots: StreamSlots,
) -> AsyncIterator[bytes]:
    """The bytes of a stream: the document of now, then one for each new snapshot.

    When the client goes away the server cancels this generator at one of its awaits.

    Args:
        snapshot: the drive's last published snapshot.
        encode: the estimates document of a snapshot as JSON on one line.
        over: whether the daemon has been told to stop, or the drive has gone: then the stream ends.
        slots: in which this stream is counted while it is open.
    """
    slots.open += 1
    try:
        yield b"retry: %d\n\n" % RETRY_MS
        sent: Snapshot | None = None
        sent_at = time.monotonic()
        while not over():
            current = snapshot()
            if current is not sent:
                yield frame(current, encode(current))
                sent, sent_at = current, time.monotonic()
            elif time.monotonic() - sent_at >= HEARTBEAT_S:
                yield b": still here\n\n"
                sent_at = time.monotonic()
            await asyncio.sleep(PERIOD_S)
    finally:
        slots.open -= 1
