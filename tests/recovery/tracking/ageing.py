"""`ageing`: the daemon's own pipeline, laboratory sensors (quantised encoder, unknown noise, jitter), R +40 %, K −15 %,
B +80 %, J +30 % in five minutes."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor

import numpy as np

from servo_daemon.samples import F64
from tests.recovery.generator import MOTORS, Motor, Recording, Scenario, generate
from tests.recovery.tracking.follow import BURN_IN_S, MOTIONS, NAMES, nominal_of, sampled, tracked
from tests.recovery.tracking.ramp_bound import ramp_bounds
from tests.recovery.tracking.score import mean, score

AGEING_LIMIT = {"R": 0.004, "L": 0.03, "K": 0.0012, "J": 0.002, "B": 0.008}
AGEING_END = {"R": 1.40, "L": 1.0, "K": 0.85, "J": 1.30, "B": 1.80}
AGEING_S = 300.0


def ageing_recording(motor: Motor, motion: str, seconds: float, seed: int) -> Recording:
    """Parameters that move linearly, at the rate that takes them to their end in five minutes."""
    share = np.arange(round(1000 * seconds)) / (1000 * AGEING_S)
    ageing = {name: getattr(motor, name) * (1 + (end - 1) * share) for name, end in AGEING_END.items()}
    return generate(motor, Scenario(motion, seconds=seconds, ageing=ageing, seed=seed))


def ageing_run(arguments: tuple[str, str, float, int]) -> tuple[F64, F64, F64, F64]:
    """One run: relative RMS error, share inside 95 %, interval's width over the error, share tracking; (5,) each."""
    name, motion, seconds, seed = arguments
    motor = MOTORS[name]
    recording = ageing_recording(motor, motion, seconds, seed)
    track = tracked(recording, nominal_of(motor))
    truth = sampled(recording.truth.parameters, recording.truth.time_s, NAMES, track.time_s)
    late = track.time_s > BURN_IN_S
    found = score(track.value[late], track.std[late], truth[late], track.tracking[late])
    return found.rms, found.inside, found.width, found.share


def ageing_bounds(arguments: tuple[str, str, float, int]) -> tuple[F64, F64]:
    """Of the same run: RMS errors that nobody beats, and that no random walk beats; (5,) each (`ramp_bound`)."""
    name, motion, seconds, seed = arguments
    return ramp_bounds(MOTORS[name], ageing_recording(MOTORS[name], motion, seconds, seed))


def report_ageing(runs: int, seconds: float) -> None:
    """Prints the table; a run is five minutes at most."""
    seconds = min(seconds, AGEING_S)
    print(f"\nLinear ageing (R +40 %, K −15 %, B +80 %, J +30 % in 300 s), laboratory sensors, {runs} runs each,")
    print(f"{seconds:.0f} s; what counts is the time after {BURN_IN_S:.0f} s while tracking")
    print("RMS error in %, share of truths inside 95 %, std over RMS error, share of the time tracking; below, of the")
    print(
        "first of these runs: who knows the noise, and that the parameters move linearly, but not how fast, is expected"
    )
    print("to come as near as `trend`, nobody nearer; who takes them for random walks as near as `walk`")
    print(f"{'motor  motion':23}" + "".join(f"{n:>26}" for n in NAMES))
    with ProcessPoolExecutor(2) as pool:
        for name in MOTORS:
            for motion in MOTIONS:
                jobs = [(name, motion, seconds, 1000 * k + 11) for k in range(runs)]
                parts = zip(*pool.map(ageing_run, jobs), strict=True)
                rms, inside, width, share = (mean(np.array(part)) for part in parts)
                cells = "".join(
                    f"{100 * rms[k]:8.3f}{'!' if rms[k] > AGEING_LIMIT[n] else ' '}"
                    f"{100 * inside[k]:5.1f}% {width[k]:4.1f} {100 * share[k]:4.0f}%"
                    for k, n in enumerate(NAMES)
                )
                print(f"{name:6} {motion:15} {cells}", flush=True)
                trend, walk = pool.submit(ageing_bounds, jobs[0]).result()
                cells = "".join(f"{100 * t:8.3f} trend{100 * w:6.3f} walk " for t, w in zip(trend, walk, strict=True))
                print(f"{'':23}{cells}", flush=True)
    limits = ", ".join(f"{n} {100 * limit:g} %" for n, limit in AGEING_LIMIT.items())
    print(f"limits of the RMS error (!: beyond): {limits}")
