"""What is done to the daemon: each function hurts it for some seconds and returns once it has recovered."""

from __future__ import annotations

import contextlib
import os
import resource
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import httpx

from benchmarks.soak.clock import WallClock
from benchmarks.soak.drives import Drives
from benchmarks.soak.service import Service
from tests.mosquitto import Broker
from tests.system.harness import wait_for

#: Holds the history exclusively until its stdin ends.
_LOCKER = """
import sqlite3, sys
file = sqlite3.connect(sys.argv[1], timeout=60, isolation_level=None)
file.execute("BEGIN EXCLUSIVE")
print("held", flush=True)
sys.stdin.read()
"""
#: Between two questions whether the daemon has noticed or recovered, s: they are no flood.
_ASK_S = 0.2
READERS = 200
FLOODERS = 8
#: What the flood asks for: cheap, dear, wrong and forbidden things. Answers below 500, and 503, are right.
_ASKED = (
    "/drives/axis0/estimates",
    "/drives/axis1/history?parameter=R&window=1h&points=20000",
    "/drives/axis2/tuning?bandwidth_hz={k}",
    "/fleet",
    "/drives/none/estimates",
    "/drives/axis0/history?parameter=%00&points=x",
    "/drives/axis3/events?limit=500",
)


@dataclass
class World:
    """Attributes:
    hurt_s: how long each fault lasts.
    turn: counts up, so that faults of one drive meet another each time.
    wrong: answers of the API that were none.
    """

    service: Service
    drives: Drives
    broker: Broker | None
    clock: WallClock
    disk_is_small: bool
    hurt_s: float
    turn: int = 0
    wrong: int = 0

    @property
    def chosen(self) -> int:
        """A drive, on each wire in turn."""
        n, serial = len(self.drives.links), self.drives.serial
        return self.turn // 2 % serial if self.turn % 2 == 0 else serial + self.turn // 2 % (n - serial)

    def problems(self) -> list[str]:
        return self.service.program.get("/health")["problems"]  # type: ignore[no-any-return]


def port_loss(world: World) -> set[int]:
    """The terminal is taken away with the cable, and another is there afterwards."""
    chosen, program = world.chosen, world.service.program
    world.drives.tell(f"unplug {chosen}")
    program.until(lambda d: d["health"]["connection"] == "down", "the loss is told", f"axis{chosen}")
    time.sleep(world.hurt_s)
    world.drives.tell(f"plug {chosen}")
    program.until(lambda d: d["health"]["connection"] == "connected", "it is back", f"axis{chosen}")
    return {chosen}


def garbage(world: World) -> set[int]:
    """Ten bursts on every wire, each between two frames."""
    for _ in range(10):
        for k in range(len(world.drives.links)):
            world.drives.tell(f"garbage {k}")
        time.sleep(world.hurt_s / 10)
    return set()


def drive_restart(world: World) -> set[int]:
    """Time, numbering and position begin at 0."""
    name = f"axis{world.chosen}"
    before = world.service.program.estimates(name)["health"]["device_restarts"]
    world.drives.tell(f"restart {world.chosen}")
    world.service.program.until(lambda d: d["health"]["device_restarts"] > before, "it is noticed", name)
    return set()


def broker_loss(world: World) -> set[int]:
    """The MQTT broker is killed and comes back."""
    assert world.broker is not None
    world.broker.kill()
    time.sleep(world.hurt_s)
    world.broker.start()
    sink = lambda: world.service.program.get("/health")["sinks"]["mqtt"]  # noqa: E731
    sent = lambda: sink()["connected"] and sink()["waiting"] <= len(world.drives.links)  # noqa: E731
    wait_for(sent, "what was kept is sent", every_s=_ASK_S)
    world.wrong += sink()["dropped"]
    return set()


def database_locked(world: World) -> set[int]:
    """Another process holds the history's exclusive lock, longer than the daemon waits for it (2 s)."""
    command = [sys.executable, "-c", _LOCKER, str(world.service.state / "history.sqlite")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as locker:
        assert locker.stdin is not None and locker.stdout is not None
        locker.stdout.readline()
        wait_for(world.problems, "it is told", every_s=_ASK_S)
        time.sleep(world.hurt_s)
        locker.stdin.close()
        wait_for(lambda: not world.problems(), "the history is written again", every_s=_ASK_S)
    return set()


def disk_full(world: World) -> set[int]:
    """Not a byte is left in the state directory's file system; else no file of the daemon may grow."""
    if world.disk_is_small:
        filler = world.service.state / "filler"
        with contextlib.suppress(OSError), filler.open("wb", buffering=0) as file:
            while file.write(bytes(65536)) == 65536:
                pass
        free = filler.unlink
    else:
        pid = world.service.program.process.pid
        before = resource.prlimit(pid, resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))
        free = lambda: resource.prlimit(pid, resource.RLIMIT_FSIZE, before)  # noqa: E731
    wait_for(world.problems, "it is told", every_s=_ASK_S)
    time.sleep(world.hurt_s)
    free()
    wait_for(lambda: not world.problems(), "everything is written again", every_s=_ASK_S)
    return set()


def api_flood(world: World) -> set[int]:
    """Clients that ask as fast as they are answered."""
    end = time.monotonic() + world.hurt_s

    def ask(first: int) -> None:
        with httpx.Client(base_url=world.service.program.url, trust_env=False, timeout=60) as client:
            k = first
            while time.monotonic() < end:
                status = client.get("/api/v1" + _ASKED[k % len(_ASKED)].format(k=1 + k % 50)).status_code
                world.wrong += status >= 500 and status != 503
                k += 1

    threads = [threading.Thread(target=ask, args=(k,)) for k in range(FLOODERS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return set()


def sleeping_readers(world: World) -> set[int]:
    """Clients that ask for a stream and never read."""
    address = httpx.URL(world.service.program.url)
    with contextlib.ExitStack() as stack:
        for k in range(READERS):
            line = stack.enter_context(socket.create_connection((address.host, address.port or 80), timeout=30))
            line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            with contextlib.suppress(OSError):  # those beyond 128 are told so and closed
                line.sendall(f"GET /api/v1/drives/axis{k % 8}/stream HTTP/1.1\r\nHost: {address.host}\r\n\r\n".encode())
        time.sleep(world.hurt_s)
    wait_for(lambda: _answers(world), "others are answered again")
    return set()


def _answers(world: World) -> bool:
    try:
        return httpx.get(f"{world.service.program.url}/api/v1/drives", trust_env=False).status_code == 200
    except httpx.TransportError:
        return False


def clock_steps(world: World) -> set[int]:
    """The wall clock an hour ahead, an hour back, and right again."""
    for offset_s in (3600.0, -3600.0, 0.0):
        world.clock.set(offset_s)
        time.sleep(world.hurt_s / 2)
        world.service.program.get("/drives/axis0/history?parameter=R&window=1h")
    return set()


FAULTS: Mapping[str, Callable[[World], set[int]]] = {
    "port loss": port_loss,
    "garbage": garbage,
    "drive restart": drive_restart,
    "broker loss": broker_loss,
    "database locked": database_locked,
    "disk full": disk_full,
    "API flood": api_flood,
    "200 streams that nobody reads": sleeping_readers,
    "clock steps": clock_steps,
}


@contextlib.contextmanager
def small_disk(folder: Path, megabytes: int = 64) -> Iterator[bool]:
    """A file system of its own at `folder`, in memory; whether it could be had (root)."""
    mounted = False
    if os.geteuid() == 0:
        command = ["mount", "-t", "tmpfs", "-o", f"size={megabytes}m,mode=0700", "servo-daemon-soak", str(folder)]
        mounted = subprocess.run(command, capture_output=True, check=False).returncode == 0
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", "-l", str(folder)], check=False)
