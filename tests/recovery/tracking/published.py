"""`published`: is what the daemon says true, and does it go on saying it? The default simulated servo, `run`'s own.

Runs in turn: R +40 %, K −15 %, B +80 % in three minutes and J_d +0.003 at 60 s, with nominal values up to 42 % off (the
case `frozen`); and `run`'s own slow ageing with one step, of R, L, K, J_d or B, by 20 to 40 % either way. What is
published, J_d included, is compared with the truth at 10 Hz, from 20 s on.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from servo_daemon.samples import F64
from servo_daemon.simulate import DEFAULT_AGEING, DEFAULT_J_M, DEFAULT_NOMINAL, PAPER_MOTOR
from tests.recovery.tracking.follow import BURN_IN_S
from tests.recovery.tracking.servo import SHOWN, servo_heard
from tests.recovery.tracking.voices import VOICES, Heard
from tests.recovery.tracking.wrong import TICK_S, WRONG_S, Journal, chosen, each, longest_s, wrong

#: Issue 25: share of the time tracking; age of a value that does not say so, s.
TRACKING, STALE_S = 0.95, 10.0
#: The case `frozen`.
FROZEN = ("R=+40%/180s", "K=-15%/180s", "B=+80%/180s", "J_d=+0.003@60s")
FROZEN_NOMINAL = {"R": 0.70, "L": 3.2e-3, "K": 0.20, "J": 0.0135, "J_m": DEFAULT_J_M, "B": 0.34}
STEPPED = ("R", "L", "K", "J_d", "B")


@dataclass(frozen=True, slots=True)
class Run:
    """A run: "frozen", or which parameter steps; its seed."""

    kind: str
    seed: int
    seconds: float

    @property
    def key(self) -> str:
        return f"{self.kind}/{self.seed}"

    @property
    def ageing(self) -> list[str]:
        """As `simulate --ageing` has it."""
        if self.kind == "frozen":
            return list(FROZEN)
        slow = [f"{name}={text}" for name, texts in DEFAULT_AGEING.items() for text in texts]
        return [*slow, self._step()]

    def _step(self) -> str:
        rng = np.random.default_rng([self.seed, STEPPED.index(self.kind)])
        size, up, at_s = rng.uniform(0.2, 0.4), rng.uniform() < 0.5, rng.uniform(0.25, 0.75) * self.seconds
        if self.kind == "J_d":  # shares of J: a load that is clamped on, or most of the present one taken off
            J = PAPER_MOTOR["J"]
            amount = size * J if up else 2.0 * size * (J - DEFAULT_J_M)
            return f"J_d={'+' if up else '-'}{amount:.6f}@{at_s:.2f}s"
        return f"{self.kind}={'+' if up else '-'}{100 * size:.2f}%@{at_s:.2f}s"

    @property
    def nominal(self) -> Mapping[str, float]:
        return FROZEN_NOMINAL if self.kind == "frozen" else DEFAULT_NOMINAL


def run_published(run: Run) -> dict[str, Any]:
    """One run's figures; arrays of shape (SHOWN,)."""
    began = time.process_time()
    heard, truth = servo_heard(run.ageing, run.nominal, run.seconds, run.seed)
    return {
        "key": run.key,
        "ageing": run.ageing,
        **figures(heard, truth),
        "cpu_s": time.process_time() - began,
    }


def figures(heard: Heard, truth: F64) -> dict[str, Any]:
    """From 20 s on.

    Returns:
        "wrong_s": voice -> longest stretch wrong, s, (SHOWN,); "final": voice -> error of the last value; "tracking":
        share of the time, (SHOWN,); "held_s": longest stretch with a value that is not tracked, (SHOWN,); "stale_s":
        longest stretch in which a value that is called tracked does not move, (SHOWN,);
        "white": share of the time; "steps": those named, in words.
    """
    late = heard.time_s > BURN_IN_S
    off = {v: wrong(heard.value[v][late], heard.std[v][late], truth[late]) for v in VOICES}
    with np.errstate(invalid="ignore"):
        final = {v: heard.value[v][-1] / truth[-1] - 1 for v in VOICES}
    value, has_value = heard.value["published"], np.isfinite(heard.std["published"])
    still = np.diff(value, axis=0, prepend=np.nan) == 0.0
    return {
        "wrong_s": {v: longest_s(flags) for v, flags in off.items()},
        "final": final,
        "tracking": heard.tracking[late].mean(axis=0),
        "held_s": longest_s(has_value[late] & ~heard.tracking[late]),
        "stale_s": longest_s(still[late] & heard.tracking[late]),
        "white": float(heard.white[late].mean()),
        "steps": [f"{t.message} at {t.time_s:.1f} s" for t in heard.steps],
    }


def runs_of(runs: int, seconds: float, only: str, first: int = 1) -> list[Run]:
    """`runs` of them from seed `first` on: every second one `frozen`, the others each parameter's step in turn."""
    kinds = ["frozen" if n % 2 == 0 else STEPPED[n // 2 % len(STEPPED)] for n in range(runs)]
    drawn = [Run(kind, first + n // 2, seconds) for n, kind in enumerate(kinds)]
    return chosen(drawn, only)


def faults_of(row: Mapping[str, Any]) -> list[str]:
    """What of a run is beyond the limits, in words; the worst parameter of each kind."""
    out = []
    worst = int(np.argmax(row["wrong_s"]["published"]))
    longest = row["wrong_s"]["published"][worst]
    if longest > WRONG_S:
        off = 100 * row["final"]["published"][worst]
        out.append(f"{SHOWN[worst]} wrong for {longest:.1f} s ({off:+.1f} % at the end)")
    least = int(np.argmin(row["tracking"]))
    if row["tracking"][least] < TRACKING:
        out.append(f"{SHOWN[least]} tracking {100 * row['tracking'][least]:.0f} %, held {row['held_s'][least]:.1f} s")
    if np.max(row["stale_s"]) > STALE_S:
        out.append(
            f"{SHOWN[int(np.argmax(row['stale_s']))]} tracking for {np.max(row['stale_s']):.1f} s without moving"
        )
    return out


def report_published(
    runs: int, seconds: float, only: str = "", *, first: int = 1, processes: int = 2, out: Path | None = None
) -> None:
    """Prints what is beyond the limits as it comes, then the table."""
    print(f"\nWhat is published, default simulated servo: {runs} runs of {seconds:.0f} s, from {BURN_IN_S:.0f} s on")
    journal, rows = Journal(out), []
    for row in each(run_published, runs_of(runs, seconds, only, first), processes):
        journal.write(row)
        rows.append(row)
        faults = faults_of(row)
        if faults or only:
            print(f"  {row['key']:12}{'; '.join(faults) or 'nothing beyond the limits'}", flush=True)
    print_table(rows)
    print(
        f"one run again: python -m benchmarks.tracking published --runs {runs} --first {first} --seconds {seconds:g} "
        "--only KIND/SEED"
    )


def print_table(rows: list[dict[str, Any]], *, explained: bool = True) -> None:
    """Over all runs: the worst of each figure, and how many runs are beyond its limit.

    Args:
        explained: the model holds all that moves the motor; where it does not nothing need be tracking.
    """
    if not rows:
        return
    print(f"{'':46}" + "".join(f"{name:>8}" for name in SHOWN) + "    limit, runs beyond it")
    for voice in VOICES:
        stretches = np.array([row["wrong_s"][voice] for row in rows])
        beyond = int((stretches > WRONG_S).any(axis=1).sum())
        limit = f"{WRONG_S:g} s, {beyond} of {len(rows)}" if voice == "published" else f"–, {beyond} of {len(rows)}"
        # The estimators know nothing of J_m.
        cells = "".join(
            f"{'–':>8}" if name == "J_d" and voice != "published" else f"{worst:8.1f}"
            for name, worst in zip(SHOWN, stretches.max(0), strict=True)
        )
        print(f"  {voice + ': longest stretch wrong, s':44}{cells}    {limit}")
    tracking = np.array([row["tracking"] for row in rows])
    beyond = int((tracking < TRACKING).any(axis=1).sum())
    cells = "".join(f"{100 * x:8.1f}" for x in tracking.min(0))
    limit = f"≥ {100 * TRACKING:g} %" if explained else "–"
    print(f"  {'least share of the time tracking, %':44}{cells}    {limit}, {beyond} of {len(rows)}")
    held = np.array([row["held_s"] for row in rows]).max(0)
    print(f"  {'oldest value held, s':44}" + "".join(f"{x:8.1f}" for x in held) + "    –")
    stale = np.array([row["stale_s"] for row in rows])
    beyond = int((stale > STALE_S).any(axis=1).sum())
    cells = "".join(f"{x:8.1f}" for x in stale.max(0))
    print(f"  {'tracking without moving, longest, s':44}{cells}    {STALE_S:g} s, {beyond} of {len(rows)}")
    cpu = [row["cpu_s"] for row in rows if "cpu_s" in row]
    print(f"  {sum(cpu) / len(cpu):.1f} s of one core a run, {sum(cpu) / 60:.1f} min in all; ticks of {TICK_S:g} s")
