"""What is run to calibrate: captures to diagnose and recordings to track, of motors, motions and seeds of their own."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from servo_daemon.captures import read_capture
from servo_daemon.config import DriveConfig
from servo_daemon.diagnosis.diagnose import diagnose
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.samples import F64, make_block
from tests.recovery.calibration.motions import BOUNDED, MOTIONS
from tests.recovery.calibration.motors import CLASSES, SEEDS, motor
from tests.recovery.calibration.watched import Notes, watching
from tests.recovery.generator import LISTED, UNLISTED, Scenario, generate, typical

#: Shares of the working torque or voltage, other ones than the matrix has.
STRENGTHS: Mapping[str, float] = {"clear": 0.15, "faint": 0.05}
#: One capture cannot show it.
_INVISIBLE = ("current_sensor_gain",)
DIAGNOSED_S, TRACKED_S = 12.0, 40.0
#: Of the tracked: what happens to the motor in the middle of the recording, as factors of its parameters or as a share
#: of its working torque, and what the filter's model lacks throughout.
STEPS: Mapping[str, Mapping[str, float]] = {
    "R +25 %": {"R": 1.25},
    "K -15 %": {"K": 0.85},
    "J +30 %": {"J": 1.3},
    "B +60 %": {"B": 1.6},
}
AGEING: Mapping[str, float] = {"R": 1.2, "K": 0.92, "B": 1.4}
LACKING = ("coulomb_friction", "cogging_torque", "brush_voltage_drop", "winding_heating")
#: The nominal values of the tracked, over the true ones: a datasheet's tolerance.
_DATASHEET = {"R": 1.12, "L": 0.85, "K": 0.94, "J": 1.2, "B": 0.8}


@dataclass(frozen=True, slots=True)
class CalibrationCase:
    """One run.

    Attributes:
        part: "diagnosis" or "tracker".
        what: "nothing", an effect, or a name of `STEPS`, "ageing"; the tracker's effects are lacking in its model.
        strength: of an effect, a name of `STRENGTHS`; "" without one.
        motor: number, see `motors.motor`.
        motion: name.
        seed: of all noise.
    """

    part: str
    what: str
    strength: str
    motor: int
    motion: str
    seed: int

    @property
    def key(self) -> str:
        return f"{self.part}/{self.what}/{self.strength}/{self.motor}/{self.motion}"

    @property
    def group(self) -> str:
        """The column of the table."""
        if self.what == "nothing":
            return self.what
        if self.part == "tracker":
            return "lacking" if self.what in LACKING else "changing"
        return "unnamed" if self.what in UNLISTED else self.strength

    def effects(self, seconds: float) -> dict[str, Mapping[str, float | str]]:
        """What is hidden, with its parameters."""
        if not self.strength:
            return {}
        rng = np.random.default_rng(self.seed)
        return dict(typical(self.what, motor(self.motor), STRENGTHS[self.strength], seconds=seconds, rng=rng))


def _case(part: str, what: str, strength: str, number: int, motions: tuple[str, ...]) -> CalibrationCase:
    motion = motions[(number + number // len(CLASSES)) % len(motions)]
    digest = hashlib.blake2b(f"calibration/{part}/{what}/{strength}/{number}".encode(), digest_size=5).digest()
    return CalibrationCase(part, what, strength, number, motion, SEEDS.start + int.from_bytes(digest, "little"))


def diagnosed(clean: int, rounds: int) -> Iterator[CalibrationCase]:
    """So many captures with nothing hidden, and so many of every cause and strength, each of another motor."""
    every = tuple(MOTIONS)
    for number in range(clean):
        yield _case("diagnosis", "nothing", "", number, every)
    number = clean
    for _ in range(rounds):
        for name in (n for n in LISTED if n not in _INVISIBLE):
            for strength in STRENGTHS:
                motions = BOUNDED if name == "position_dependent_friction" else every
                yield _case("diagnosis", name, strength, number, motions)
                number += 1
        for name in UNLISTED:
            yield _case("diagnosis", name, "clear", number, every)
            number += 1


def tracked(steady: int, rounds: int) -> Iterator[CalibrationCase]:
    """So many recordings of a motor that stays as it is, and so many of each change and each lack."""
    every = tuple(MOTIONS)
    for number in range(steady):
        yield _case("tracker", "nothing", "", number, every)
    number = steady
    for _ in range(rounds):
        for what in (*STEPS, "ageing", *LACKING):
            yield _case("tracker", what, "clear" if what in LACKING else "", number, every)
            number += 1


@dataclass(frozen=True, slots=True)
class Result:
    """What came of a run, and what each threshold was compared with meanwhile.

    Attributes:
        outcome: names found (diagnosis), or kinds of events (tracker).
        right: names found are those hidden; None of the tracker.
        seen: by threshold its value and the statistics, the least, the greatest and evenly between them.
    """

    case: CalibrationCase
    outcome: tuple[str, ...]
    right: bool | None
    seen: Mapping[str, tuple[float, tuple[float, ...]]]


#: Statistics kept of a run.
_MOST = 40
#: Of the generator, as it is where nothing else is asked for.
_RATE_HZ = Scenario().rate_hz


def run_case(case: CalibrationCase, seconds: float | None = None) -> Result:
    """Make the recording, run it, note what was compared."""
    run = _diagnose if case.part == "diagnosis" else _track
    packages = {
        "diagnosis": ("servo_daemon.diagnosis", "servo_daemon.identification.output_error"),
        "tracker": (
            "servo_daemon.kalman",
            "servo_daemon.regression",
            "servo_daemon.conditioning",
            "servo_daemon.tracking",
        ),
    }
    with watching(*packages[case.part]) as notes:
        outcome, right = run(case, seconds, notes)
    return Result(case, outcome, right, {name: _summary(n) for name, n in notes.items() if n.seen})


def _summary(notes: Notes) -> tuple[float, tuple[float, ...]]:
    seen = np.sort(notes.seen)
    if len(seen) > _MOST:
        seen = seen[np.linspace(0, len(seen) - 1, _MOST).round().astype(int)]
    return notes.value, tuple(float(f"{v:.4g}") for v in seen)


def _diagnose(case: CalibrationCase, seconds: float | None, notes: Mapping[str, Notes]) -> tuple[tuple[str, ...], bool]:
    seconds = seconds or DIAGNOSED_S
    effects = case.effects(seconds)
    scenario = Scenario(MOTIONS[case.motion], seconds=seconds, effects=effects, seed=case.seed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "capture.csv"
        generate(motor(case.motor), scenario).write_csv(path)
        found = tuple(sorted(e.name for e in diagnose([read_capture(path)]).effects))
    return found, set(found) == {n for n in effects if n in LISTED}


def _ageing(case: CalibrationCase, n: int) -> dict[str, F64]:
    """A step in the middle, or a change that begins there and ends with the recording."""
    own, late = motor(case.motor), np.clip(np.arange(n) / (n / 2) - 1.0, 0.0, None)
    if case.what in STEPS:
        return {name: np.where(late > 0, by, 1.0) * getattr(own, name) for name, by in STEPS[case.what].items()}
    if case.what == "ageing":
        return {name: by**late * getattr(own, name) for name, by in AGEING.items()}
    return {}


def _track(case: CalibrationCase, seconds: float | None, notes: Mapping[str, Notes]) -> tuple[tuple[str, ...], None]:
    """What the filter compares while it finds its values says nothing of a running one: of each threshold the half
    after the change counts, of those that have a say at the start only the first half."""
    own, seconds = motor(case.motor), seconds or TRACKED_S
    scenario = Scenario(
        MOTIONS[case.motion],
        seconds=seconds,
        effects=case.effects(seconds),
        ageing=_ageing(case, round(seconds * _RATE_HZ)),
        seed=case.seed,
    )
    made = generate(own, scenario)
    signals = {"voltage_V": made.voltage_V, "current_A": made.current_A, "position_rad": made.position_rad}
    nominal = {name: by * float(getattr(own, name)) for name, by in _DATASHEET.items()}
    load = {"counts_per_rev": own.counts_per_rev}
    pipeline = Pipeline(DriveConfig.model_validate({"nominal": nominal, "load": load}))
    block = make_block(made.time_s, **signals)
    pipeline.process(block.slice(0, len(block) // 2), rows=False)
    early = {name: list(n.seen) for name, n in notes.items()}
    for n in notes.values():
        n.seen.clear()
    pipeline.process(block.slice(len(block) // 2, len(block)), rows=False)
    for name, n in notes.items():
        n.seen.extend(() if n.seen else early[name])
    return tuple(sorted({kind for kind, _, _ in pipeline.messages})), None
