"""`steps`: one parameter changes at once, on all motors and motions; is it named, and is everything right again?

Counted as right: named within 2 s, within 3 % of the new value after 5 s, no other parameter named, and no value beyond
5 std while `tracking`, the 5 s after the step left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np

from tests.recovery.generator import MOTIONS, MOTORS, Scenario, generate
from tests.recovery.tracking.cases import Case
from tests.recovery.tracking.follow import NAMES, nominal_of, tracked
from tests.recovery.tracking.scenarios import NAMED_STDS, NOMINAL, Row, judge

#: What steps, and by how much of it.
STEPS = (("R", 0.10), ("R", -0.25), ("K", -0.10), ("J", 0.10), ("J", -0.30), ("B", 1.0), ("L", 0.30))
NAMED_S, NEAR = 2.0, 0.03


@dataclass(frozen=True, slots=True)
class Step:
    """What is to happen: a parameter, by what share of it, on which motor and motion, the seed of the noise."""

    parameter: str
    size: float
    motion: str
    motor: str
    seed: int

    @property
    def title(self) -> str:
        return f"{self.parameter} {100 * self.size:+.0f} %"


def run_step(job: tuple[Step, float]) -> tuple[Step, Row]:
    """One run of so many seconds, the step in its middle."""
    step, seconds = job
    motor = MOTORS[step.motor]
    late = np.arange(round(1000 * seconds)) >= 500 * seconds
    values = getattr(motor, step.parameter) * np.where(late, 1.0 + step.size, 1.0)
    scenario = Scenario(step.motion, seconds=seconds, ageing={step.parameter: values}, seed=step.seed)
    recording = generate(motor, scenario)
    truth = {name: recording.truth.parameters[name] for name in NAMES}
    case = Case(step.motion, recording, truth=truth, change_s=seconds / 2, stepped=step.parameter)
    track = tracked(recording, nominal_of(motor, NOMINAL))
    return step, judge((step.title, step.motor, seconds, step.seed, None), case, track)


def what_is_wrong(row: Row) -> str:
    """In words; empty: nothing."""
    named, worst = row.recognised_s, int(np.argmax(row.worst))
    parts = []
    if named is None or named > NAMED_S:
        parts.append("not named" if named is None else f"named after {named:.1f} s")
    if not row.after < NEAR:
        parts.append(f"{100 * row.after:.1f} % off")
    if row.worst[worst] > NAMED_STDS:
        parts.append(f"{row.names[worst]} {row.worst[worst]:.1f} σ")
    parts += [f"also {name}" for name in row.wrong_jumps[:3]]
    return ", ".join(parts)


def _all(runs: int) -> Iterator[Step]:
    for parameter, size in STEPS:
        for motion in MOTIONS:
            for motor in MOTORS:
                for seed in range(7, 7 + runs):
                    yield Step(parameter, size, motion, motor, seed)


def report_steps(runs: int, seconds: float) -> None:
    """Prints what went wrong as it comes, then the shares by what stepped and by motion."""
    print(f"\nSteps of one parameter: {seconds:.0f} s at 1 kHz, datasheet {NOMINAL:g} × the truth, {runs} run(s) each")
    wrong: dict[Step, str] = {}
    with ProcessPoolExecutor(2) as pool:
        for step, row in pool.map(run_step, [(step, seconds) for step in _all(runs)], chunksize=4):
            wrong[step] = what_is_wrong(row)
            if wrong[step]:
                print(f"  {step.title:8} {step.motion:15} {step.motor:6} {step.seed:3}  {wrong[step]}", flush=True)
    print(f"right, of {len(MOTORS) * runs} each" + "".join(f"{motion:>16}" for motion in MOTIONS))
    for title in dict.fromkeys(step.title for step in wrong):
        right = [sum(not w for s, w in wrong.items() if (s.title, s.motion) == (title, motion)) for motion in MOTIONS]
        print(f"  {title:15}" + "".join(f"{n:16}" for n in right))
    print(f"in all {sum(not w for w in wrong.values())} of {len(wrong)}")
