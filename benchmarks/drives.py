"""Drives whose voltage is a measurement: what `fit` and the daemon make of each link, against the truth.

    python benchmarks/drives.py             # two motors, two motions, polled means and instants
    python benchmarks/drives.py --quick     # the larger motor

The motor is that of tests/recovery/foc: under field-oriented control at 20 kHz, with equations of its own. Shown are
errors in % and, in brackets, the claimed 1 σ; "–" is not claimed. Inside: how many of all claimed values are within
their 95 % intervals, and within 4 σ or 3 %.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from servo_daemon.captures import Capture, write_capture
from servo_daemon.commands.fit.command import add_arguments
from servo_daemon.commands.fit.document import fit_document
from servo_daemon.commands.fit.inputs import gather
from servo_daemon.config import DriveConfig
from servo_daemon.identification import IdentifyOptions, identify
from servo_daemon.identification.output_error import FitOptions
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.samples import SampleBlock, make_block
from servo_daemon.signal_meaning import SignalMeaning, as_texts
from tests.recovery.foc.motor import OUTRUNNER, SMALL, FocMotor, instants, multisine, pick_and_place, polled, run

SECONDS = 10.0
LINKS = (("mean", 20), ("mean", 50), ("mean", 200), ("mean", 500), ("instant", 50), ("instant", 200), ("instant", 1000))
NAMES = ("R", "K", "J", "B")
#: Value and 1 σ by name; only what is claimed.
Found = Mapping[str, tuple[float, float]]


def by_fit(block: SampleBlock, meaning: SignalMeaning, folder: Path) -> Found:
    """As `servo-daemon fit` of a capture with these lines."""
    path = folder / "link.csv"
    write_capture(path, block, metadata=as_texts(meaning))
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    inputs = gather(parser.parse_args([str(path)]), [path])
    captures: tuple[Capture, ...] = inputs.captures
    options = FitOptions(nominal=inputs.nominal, fixed=inputs.fixed)
    document = fit_document(identify(captures, (), IdentifyOptions(fit=options)), inputs.winding, inputs.meaning)
    rows = document["parameters"]
    return {n: (rows[n]["value"], rows[n]["std"]) for n in NAMES if rows[n]["std"] is not None}


def live(block: SampleBlock, meaning: SignalMeaning) -> Found:
    """At the end of the same samples, what the daemon calls `tracking`."""
    pipeline = Pipeline(DriveConfig(), meaning=meaning)
    pipeline.process(block, rows=False)
    estimate = pipeline.finish() or pipeline.current()
    assert estimate is not None
    return {
        p.name: (p.value, p.std)
        for p in estimate.parameters
        if p.name in NAMES and p.status == "tracking" and p.value is not None and p.std is not None
    }


def links(motor: FocMotor, noise_A: float, size: float) -> Iterator[tuple[str, str, float, SampleBlock, SignalMeaning]]:
    """Both motions over every link."""
    for motion, speed in (("multisine", multisine(size)), ("pick and place", pick_and_place(1.5 * size))):
        trace = run(motor, speed, SECONDS, noise_A=noise_A)
        for kind, hz in LINKS:
            columns = polled(trace, hz) if kind == "mean" else instants(trace, hz)
            current = "mean" if kind == "mean" else "instant"
            meaning = SignalMeaning(kind, current, "dq", pole_pairs=motor.pole_pairs)
            yield motion, kind, hz, make_block(columns.pop("time_s"), **columns), meaning


def shown(found: Found, true: Mapping[str, float]) -> str:
    cells = []
    for n in NAMES:
        if n not in found:
            cells.append(f"{'–':>14}")
            continue
        value, std = found[n]
        cells.append(f"{100 * (value / true[n] - 1):+7.2f} ({100 * std / value:4.1f})")
    return " ".join(cells)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="the larger motor only")
    quick = parser.parse_args().quick
    inside, near, claimed = 0, 0, 0
    motors = (("outrunner", OUTRUNNER, 0.05, 40.0), ("small", SMALL, 0.003, 30.0))
    print(f"{'motor, motion, link':<38} {'fit: R, K, J, B':<60} daemon")
    with tempfile.TemporaryDirectory() as folder:
        for name, motor, noise_A, size in motors[:1] if quick else motors:
            true = motor.equivalent("phase")
            for motion, kind, hz, block, meaning in links(motor, noise_A, size):
                both = by_fit(block, meaning, Path(folder)), live(block, meaning)
                print(f"{name}, {motion}, {kind} {hz:g} Hz".ljust(38), *(shown(f, true) for f in both), flush=True)
                errors = [(abs(v - true[n]), s, true[n]) for f in both for n, (v, s) in f.items()]
                claimed += len(errors)
                inside += sum(e < 1.96 * s for e, s, _ in errors)
                near += sum(e < max(4.0 * s, 0.03 * t) for e, s, t in errors)
    print(f"inside 95 % intervals: {inside} of {claimed}; within 4 σ or 3 %: {near}")


if __name__ == "__main__":
    main()
