"""`starts`: nominal values wrong by up to five times either way, each by its own factor (log-uniform), and every tenth
start with no nominal values at all; over all motors and motions, 20 s each.

Converged: in the end R, K, J and B are `tracking` and within 3 std or 3 % of the truth; L too where it is published as
`tracking` (where the motion does not show it, it must say so). Those that did not converge are told apart: open, where
nothing is published with a standard deviation (`tracking`, or held as `unexcited`) that is not right, and wrong. Start
number k depends on k alone: `--first 400 --runs 100` repeats starts 400 to 499.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np

from tests.recovery.generator import MOTIONS, MOTORS, Scenario, generate, stream

from .follow import NAMES, tracked

WRONG = 5.0
NOTHING_EVERY = 10
TOLERANCE, STDS = 0.03, 3.0


@dataclass(frozen=True, slots=True)
class Start:
    """One start: its number, what it was, what was wrong in the end ("" if it converged), and whether that was
    published with a standard deviation."""

    number: int
    motor: str
    motion: str
    nothing: bool
    failure: str
    claimed: bool


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
    return Start(number, name, motion, nothing, "; ".join(wrong), bool(claimed.any()))


def report_starts(first: int, count: int, seconds: float) -> None:
    """Prints failures as they come, then the shares."""
    print(f"\n{count} starts of {seconds:.0f} s from number {first}: nominal values wrong by up to {WRONG:g} ×,")
    print(f"one in {NOTHING_EVERY} with none at all")
    starts = []
    with ProcessPoolExecutor(2) as pool:
        for start in pool.map(run_start, [(k, seconds) for k in range(first, first + count)], chunksize=5):
            starts.append(start)
            if start.failure:
                how = "nothing known" if start.nothing else "wrong nominal"
                print(f"  {start.number:5} {start.motor:6} {start.motion:15} {how:14} {start.failure}", flush=True)
    for title, chosen in (
        ("all", starts),
        ("wrong nominal values", [s for s in starts if not s.nothing]),
        ("nothing known", [s for s in starts if s.nothing]),
        *((motion, [s for s in starts if s.motion == motion]) for motion in MOTIONS),
        *((motor, [s for s in starts if s.motor == motor]) for motor in MOTORS),
    ):
        good, claimed = sum(not s.failure for s in chosen), sum(s.claimed for s in chosen)
        share = f"({100 * good / max(len(chosen), 1):.1f} %)"
        rest = f"{len(chosen) - good - claimed} open, {claimed} wrong"
        print(f"{title:22} {good:5} of {len(chosen):5} converged {share}, {rest}")
