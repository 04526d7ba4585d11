"""The daemon as a service manager runs it: started anew when it has died, its signs of life listened to."""

from __future__ import annotations

import contextlib
import signal
import socket
import sqlite3
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from benchmarks.daemon import rss_MB
from tests.system.harness import DaemonProgram, environment, wait_for

#: As the unit in deploy/ asks of systemd, s.
WATCHDOG_S = 10


class Signs:
    """The notify socket: when the daemon said that it turns."""

    def __init__(self, path: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        self.longest_s, self.ready = 0.0, 0
        self._last_s: float | None = None
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        with contextlib.suppress(OSError):
            while message := self._socket.recv(4096):
                now = time.monotonic()
                self.ready += b"READY=1" in message
                if b"WATCHDOG=1" in message:
                    if self._last_s is not None:
                        self.longest_s = max(self.longest_s, now - self._last_s)
                    self._last_s = now

    def forget(self) -> None:
        """A life is over: the dead seconds are no gap."""
        self._last_s = None

    def close(self) -> None:
        self._socket.close()


def waited_s(pid: int) -> float:
    """How long its threads were ready to run while others had the processors, s, ended ones left out."""
    total = 0.0
    for path in Path(f"/proc/{pid}/task").glob("*/schedstat"):
        with contextlib.suppress(OSError):
            total += int(path.read_text().split()[1]) * 1e-9
    return total


@dataclass
class Service:
    """Attributes:
    state: its state directory.
    stops_s: how long each clean stop took.
    dropped: rows that the histories of all lives could not keep.
    faults: lines of all logs that no fault of ours explains.
    """

    config: Path
    state: Path
    signs: Signs
    notify: Path
    more: dict[str, str]
    stops_s: list[float] = field(default_factory=list)
    dropped: int = 0
    faults: list[str] = field(default_factory=list)
    _program: DaemonProgram | None = None

    @property
    def program(self) -> DaemonProgram:
        assert self._program is not None
        return self._program

    def start(self) -> None:
        env = {"NOTIFY_SOCKET": str(self.notify), "WATCHDOG_USEC": str(WATCHDOG_S * 1_000_000)} | self.more
        ready = self.signs.ready
        self._program = DaemonProgram("--config", self.config, "--state-dir", self.state, env=environment(**env))
        wait_for(lambda: self.signs.ready > ready, "READY")

    def _over(self) -> None:
        self.signs.forget()
        self.faults += [line for line in self.program.log if "Traceback" in line or " ERROR " in line]
        self.program.end()
        self._program = None

    def stop(self) -> None:
        self.dropped += self.rows_dropped()
        self.stops_s.append(self.program.stop())
        self._over()

    def kill(self) -> None:
        self.program.send(signal.SIGKILL)
        self.program.wait()
        self._over()

    def end(self) -> None:
        if self._program is not None:
            print("\n".join(self.program.log[-40:]))
            self._program.end()

    def documents(self, n: int) -> list[dict[str, Any]]:
        return [self.program.estimates(f"axis{k}") for k in range(n)]

    def rows_dropped(self) -> int:
        text = self.program.client.get("/metrics").text
        (line,) = [t for t in text.splitlines() if "rows_dropped" in t and not t.startswith("#")]
        return int(float(line.rsplit(" ", 1)[1]))

    def memory_MB(self) -> float:
        return rss_MB(self.program.process.pid)

    def last_row_s(self, drive: str, before_s: float) -> float:
        """The last moment of its history in the minute before that one, s since the epoch; without one its start."""
        began_s = before_s - 60.0
        words = f"parameter=R&start={began_s:.3f}&end={before_s:.3f}&points=20000"
        ask = lambda: self.program.get(f"/drives/{drive}/history?{words}")  # noqa: E731
        # While its database is being opened an answer is what memory has, and says so.
        times = wait_for(lambda: (d := ask())["note"] is None and d, "the history is read")["time"]
        return max((datetime.fromisoformat(t).timestamp() for t in times), default=began_s)


def corrupt(state: Path) -> Sequence[str]:
    """What is broken in a state directory: files set aside, and what SQLite finds in the history."""
    found = sorted(p.name for p in state.iterdir() if ".bad" in p.name or ".corrupt" in p.name)
    with contextlib.closing(sqlite3.connect(state / "history.sqlite")) as file:
        verdict = file.execute("PRAGMA integrity_check").fetchone()[0]
    return found if verdict == "ok" else [*found, f"history.sqlite: {verdict}"]
