"""`rivals`: the daemon's pipeline and what others would run, on the same samples in the same process.

Laboratory sensors, linear ageing at the issue's rate, datasheet 1.4 × the truth. Errors and intervals are taken at the
same instants for all: every tick (0.1 s) after 20 s at which ours is tracking.
"""

from __future__ import annotations

import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np

from servo_daemon.samples import F64
from tests.recovery.generator import MOTORS
from tests.recovery.tracking.ageing import ageing_recording
from tests.recovery.tracking.follow import BURN_IN_S, NAMES, Flags, nominal_of, sampled, tracked
from tests.recovery.tracking.score import Score, score

from .rival_filters import FILTERS, Rival, Task
from .rival_regressions import REGRESSIONS

MOTIONS = ("multisine", "pick_and_place")
RIVALS = {**FILTERS, **REGRESSIONS}
OURS = "servo-daemon"


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """One competitor on one recording."""

    label: str
    score: Score
    us_per_sample: float
    note: str = ""


def compete(job: tuple[str, str, float, int]) -> list[Measured]:
    """All of them on one recording, ours first."""
    name, motion, seconds, seed = job
    motor = MOTORS[name]
    recording = ageing_recording(motor, motion, seconds, seed)
    n = len(recording.time_s)
    began = time.perf_counter()
    track = tracked(recording, nominal_of(motor))
    ours_us = 1e6 * (time.perf_counter() - began) / n
    truth = sampled(recording.truth.parameters, recording.truth.time_s, NAMES, track.time_s)
    late = track.time_s > BURN_IN_S
    counted: Flags = track.tracking[late]
    found = [Measured(OURS, score(track.value[late], track.std[late], truth[late], counted), ours_us)]
    at = np.clip(np.searchsorted(recording.time_s, track.time_s[late] + 1e-6) - 1, 0, n - 1)
    task = Task(recording, motor, nominal_of(motor))
    for label, run in RIVALS.items():
        began = time.perf_counter()
        rival: Rival = run(task)
        us = 1e6 * (time.perf_counter() - began) / n
        found.append(Measured(label, score(rival.value[at], rival.std[at], truth[late], counted), us, rival.note))
    return found


def report_rivals(seconds: float) -> None:
    """Prints a block for each motor and motion, then the medians."""
    print(
        f"\nRivals: {seconds:.0f} s at 1 kHz, laboratory sensors, linear ageing; timings on a shared machine are noisy"
    )
    print(
        "per parameter: RMS error in %, ratio to ours, truths inside 95 % (–: no interval); µs a sample, ratio to ours"
    )
    jobs = [(motor, motion, seconds, 11) for motor in MOTORS for motion in MOTIONS]
    ratios: dict[str, list[F64]] = {label: [] for label in RIVALS}
    with ProcessPoolExecutor(2) as pool:
        for (motor, motion, _, _), found in zip(jobs, pool.map(compete, jobs), strict=True):
            ours = found[0]
            share = ", ".join(f"{n} {100 * s:.0f} %" for n, s in zip(NAMES, ours.score.share, strict=True))
            print(f"\n{motor} {motion}; ours is tracking {share}")
            for measured in found:
                print(_line(measured, ours), flush=True)
                if measured is not ours and not measured.note:
                    ratios[measured.label].append(measured.score.rms / ours.score.rms)
    print("\nerror over ours, median over the motors and motions on which it did not diverge: " + ", ".join(NAMES))
    for label, values in ratios.items():
        print(f"  {label:22} " + " ".join(f"{r:8.1f}×" for r in np.median(values, axis=0)), f"({len(values)} runs)")


def _line(measured: Measured, ours: Measured) -> str:
    if measured.note:
        return f"  {measured.label:22}  {measured.note}"
    cells = ""
    for p, name in enumerate(NAMES):
        inside = measured.score.inside[p] if np.isfinite(measured.score.width[p]) else np.nan
        share = f"{100 * inside:4.0f}%" if np.isfinite(inside) else "    –"
        ratio = min(measured.score.rms[p] / ours.score.rms[p], 9999.0)
        cells += f"  {name} {min(100 * measured.score.rms[p], 9999):8.3f} {ratio:7.1f}×{share}"
    ratio = measured.us_per_sample / ours.us_per_sample
    return f"  {measured.label:22}{cells}  {measured.us_per_sample:7.1f} µs {ratio:6.2f}×"
