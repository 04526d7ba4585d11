"""Many drives on pseudo-terminals that cost little: one process plays frames that were encoded beforehand.

Every drive sends the same motor's frames of 10 samples at 1 kHz, each from another moment on, so that no two begin or
step at once. What a reader leaves no room for is lost, as on a UART.

    python -m benchmarks.feeder FOLDER N SECONDS
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from drivers.serial.encoder import BinaryEncoder, describe
from servo_daemon.sim_drive.pty_link import PtyLink
from servo_daemon.simulate import SimulatedDrive, make_settings

RATE_HZ, FRAME = 1000, 10
#: Between the moments at which two drives' recordings begin, s: 37 frames.
_APART_S = 0.37
_FRAME_S = FRAME / RATE_HZ
#: A description goes out every so many frames.
_DESCRIBED_EVERY = 100


def frames(seconds: float) -> tuple[bytes, list[bytes]]:
    """The description and the sample frames of a motor that does not age."""
    drive = SimulatedDrive(make_settings(seed=3, rate_hz=float(RATE_HZ)))
    encoder = BinaryEncoder(describe(drive.info))
    block = drive.next_block(round(seconds * RATE_HZ))
    out = [b"".join(encoder.encode(block.slice(k, k + FRAME))) for k in range(0, len(block), FRAME)]
    return encoder.describe(), out


def play(folder: Path, n: int, seconds: float) -> None:
    """Until the end, or SIGTERM. Frame k of drive j is due k·10 ms after the begin, at a phase of its own."""
    description, out = frames(seconds + n * _APART_S)
    offsets = [round(j * _APART_S / _FRAME_S) for j in range(n)]
    with ExitStack() as stack:
        masters = [stack.enter_context(PtyLink(folder / f"drive{j}")).master for j in range(n)]
        begin = time.monotonic()
        print(begin, flush=True)
        for k in range(round(seconds / _FRAME_S)):
            for j in range(n):
                if j % 8 == 0:  # eight drives at once, the groups spread over the 10 ms
                    time.sleep(max(0.0, begin + (k + j / n) * _FRAME_S - time.monotonic()))
                data = out[offsets[j] + k]
                with contextlib.suppress(BlockingIOError):
                    os.write(masters[j], description + data if k % _DESCRIBED_EVERY == 0 else data)


@contextmanager
def fed_drives(n: int, folder: Path, seconds: float) -> Iterator[tuple[list[Path], float]]:
    """Links of the drives, and when the first frame left (monotonic, s)."""
    command = [sys.executable, "-m", "benchmarks.feeder", str(folder), str(n), str(seconds)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        begin = float(process.stdout.readline())
        yield [folder / f"drive{j}" for j in range(n)], begin
    finally:
        process.terminate()
        process.wait(10)


if __name__ == "__main__":
    play(Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]))
