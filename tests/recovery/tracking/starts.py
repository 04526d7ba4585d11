"""`starts`: nominal values wrong by up to five times either way, each by its own factor (log-uniform), and every tenth
start with no nominal values at all; over all motors and motions, 20 s each.

Converged: in the end R, K, J and B are `tracking` and within 3 std or 3 % of the truth; L too where it is published as
`tracking` (where the motion does not show it, it must say so). Those that did not converge are told apart: open, where
nothing is published with a standard deviation (`tracking`, or held as `unexcited`) that is not right, and wrong. What
was published on the way counts on its own: a value that was beyond 4 std and 3 % at any tick. Start number k depends on
k alone: `--first 400 --runs 100` repeats starts 400 to 499.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np

from servo_daemon.samples import F64
from tests.recovery.generator import MOTIONS, MOTORS, Scenario, generate, stream
from tests.recovery.tracking.follow import NAMES, Track, tracked

WRONG = 5.0
NOTHING_EVERY = 10
TOLERANCE, STDS = 0.03, 3.0
#: Of thousands of ticks one is beyond 3 std by chance.
STDS_ON_THE_WAY = 4.0


@dataclass(frozen=True, slots=True)
class Start:
    """One start: its number, what it was, what was wrong in the end ("" if it converged), whether that was published
    with a standard deviation, and what was on the way ("" if nothing)."""

    number: int
    motor: str
    motion: str
    nothing: bool
    failure: str
    claimed: bool
    on_the_way: str


def run_start(job: tuple[int, float]) -> Start:
    """Start number k, so many seconds."""
    number, seconds = job
    names = [(motor, motion) for motor in MOTORS for motion in MOTIONS]
    name, motion = names[number % len(names)]
    motor = MOTORS[name]
    nothing = (number // len(names)) % NOTHING_EVERY == 0
    factors = WRONG ** stream(number, "nominal").uniform(-1.0, 1.0, len(NAMES))
    nominal = {n: float(f * getattr(motor, n)) for n, f in zip(NAMES, factors, strict=True)}
    recording = generate(motor, Scenario(motion, seconds=seconds, seed=number))
    track = tracked(recording, {} if nothing else nominal)
    truth = np.array([getattr(motor, n) for n in NAMES])
    error = np.abs(track.value[-1] / truth - 1)
    spread = track.std[-1] / truth
    claimed = np.isfinite(spread) & ~(error <= np.maximum(TOLERANCE, STDS * spread))
    wrong = [
        f"{n} {track.status[-1, p]} {100 * error[p]:.1f} % ({error[p] / spread[p]:.1f} σ)"
        for p, n in enumerate(NAMES)
        if claimed[p] or (n != "L" and not track.tracking[-1, p])
    ]
    return Start(number, name, motion, nothing, "; ".join(wrong), bool(claimed.any()), _on_the_way(track, truth))


def _on_the_way(track: Track, truth: F64) -> str:
    """Values that were published with a standard deviation and were wrong, with their worst instant."""
    error, spread = np.abs(track.value[:, : len(NAMES)] / truth - 1), track.std[:, : len(NAMES)] / truth
    wrong = np.isfinite(spread) & (error > np.maximum(TOLERANCE, STDS_ON_THE_WAY * spread))
    found = []
    for p, name in enumerate(NAMES):
        at = np.flatnonzero(wrong[:, p])
        if len(at):
            worst = at[np.argmax(error[at, p] / spread[at, p])]
            size = f"{100 * error[worst, p]:.1f} % ({error[worst, p] / spread[worst, p]:.1f} σ)"
            found.append(f"{name} {len(at)} ticks from {track.time_s[at[0]]:.1f} s, at most {size}")
    return "; ".join(found)


def report_starts(first: int, count: int, seconds: float) -> None:
    """Prints failures as they come, then the shares."""
    print(f"\n{count} starts of {seconds:.0f} s from number {first}: nominal values wrong by up to {WRONG:g} ×,")
    print(f"one in {NOTHING_EVERY} with none at all")
    starts = []
    with ProcessPoolExecutor(2) as pool:
        for start in pool.map(run_start, [(k, seconds) for k in range(first, first + count)], chunksize=5):
            starts.append(start)
            for when, what in (("in the end", start.failure), ("on the way", start.on_the_way)):
                if what:
                    how = "nothing known" if start.nothing else "wrong nominal"
                    print(f"  {start.number:5} {start.motor:6} {start.motion:15} {how:14} {when}: {what}", flush=True)
    for title, chosen in (
        ("all", starts),
        ("wrong nominal values", [s for s in starts if not s.nothing]),
        ("nothing known", [s for s in starts if s.nothing]),
        *((motion, [s for s in starts if s.motion == motion]) for motion in MOTIONS),
        *((motor, [s for s in starts if s.motor == motor]) for motor in MOTORS),
    ):
        good, claimed = sum(not s.failure for s in chosen), sum(s.claimed for s in chosen)
        share = f"({100 * good / max(len(chosen), 1):.1f} %)"
        wrong = sum(bool(s.on_the_way) for s in chosen)
        rest = f"{len(chosen) - good - claimed} open, {claimed} wrong, {wrong} wrong on the way"
        print(f"{title:22} {good:5} of {len(chosen):5} converged {share}, {rest}")
