"""Captures that hide an effect, and what a diagnosis makes of them.

The independent generator writes a CSV; the diagnosis sees nothing else. A case is named by its cause ("gravity_load",
a pair "coulomb_friction+cogging_torque", "clean", or a cause that the library does not hold), its strength, motor,
motion and seed: `python -m tests.recovery.hidden CAUSE STRENGTH MOTOR MOTION SEED` runs one and prints it.
"""

from __future__ import annotations

import hashlib
import json
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from servo_daemon.captures import read_capture
from servo_daemon.diagnosis.diagnose import diagnose
from servo_daemon.diagnosis.verdict.result import Diagnosis
from tests.recovery.gain import of_true_structure
from tests.recovery.generator import LISTED, MOTORS, UNLISTED, EffectValues, Scenario, generate, typical

#: Shares of the working torque or voltage (see generator/sizes.py).
STRENGTHS: Mapping[str, float] = {"clear": 0.2, "faint": 0.04}
#: Causes that data of one motor alone cannot show: the same as another torque constant, inertia and friction.
INVISIBLE = ("current_sensor_gain",)
PAIRS = (
    ("coulomb_friction", "cogging_torque"),
    ("coulomb_friction", "brush_voltage_drop"),
    ("stribeck_friction", "gravity_load"),
    ("gravity_load", "quadratic_drag"),
    ("constant_load_torque", "coulomb_friction"),
    ("periodic_disturbance", "coulomb_friction"),
    ("winding_heating", "coulomb_friction"),
    ("encoder_eccentricity", "coulomb_friction"),
)
#: Three causes that the library does not hold, of those that the generator knows.
UNNAMED = ("eddy_brake", "hysteresis_spring", "torque_dropouts")
_MOTIONS = ("multisine", "steps", "reversals", "pick_and_place")
_BOUNDED = ("steps", "pick_and_place")
SECONDS = 20.0
#: Seeds of the cases that are drawn. Those that a test names are smaller: what a test was written for is in no draw.
DRAWN = range(2**40, 2**41)


@dataclass(frozen=True, slots=True)
class Case:
    """One capture; `current`: whether it has one."""

    cause: str
    strength: str
    motor: str
    motion: str
    seed: int
    current: bool = True

    @property
    def key(self) -> str:
        sensors = "" if self.current else "/without current"
        return f"{self.cause}/{self.strength}/{self.motor}/{self.motion}/{self.seed}{sensors}"

    def shows(self, effect: str) -> bool:
        """Whether one capture of these channels can show an effect of the library."""
        by_current = effect.startswith("current_sensor") or self.effects()[effect].get("channel") == "current_A"
        return effect in LISTED and effect not in INVISIBLE and (self.current or not by_current)

    def effects(self, seconds: float = SECONDS) -> dict[str, EffectValues]:
        """What is hidden, with its parameters."""
        if self.cause == "clean":
            return {}
        rng = np.random.default_rng(self.seed)
        motor, share = MOTORS[self.motor], STRENGTHS[self.strength]
        out: dict[str, EffectValues] = {}
        for name in self.cause.split("+"):
            out |= typical(name, motor, share, seconds=seconds, rng=rng)
        return out


@dataclass(frozen=True, slots=True)
class Judgement:
    """What came of a case.

    Attributes:
        expected, found: names of effects.
        verdict: of the diagnosis.
        tied: names that the diagnosis says fit as well as one of those found.
        outside: parameters of effects named right that are more than 3 std from the truth.
        checked: how many of them there were.
        removed: share of the removable held-out error that went; None where nothing was named.
        of_true: what went as a share of what goes with the true causes fitted; see `gain`.
        seconds: time taken by the diagnosis.
    """

    case: Case
    expected: tuple[str, ...]
    found: tuple[str, ...]
    verdict: str
    tied: tuple[str, ...]
    outside: tuple[str, ...]
    checked: int
    removed: float | None
    of_true: float | None
    seconds: float

    @property
    def right(self) -> bool:
        """All that is hidden was named and nothing else; of causes without a name, none was."""
        return set(self.found) == set(self.expected)

    @property
    def wrong_name(self) -> bool:
        """Something was named that is not there."""
        return bool(set(self.found) - set(self.expected))


def judge(case: Case, seconds: float = SECONDS) -> Judgement:
    """Make a capture of so many seconds, diagnose it, compare."""
    effects, motor = case.effects(seconds), MOTORS[case.motor]
    recording = generate(motor, Scenario(case.motion, seconds=seconds, effects=effects, seed=case.seed))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "capture.csv"
        recording.write_csv(path)
        capture = read_capture(path)
    if not case.current:
        capture = replace(capture, current_A=None)
    diagnosis = diagnose([capture])
    expected = tuple(name for name in effects if case.shows(name))
    found = tuple(e.name for e in diagnosis.effects)
    outside, checked = _parameters(diagnosis, effects)
    return Judgement(
        case,
        expected,
        found,
        diagnosis.verdict,
        tuple(sorted({name for e in diagnosis.effects for name in e.equivalent})),
        outside,
        checked,
        diagnosis.error_removed,
        of_true_structure(capture, diagnosis, motor, effects) if set(expected) == set(effects) else None,
        diagnosis.seconds,
    )


def _parameters(diagnosis: Diagnosis, effects: Mapping[str, EffectValues]) -> tuple[tuple[str, ...], int]:
    """Parameters of effects named right beyond 3 std, and how many were compared."""
    outside, checked = [], 0
    for name in (e.name for e in diagnosis.effects if e.name in effects):
        for key, true in effects[name].items():
            p = diagnosis.final.parameters.get(key)
            if p is None or p.value is None or not p.std or isinstance(true, str):
                continue
            error = p.value - float(true)
            if key.startswith("phi"):
                error = (error + np.pi) % (2 * np.pi) - np.pi
            checked += 1
            if abs(error) > 3 * p.std:
                outside.append(f"{key} {error / p.std:+.1f} σ ({error / max(abs(float(true)), 1e-30):+.1%})")
    return tuple(outside), checked


def cases(draw: int, repeats: int = 1, clean: int = 400) -> Iterator[Case]:
    """The matrix, a fraction of all combinations: every cause meets every motor and every motion, in turn.

    Args:
        draw: another one has other seeds and another order of the motions.
        repeats: how often each cause, strength and motor appear.
        clean: captures with nothing hidden.
    """
    names = list(MOTORS)
    for round_ in range(draw, draw + repeats):
        for number, name in enumerate(LISTED):
            for strength in STRENGTHS:
                for k, motor in enumerate(names):
                    motions = _BOUNDED if name == "position_dependent_friction" else _MOTIONS
                    motion = motions[(number + k + round_ + (strength == "faint")) % len(motions)]
                    yield _case(draw, name, strength, motor, motion, round_)
        for number, pair in enumerate(PAIRS):
            for k, motor in enumerate(names):
                yield _case(draw, "+".join(pair), "clear", motor, _MOTIONS[(number + k + round_) % 4], round_)
        for number, name in enumerate(UNNAMED):
            for k, motor in enumerate(names):
                yield _case(draw, name, "clear", motor, _MOTIONS[(number + k + round_) % 4], round_)
    for k in range(clean):
        yield _case(draw, "clean", "clear", names[k % 4], _MOTIONS[k // 4 % 4], k // 16)


def _case(draw: int, cause: str, strength: str, motor: str, motion: str, repeat: int) -> Case:
    digest = hashlib.blake2b(f"{draw}/{cause}/{strength}/{motor}/{motion}/{repeat}".encode(), digest_size=5).digest()
    return Case(cause, strength, motor, motion, DRAWN.start + int.from_bytes(digest, "little"))


if __name__ == "__main__":
    cause, strength, motor, motion, seed = sys.argv[1:]
    if cause not in {*LISTED, *UNLISTED, "clean"} and "+" not in cause:
        sys.exit(f"no cause {cause!r}")
    print(json.dumps(asdict(judge(Case(cause, strength, motor, motion, int(seed)))), indent=1, ensure_ascii=False))
