"""A load hidden behind a drive whose voltage is a measurement, and what a diagnosis of its samples names."""

from __future__ import annotations

import argparse
import contextlib
import io
import math
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from servo_daemon.captures import write_capture
from servo_daemon.commands.diagnose.command import add_arguments
from servo_daemon.commands.diagnose.diagnosing import diagnosed
from servo_daemon.samples import make_block
from servo_daemon.signal_meaning import SignalMeaning, as_texts
from tests.recovery.foc.motor import OUTRUNNER, SMALL, FocMotor, instants, multisine, pick_and_place, polled, run

SECONDS = 20.0
#: Share of the torque that the bare motor needs for the motion (standard deviation), as `clear` of the matrix.
SHARE = 0.2
#: Motor, noise of its current sensor (A), size of the motion (rad/s).
MOTORS = {"outrunner": (OUTRUNNER, 0.05, 40.0), "small": (SMALL, 0.003, 30.0)}
MOTIONS: dict[str, Callable[[float], Callable[[float], float]]] = {
    "multisine": multisine,
    "pick and place": lambda size: pick_and_place(1.5 * size),
}
#: Kind of the samples and their rate, Hz.
LINKS = (("mean", 200), ("mean", 500), ("instant", 200), ("instant", 1000))
#: Torque against positive motion for an amplitude in N·m, by the name of the cause; angles in rad, speeds in rad/s.
LOADS: dict[str, Callable[[float], Callable[[float, float], float]]] = {
    "coulomb_friction": lambda a: lambda _th, w: a * math.tanh(w / 0.05),
    "constant_load_torque": lambda a: lambda _th, _w: a,
    "gravity_load": lambda a: lambda th, _w: a * math.sin(th - 0.6),
    "cogging_torque": lambda a: lambda th, _w: a * math.sin(7 * th + 0.4),
    "clean": lambda _a: lambda _th, _w: 0.0,
}


@dataclass(frozen=True, slots=True)
class LinkCase:
    """One cause behind one link."""

    cause: str
    motor: str
    motion: str
    kind: str
    hz: int
    seed: int

    @property
    def key(self) -> str:
        return f"{self.cause}/{self.motor}/{self.motion}/{self.kind}/{self.hz}/{self.seed}"

    @property
    def expected(self) -> tuple[str, ...]:
        return () if self.cause == "clean" else (self.cause,)


@dataclass(frozen=True, slots=True)
class Named:
    """What a diagnosis named; seconds it took."""

    case: LinkCase
    found: tuple[str, ...]
    verdict: str
    seconds: float


def cases(seed: int) -> list[LinkCase]:
    """Every cause on every motor, motion and link."""
    return [
        LinkCase(cause, motor, motion, kind, hz, seed + k)
        for k, (cause, motor, motion, (kind, hz)) in enumerate(
            (c, m, o, link) for c in LOADS for m in MOTORS for o in MOTIONS for link in LINKS
        )
    ]


def judge(case: LinkCase) -> Named:
    """Run the motor, read it over the link, write the samples to a file, and ask as `servo-daemon diagnose FILE`."""
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(io.StringIO()):
        path = Path(folder) / "link.csv"
        _write(case, path)
        document = diagnosed(parser.parse_args([str(path)])).document
    return Named(case, tuple(e["name"] for e in document["effects"]), document["verdict"], document["seconds"])


def _write(case: LinkCase, path: Path) -> None:
    motor, noise_A, size = MOTORS[case.motor]
    speed = MOTIONS[case.motion](size)
    amplitude = SHARE * _working_torque(motor, speed)
    trace = run(motor, speed, SECONDS, noise_A=noise_A, seed=case.seed, load=LOADS[case.cause](amplitude))
    columns = (polled if case.kind == "mean" else instants)(trace, case.hz, seed=case.seed)
    meaning = SignalMeaning(case.kind, case.kind, "dq", pole_pairs=motor.pole_pairs)
    write_capture(path, make_block(columns.pop("time_s"), **columns), metadata=as_texts(meaning))


def _working_torque(motor: FocMotor, speed: Callable[[float], float]) -> float:
    """Standard deviation of the torque that follows the motion, N·m."""
    t = np.arange(0.0, SECONDS, 1e-3)
    w = np.array([speed(x) for x in t])
    return float(np.std(motor.J * np.gradient(w, t) + motor.B * w))
