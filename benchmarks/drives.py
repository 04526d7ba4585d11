"""Drives of the makes: what `fit` and the daemon make of each link, against the truth.

    python -m benchmarks.drives                   # two motors, two motions, two runs of each on every link
    python -m benchmarks.drives --only vesc --runs 1

The motors are those of tests/recovery/foc, under field-oriented control at 20 kHz with equations of their own, and for
servos those of tests/recovery/generator; what they do is played to the simulated drives of `sim-drive`, whose bytes the
drivers read. Shown are the root mean squares of the errors in % over the runs (in brackets those of so many of them
that claimed it, where that was not all) and how many of the claimed values are within their 95 % intervals.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import math
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np

from servo_daemon.captures.write import CaptureWriter
from servo_daemon.commands.fit.command import add_arguments
from servo_daemon.commands.fit.fitting import fitted as fit_of
from servo_daemon.config import DriveConfig
from servo_daemon.errors import ServoDaemonError
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.samples import SampleBlock
from servo_daemon.signal_meaning import as_texts
from tests.recovery.foc import played
from tests.recovery.foc.motor import OUTRUNNER, SMALL, FocMotor, Trace, multisine, pick_and_place, run
from tests.recovery.foc.played import Wire
from tests.recovery.generator import GEAR_MOTOR, Motor, Scenario, Sensors, generate

SECONDS = 20.0
NAMES = ("R", "K", "J", "B", "Tc")
COULOMB = "coulomb_friction"
#: Value and 1 σ by name; only what is claimed.
Found = Mapping[str, tuple[float, float]]
#: Motor, noise of its current sensor (A), size of the motion (rad/s), dry friction on links that are asked for it
#: (N·m): a fifth of the torque that the motion takes.
FOC: Mapping[str, tuple[FocMotor, float, float, float]] = {
    "outrunner": (OUTRUNNER, 0.05, 40.0, 0.04),
    "small": (SMALL, 0.003, 30.0, 1.5e-3),
}
#: The size of an XM430-W350 by its data sheet's stall and no-load figures, seen at its output; load and friction ours.
XM430 = Motor("xm430", 5.2, 2e-3, 1.9, 8e-3, 0.02, 12.0, 1.0, 2.3, 4096, "data sheet (R, K); load plausible")
#: Brushed motors and their dry friction, N·m.
SERVOS: Mapping[str, tuple[Motor, float]] = {"gear": (GEAR_MOTOR, 0.05), "xm430": (XM430, 0.15)}


@dataclass(frozen=True)
class Link:
    """A row of the table.

    Attributes:
        limits: %, by name; of what has none nothing was asked for.
        effects: of the motor and of the model.
        small: other limits on the small motor, whose current comes in coarse steps.
    """

    name: str
    hz: float
    wire: Wire
    limits: Mapping[str, float]
    effects: tuple[str, ...] = ()
    brushed: bool = False
    small: Mapping[str, float] = field(default_factory=dict)


def _limits(*values: float) -> dict[str, float]:
    return dict(zip(NAMES, values, strict=False))


_MEANS, _FAST, _WITH_TORQUE = _limits(1, 1, 3, 3), _limits(1, 1, 2, 3), {"J": 1.0, "B": 2.0, "Tc": 5.0}
#: B and Tc of a servo are asked for together, as the friction at the motion's rms speed: see `errors_of`.
_SERVO = {"R": 3.0, "K": 2.0, "J": 5.0, "B + Tc": 5.0}
_CAN = {1000: _limits(1, 1, 3, 3), 200: _limits(2, 1, 5, 5), 50: _limits(5, 2, 10, 10)}
LINKS = (
    *(Link("VESC, polled means", hz, played.vesc_polled, _MEANS, small={"R": 5.0}) for hz in (20, 50, 200, 500)),
    *(Link("VESC, CAN", hz, played.vesc_can, _CAN[hz]) for hz in (1000, 200, 50)),
    Link("moteus, q_V", 200, partial(played.moteus, signal="voltage"), _FAST),
    *(Link("SimpleFOC", hz, played.simplefoc, _FAST) for hz in (100, 300, 1000)),
    Link("ODrive 0.6, torque", 100, partial(played.odrive_can, generation="0.6"), _WITH_TORQUE, (COULOMB,)),
    Link("ODrive 0.5, Iq and K", 100, partial(played.odrive_can, generation="0.5"), _WITH_TORQUE, (COULOMB,)),
    Link("ODrive 0.6, asked", 200, played.odrive_asked, {}),
    *(
        Link("Dynamixel", hz, partial(played.servo, kind="dynamixel"), _SERVO, (COULOMB,), brushed=True)
        for hz in (100, 500)
    ),
    Link("Feetech", 500, partial(played.servo, kind="feetech"), {}, (COULOMB,), brushed=True),
    Link("moteus, torque", 1000, partial(played.moteus, signal="torque"), {}),
    Link("CiA 402, torque", 500, played.cia402, {}),
    Link("MIT mode", 500, played.mit, {}),
)


@dataclass(frozen=True)
class Source:
    """A motor in motion: its trace or recording, and what is true of it by what is published."""

    motor: FocMotor | Motor
    data: Any
    effects: tuple[str, ...]

    def truth(self, publish: str) -> dict[str, float]:
        if isinstance(self.motor, FocMotor):
            return self.motor.equivalent(publish)
        m = self.motor
        return {"R": m.R, "L": m.L, "K": m.K, "J": m.J, "B": m.B, "Tc": SERVOS[m.name][1]}

    @property
    def rms_speed(self) -> float:
        speed = self.data.w if isinstance(self.data, Trace) else self.data.truth.speed_rad_s
        return float(np.sqrt(np.mean(np.square(speed))))


@cache
def source(motor_name: str, motion: str, number: int, effects: tuple[str, ...]) -> Source:
    """The same motion with other phases and another noise for every number."""
    if motor_name in SERVOS:
        motor, Tc = SERVOS[motor_name]
        sensors = Sensors(current_noise_A=0.003 * motor.rated_current_A, counts_per_rev=4096)
        hidden = {COULOMB: {"Tc": Tc}} if COULOMB in effects else {}
        plan = motion.replace(" ", "_")
        return Source(
            motor, generate(motor, Scenario(plan, SECONDS + 1, 1000, hidden, sensors=sensors, seed=number)), effects
        )
    foc, noise_A, size, Tc = FOC[motor_name]
    if COULOMB in effects:
        foc = FocMotor(**{**{n: getattr(foc, n) for n in foc.__dataclass_fields__}, "Tc": Tc})
    speed = multisine(size, 1 + number) if motion == "multisine" else pick_and_place(1.5 * size * (1 - 0.1 * number))
    return Source(foc, run(foc, speed, SECONDS + 0.1, noise_A=noise_A, seed=number), effects)


def by_fit(
    blocks: list[SampleBlock], read: played.Read, nominal: Mapping[str, float], effects: tuple[str, ...]
) -> Found:
    """As `servo-daemon record`, then `fit`."""
    meaning, counts = read.driver.meaning, read.driver.info.counts_per_rev
    metadata = ({} if meaning is None else as_texts(meaning)) | ({"counts_per_rev": f"{counts:g}"} if counts else {})
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(io.StringIO()):
        path = Path(folder) / "link.csv"
        with CaptureWriter(path, metadata=metadata) as writer:
            for block in blocks:
                writer.write(block)
        more = [f"--effect={e}" for e in effects]
        more += ["--fix=" + ",".join(f"{n}={v!r}" for n, v in nominal.items())] if nominal else []
        rows = fit_of(parser.parse_args([str(path), *more])).document["parameters"]
    return {n: (rows[n]["value"], rows[n]["std"]) for n in NAMES if n in rows and rows[n]["std"] is not None}


def live(blocks: list[SampleBlock], read: played.Read, nominal: Mapping[str, float], effects: tuple[str, ...]) -> Found:
    """At the end of the same samples, what the daemon calls `tracking`."""
    config = DriveConfig(nominal=dict(nominal), model=list(effects))
    pipeline = Pipeline(config, read.driver.info, meaning=read.driver.meaning)
    for block in blocks:
        pipeline.process(block, rows=False)
    estimate = pipeline.finish() or pipeline.current()
    tracked = [p for p in estimate.parameters if p.status == "tracking"] if estimate is not None else []
    return {p.name: (p.value, p.std) for p in tracked if p.name in NAMES and p.value is not None and p.std is not None}


def claimed(way: Callable[..., Found], *given: Any, what: str) -> Found:
    """What fit or daemon claim beside what was given; nothing where there is an error, which is shown."""
    _, _, nominal, _ = given
    try:
        return {name: pair for name, pair in way(*given).items() if name not in nominal}
    except ServoDaemonError as error:
        print(f"{what}: {error}", file=sys.stderr)
        return {}


@dataclass
class Errors:
    """Of one link, on one way (fit or daemon): relative errors by name, and how many intervals hold."""

    runs: int = 0
    by_name: dict[str, list[float]] = field(default_factory=dict)
    inside: int = 0
    far: int = 0
    claimed: int = 0

    def take(self, found: Found, true: Mapping[str, float], rms_speed: float, *, together: bool) -> None:
        self.runs += 1
        for name, (value, std) in found.items():
            self.claimed += 1
            self.inside += abs(value - true[name]) < 1.96 * std
            self.far += abs(value - true[name]) > max(4.0 * std, 0.03 * true[name])
            self.by_name.setdefault(name, []).append(value / true[name] - 1.0)
        if together and {"B", "Tc"} <= set(found):
            torque = [d["B"] * rms_speed + d["Tc"] for d in ({n: v for n, (v, _) in found.items()}, true)]
            self.by_name.setdefault("B + Tc", []).append(torque[0] / torque[1] - 1.0)

    def cell(self, name: str) -> str:
        errors = self.by_name.get(name, [])
        if not errors:
            return "–"
        rms = f"{100.0 * math.sqrt(sum(e * e for e in errors) / len(errors)):.2g}"
        return rms if len(errors) == self.runs else f"{rms} ({len(errors)})"

    def beyond(self, limits: Mapping[str, float]) -> list[str]:
        """Names whose rms is beyond its limit."""
        return [
            n for n, most in limits.items()
            if (e := self.by_name.get(n)) and 100.0 * math.sqrt(sum(x * x for x in e) / len(e)) > most
        ]  # fmt: skip


def runs(link: Link, motor: str, count: int) -> Iterator[tuple[Found, Found, Mapping[str, float], float]]:
    """By fit, by the daemon, the truth and the motion's rms speed, of each run."""
    for motion in ("multisine", "pick and place"):
        for number in range(count):
            of = source(motor, motion, number, link.effects)
            # The second run reads in the middle of what the first one reads at its control's own steps.
            after_s = 3e-4 * number
            read = link.wire(of.motor, of.data, after_s, link.hz, SECONDS)
            blocks = list(read.blocks)
            truth = of.truth(read.driver.meaning.publish if read.driver.meaning is not None else "phase")
            nominal = played.nominal_of(read, truth)
            given = read, nominal, link.effects
            what = f"{link.name} {link.hz:g} Hz, {motor}, {motion}"
            fitted, tracked = (claimed(way, blocks, *given, what=what) for way in (by_fit, live))
            yield fitted, tracked, truth, of.rms_speed


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.drives")
    parser.add_argument("--only", default="", help="links whose name has this in it")
    parser.add_argument("--runs", type=int, default=2, help="of each motor and motion")
    asked = parser.parse_args()
    shown = ("R", "K", "J", "B", "Tc", "B + Tc")
    print(f"| link | Hz | motor | by | {', '.join(shown)}: rms error, % | limits | inside 95 % | beyond |")
    print("|---" * 8 + "|")
    total = {"fit": Errors(), "daemon": Errors()}
    for link in (one for one in LINKS if asked.only.lower() in one.name.lower()):
        for motor in SERVOS if link.brushed else FOC:
            limits = {**link.limits, **(link.small if motor == "small" else {})}
            ways = {"fit": Errors(), "daemon": Errors()}
            for fitted, tracked, truth, speed in runs(link, motor, asked.runs):
                for way, found in zip(ways, (fitted, tracked), strict=True):
                    ways[way].take(found, truth, speed, together=link.brushed)
                    total[way].take(found, truth, speed, together=False)
            for way, errors in ways.items():
                names = [n for n in shown if n in errors.by_name or n in limits]
                cells = ", ".join(f"{n} {errors.cell(n)}" for n in names)
                most = " / ".join(f"{limits[n]:g}" if n in limits else "·" for n in names) if limits else ""
                inside = f"{errors.inside} of {errors.claimed}"
                beyond = ", ".join(errors.beyond(limits)) + (f"; {errors.far} far" if errors.far else "")
                print(
                    f"| {link.name} | {link.hz:g} | {motor} | {way} | {cells} | {most} | {inside} | {beyond} |",
                    flush=True,
                )
    for way, e in total.items():
        print(
            f"{way}: {e.inside} of {e.claimed} claimed values within their 95 % intervals, {e.far} beyond 4 σ and 3 %"
        )


if __name__ == "__main__":
    main()
