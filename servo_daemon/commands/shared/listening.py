"""What a drive sends while somebody listens."""

from __future__ import annotations

import time
from collections.abc import Iterator

from drivers.base import Driver
from servo_daemon.samples import SampleBlock

#: Longest wait for a block, s: so exactly the time is kept.
_WAIT_S = 0.1


def heard(driver: Driver, seconds: float) -> Iterator[SampleBlock]:
    """Blocks of an open driver within so many seconds.

    Raises:
        DriverError: see `Driver.read`.
    """
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        block = driver.read(_WAIT_S)
        if block is not None:
            yield block
