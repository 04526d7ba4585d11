"""The course of a soak: rounds of faults in one life of the daemon, then many lives that end in the middle."""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks.daemon import PLAIN
from benchmarks.soak.clock import WallClock
from benchmarks.soak.drives import drives
from benchmarks.soak.faults import FAULTS, World, api_flood, small_disk
from benchmarks.soak.service import Service, Signs, corrupt, waited_s
from benchmarks.soak.tally import SERIAL, SLCAN, Quiet, Stretch, Tally
from servo_daemon.simulate import DEFAULT_NOMINAL
from tests.mosquitto import HOST, Broker
from tests.system.harness import wait_for

DRIVES = SERIAL + SLCAN
#: Samples in the daemon have not changed for so long: all that was sent is there, s. Its turns are 40 ms apart.
_SETTLED_S = 0.4
#: A pause is longer than the devices' memory for being late, 1 s: they go on from now instead of catching up.
_PAUSE_S = 1.1
#: Pauses in which a drive may be found to have lost nothing; where nothing is known yet, the first so many decide. Of a
#: CAN drive one in seven found samples waiting on a machine with a load of 8.
_TRIES, _FIRST_TRIES = 8, 3
#: Until the next of them, s: several Syncs.
_BETWEEN_S = 0.3
_NOMINAL = "[drive.nominal]\n" + "".join(f"{k} = {v}\n" for k, v in DEFAULT_NOMINAL.items())


@dataclass(frozen=True)
class Plan:
    """Attributes:
    rounds: of all faults.
    lives: that follow; each ends by SIGKILL, every fifth by a stop while clients ask.
    hurt_s: how long a fault lasts.
    life_s: between a life's two comparisons.
    """

    rounds: int
    lives: int
    hurt_s: float = 3.0
    life_s: float = 4.0


def configuration(links: list[Path], broker: Broker | None) -> str:
    text = "[storage]\nsave_interval_s = 1.0\n"
    if broker is not None:
        text += f'[mqtt]\nhost = "{HOST}"\nport = {broker.port}\nnode = "soak"\n'
    for k, link in enumerate(links):
        can = k >= SERIAL
        options = f'interface = "slcan"\nchannel = "{link}"\n' if can else f'port = "{link}"\n'
        text += f'[[drive]]\nname = "axis{k}"\ndriver = "{"can" if can else "serial"}"\n'
        text += f"{PLAIN}{_NOMINAL}[drive.options]\n{options}"
    return text


def quiet(world: World, last: Quiet | None = None, exempt: Iterable[int] = ()) -> Quiet:
    """The drives pause, and what was sent and received is counted.

    A CAN drive's last samples may wait in the decoder for the Sync that dates them, and a machine without time may
    leave some of them anywhere: so where a drive is further behind than at the `last` count, it is asked again after a
    moment of running. What is lost stays lost.
    """
    known = [math.inf if last is None or k in exempt else last.behind[k] for k in range(DRIVES)]
    tries = [_pause(world)]
    while len(tries) < _TRIES:
        behind = [min(some) for some in zip(*(t.behind for t in tries), strict=True)]
        enough = len(tries) >= _FIRST_TRIES or math.inf not in known
        if enough and all(now <= before for now, before in zip(behind, known, strict=True)):
            break
        time.sleep(_BETWEEN_S)
        tries.append(_pause(world))
    late_s = max(t.late_s for t in tries)
    return replace(tries[-1], behind=tuple(map(min, zip(*(t.behind for t in tries), strict=True))), late_s=late_s)


def _pause(world: World) -> Quiet:
    began = time.monotonic()
    world.drives.tell("pause")
    used: list[int] = []
    since = time.monotonic()
    while time.monotonic() - since < _SETTLED_S:
        documents = world.service.documents(DRIVES)
        now = [min(d["health"]["samples"], d["samples"]) for d in documents]
        if now != used:
            used, since = now, time.monotonic()
        time.sleep(0.05)
    counts = world.drives.tell("count")
    found = Quiet(
        time_s=time.monotonic(),
        sent=tuple(int(c["sent"]) for c in counts),
        behind=tuple(int(c["sent"]) - n for c, n in zip(counts, used, strict=True)),
        received=tuple(d["health"]["samples"] for d in documents),
        told=tuple(d["health"]["samples_lost"] for d in documents),
        no_room=tuple(int(c["no_room"]) for c in counts),
        late_s=max(c["late_s"] for c in counts),
        waited_s=waited_s(world.service.program.process.pid),
        memory_MB=world.service.memory_MB(),
    )
    time.sleep(max(0.0, began + _PAUSE_S - time.monotonic()))
    world.drives.tell("go")
    return found


def attached(world: World) -> None:
    for k in range(DRIVES):
        world.service.program.until(lambda d: d["health"]["connection"] == "connected", "all are there", f"axis{k}")


def rounds(world: World, plan: Plan, tally: Tally, say: Callable[[str], None]) -> None:
    attached(world)
    last = quiet(world)
    spoilt = set[int]()
    for k in range(plan.rounds):
        world.turn = k
        for name, fault in FAULTS.items():
            if name in tally.left_out:
                continue
            exempt = fault(world) | spoilt
            now = quiet(world, last, exempt)
            tally.stretches.append(Stretch(name, last, now, exempt))
            say(f"round {k + 1} of {plan.rounds}, {name}: {tally.stretches[-1]}")
            # The rest of a frame that was cut there may still meet the next one.
            spoilt = {j for j in range(DRIVES) if now.no_room[j] > last.no_room[j]}
            last = now


def lives(world: World, plan: Plan, tally: Tally, say: Callable[[str], None]) -> None:
    end_s: float | None = None
    for k in range(plan.lives):
        _begin(world, tally, end_s)
        first = quiet(world)
        time.sleep(plan.life_s)
        stretch = Stretch("kill -9", first, quiet(world, first), set())
        tally.stretches.append(stretch)
        say(f"life {k + 1} of {plan.lives}: {stretch}")
        if k % 5 == 4:
            api_flood(world)
            world.service.stop()
            end_s = None
        else:
            end_s = time.time()
            world.service.kill()
    _begin(world, tally, end_s)
    world.service.stop()


def _begin(world: World, tally: Tally, killed_s: float | None) -> None:
    """A new life; what the kill of the last one has cost is asked first."""
    world.service.start()
    if killed_s is not None:
        last = [world.service.last_row_s(f"axis{k}", killed_s) for k in range(DRIVES)]
        tally.kills_s.append(killed_s - min(last))
    attached(world)


def soak(folder: Path, plan: Plan, say: Callable[[str], None] = lambda _: None) -> Tally:
    """Everything in turn; what was found. Parts of the system that are missing are named in `left_out`."""
    state = folder / "state"
    state.mkdir()
    mosquitto = shutil.which("mosquitto", path=f"{os.environ.get('PATH', '')}:/usr/sbin")
    with contextlib.ExitStack() as stack:
        small = stack.enter_context(small_disk(state))
        clock = WallClock(folder)
        broker = Broker(mosquitto, folder) if mosquitto else None
        if broker is not None:
            broker.start()
            stack.callback(broker.kill)
        these = stack.enter_context(drives(folder, SERIAL, SLCAN, wait_for))
        config = folder / "soak.toml"
        config.write_text(configuration(these.links, broker))
        signs = Signs(folder / "notify")
        stack.callback(signs.close)
        service = Service(config, state, signs, folder / "notify", clock.environment)
        stack.callback(service.end)
        world = World(service, these, broker, clock, small, plan.hurt_s)
        tally = Tally(disk="a tmpfs of 64 MB, filled" if small else "RLIMIT_FSIZE of the daemon, 0")
        tally.left_out = {"broker loss"} if broker is None else set()
        tally.left_out |= set() if clock else {"clock steps"}
        service.start()
        these.tell("go")
        rounds(world, plan, tally, say)
        api_flood(world)
        service.stop()
        lives(world, plan, tally, say)
        tally.take(service, world.wrong, corrupt(state))
    return tally
