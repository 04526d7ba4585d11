"""`false-steps`: a hidden effect that the model lacks, and nothing that changes: is a step invented, is a value wrong?

Half of the runs on the default simulated servo, half on the motors of the independent generator in four motions:
Coulomb and Stribeck friction, cogging, brush drop, a winding that heats, each from faint to strong (shares of the
torque at rated current, of the voltage, of R; see the generator's `typical`). Five minutes each. A heated winding's
true R is the hot one's.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain, zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from servo_daemon.config import DriveConfig
from servo_daemon.samples import F64
from servo_daemon.simulate import DEFAULT_NOMINAL
from tests.recovery.generator import PAPER, EffectValues, Scenario, generate, typical
from tests.recovery.tracking.follow import NAMES, info_of, sampled
from tests.recovery.tracking.published import figures, print_table
from tests.recovery.tracking.servo import SHOWN, servo_heard
from tests.recovery.tracking.voices import Heard, blocks_of, listened
from tests.recovery.tracking.witness import WITNESSES
from tests.recovery.tracking.wrong import WRONG_S, Journal, chosen, each

EFFECTS = ("coulomb_friction", "stribeck_friction", "cogging_torque", "brush_voltage_drop", "winding_heating")
MOTIONS = ("multisine", "pick_and_place", "reversals", "prbs")
#: From what hides in the noise to what a user would hear.
SHARES = (0.02, 0.05, 0.10, 0.20, 0.30)
#: IEC 60028, as the generator has it.
_ALPHA_1_K = 0.0039
#: How far the datasheet of the generator's motors may be off, either way.
_NOMINAL = 0.4


@dataclass(frozen=True, slots=True)
class Run:
    """A motor ("servo": the default simulated servo), its motion, what is hidden and how strong."""

    motor: str
    motion: str
    effect: str
    share: float
    seed: int
    seconds: float

    @property
    def key(self) -> str:
        return f"{self.motor}/{self.motion}/{self.effect}/{self.share:g}/{self.seed}"

    @property
    def rng(self) -> np.random.Generator:
        return np.random.default_rng(zlib.crc32(f"false-steps/{self.key}".encode()))


def heard_of(run: Run) -> tuple[Heard, F64]:
    """What is said, and the truth at each tick, shape (m, SHOWN)."""
    rng = run.rng
    motor = PAPER if run.motor == "servo" else WITNESSES[run.motor]  # the default servo has the paper's motor
    hidden: Mapping[str, EffectValues] = typical(run.effect, motor, run.share, seconds=run.seconds, rng=rng)
    if run.motor == "servo":
        return servo_heard((), DEFAULT_NOMINAL, run.seconds, run.seed, hidden)
    nominal = {name: float(getattr(motor, name) * (1 + rng.uniform(-_NOMINAL, _NOMINAL))) for name in NAMES}
    nominal["J_m"] = 0.6 * min(nominal["J"], motor.J)
    recording = generate(motor, Scenario(run.motion, run.seconds, effects=hidden, seed=run.seed))
    heard = listened(DriveConfig(nominal=nominal), info_of(recording), blocks_of(recording))
    true = recording.truth
    J_d = true.parameters["J"] - nominal["J_m"]
    hot = true.parameters["R"] * (1 + _ALPHA_1_K * true.winding_rise_K)
    return heard, sampled({**true.parameters, "R": hot, "J_d": J_d}, true.time_s, SHOWN, heard.time_s)


def run_false_steps(run: Run) -> dict[str, Any]:
    """One run's figures; see `published.figures`."""
    began = time.process_time()
    heard, truth = heard_of(run)
    return {"key": run.key, **figures(heard, truth), "cpu_s": time.process_time() - began}


def runs_of(runs: int, seconds: float, only: str, first: int = 1) -> list[Run]:
    """The first `runs` of them, servo and motors in turn; those whose key contains `only`; seeds from `first` on."""
    seeds = (first, first + 1)
    servo = [
        Run("servo", "mixed", effect, share, seed, seconds) for seed in seeds for share in SHARES for effect in EFFECTS
    ]
    motors = [
        Run(
            motor,
            MOTIONS[(m + e + seed) % len(MOTIONS)],
            effect,
            SHARES[(m + 2 * e + seed) % len(SHARES)],
            seed,
            seconds,
        )
        for seed in seeds
        for m, motor in enumerate(WITNESSES)
        for e, effect in enumerate(EFFECTS)
    ]
    both = [run for run in chain.from_iterable(zip_longest(servo, motors)) if run is not None]
    return chosen(both[:runs], only)


def report_false_steps(
    runs: int, seconds: float, only: str = "", *, first: int = 1, processes: int = 2, out: Path | None = None
) -> None:
    """Prints what is beyond the limits as it comes, then the table."""
    print(f"\nA hidden effect, nothing changes: {runs} runs of {seconds:.0f} s")
    journal, rows = Journal(out), []
    for row in each(run_false_steps, runs_of(runs, seconds, only, first), processes):
        journal.write(row)
        rows.append(row)
        if faults := faults_of(row):
            print(f"  {row['key']:50}{'; '.join(faults)}", flush=True)
    print_table(rows, explained=False)
    named = sum(len(row["steps"]) for row in rows)
    print(f"  steps named: {named} in {sum(bool(row['steps']) for row in rows)} runs   (limit: 0)")
    print(f"one run again: python -m benchmarks.tracking false-steps --first {first} --seconds {seconds:g} --only KEY")


def faults_of(row: Mapping[str, Any]) -> list[str]:
    """Steps that were named, and values wrong for too long, in words."""
    out = list(row["steps"][:2])
    if len(row["steps"]) > len(out):
        out.append(f"{len(row['steps'])} steps in all")
    stretches = row["wrong_s"]["published"]
    out += [
        f"{name} wrong for {stretches[k]:.0f} s ({100 * row['final']['published'][k]:+.0f} % at the end)"
        for k, name in enumerate(SHOWN)
        if stretches[k] > WRONG_S
    ]
    return out
