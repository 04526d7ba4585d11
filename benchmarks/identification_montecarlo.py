"""Whether `fit` says how well it knows: many noisy captures of the independent generator, each fitted.

For every parameter z = (estimate − truth)/reported std, in the coordinate that is estimated (the logarithm). A right
answer has mean 0, standard deviation 1, and |z| < 1.96 in 95 % of the captures. Beside it the same of plain output
error (`noise_model="none"`), which takes noise that enters the motor for the sensors' own.

    .venv/bin/python -m benchmarks.identification_montecarlo --runs 300
    .venv/bin/python -m benchmarks.identification_montecarlo --runs 2000 --motors paper --motions multisine

Noise: `laboratory` (sensors, encoder steps, sampling jitter, voltage noise of 0.1 % of the supply that is not
recorded), `pieces` (the same, eight pieces of voltage noise a sample), `sensors` (white Gaussian noise of current and
angle alone, of the laboratory's size), `pwm` (laboratory, the voltage switched at about 20 kHz).
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np
from tqdm import tqdm

from servo_daemon.identification.output_error import FitOptions, Recording, fit_output_error
from servo_daemon.samples import SampleBlock, make_block
from tests.recovery.generator import MOTORS, Motor, Scenario, Sensors, generate

NAMES = ("R", "L", "K", "J", "B")
NOISES = ("laboratory", "pieces", "sensors", "pwm")
MOTIONS = ("multisine", "steps", "prbs", "pick_and_place")


@dataclass(frozen=True, slots=True)
class Case:
    """One capture's make-up."""

    motor: str
    motion: str
    noise: str
    seconds: float = 2.0


@dataclass(frozen=True, slots=True)
class Run:
    """z, shape (5,), and relative std by parameter; whether a noise model was used and what remains is white."""

    z: np.ndarray
    std: np.ndarray
    modelled: bool
    white: bool


def sensors_of(motor: Motor, noise: str) -> Sensors:
    """What the instruments do."""
    laboratory = Sensors.laboratory(motor)
    return {
        "laboratory": laboratory,
        "pieces": replace(laboratory, hidden_pieces=8),
        "sensors": Sensors(current_noise_A=laboratory.current_noise_A),
        "pwm": replace(laboratory, pwm_hz=20_000.0),
    }[noise]


def capture(case: Case, seed: int) -> SampleBlock:
    """A capture; the angle's noise of `sensors` has the RMS of the encoder's steps."""
    motor = MOTORS[case.motor]
    made = generate(motor, Scenario(case.motion, case.seconds, seed=seed, sensors=sensors_of(motor, case.noise)))
    angle = made.position_rad
    if case.noise == "sensors":
        rms = 2 * np.pi / motor.counts_per_rev / np.sqrt(12.0)
        angle = angle + np.random.default_rng(seed).normal(0.0, rms, len(angle))
    return make_block(made.time_s, voltage_V=made.voltage_V, current_A=made.current_A, position_rad=angle)


def one(case: Case, noise_model: str, seed: int) -> Run:
    """Fit one capture."""
    motor = MOTORS[case.motor]
    block = capture(case, seed)
    fit = fit_output_error([Recording("capture", block)], (), FitOptions(noise_model=noise_model))  # type: ignore[arg-type]
    truth = np.array([getattr(motor, name) for name in NAMES])
    found = [fit.parameters[name] for name in NAMES]
    value = np.array([np.nan if p.value is None else p.value for p in found])
    std = np.array([np.nan if not p.std else p.std for p in found]) / value
    return Run(np.log(value / truth) / std, std, fit.noise is not None, fit.white)


def line(case: Case, noise_model: str, runs: list[Run]) -> str:
    """One line of the table."""
    z = np.array([r.z for r in runs])
    known = np.isfinite(z)

    def row(values: np.ndarray, form: str) -> str:
        return " ".join(f"{v:{form}}" for v in values)

    z_std, mean = np.nanstd(z, axis=0, ddof=1), np.nanmean(z, axis=0)
    inside = 100 * (np.abs(z) < 1.96).sum(axis=0) / known.sum(axis=0)
    spread = 100 * np.nanmedian([r.std for r in runs], axis=0)
    return (
        f"{case.motor:6s} {case.motion:15s} {case.noise:11s} {noise_model:5s} | {row(z_std, '5.2f')} | "
        f"{row(mean, '5.2f')} | {row(inside, '5.1f')} | {row(spread, '6.3f')} | "
        f"{100 * np.mean([r.modelled for r in runs]):4.0f} {100 * np.mean([r.white for r in runs]):4.0f} "
        f"{100 * (1 - known.mean()):5.1f}"
    )


def cases(arguments: argparse.Namespace) -> Iterator[Case]:
    for motor, motion, noise in product(arguments.motors, arguments.motions, arguments.noises):
        yield Case(motor, motion, noise, arguments.seconds)


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--runs", type=int, default=40, help="captures of each line")
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--motors", nargs="+", default=list(MOTORS), choices=list(MOTORS))
    parser.add_argument("--motions", nargs="+", default=["multisine", "pick_and_place"], choices=MOTIONS)
    parser.add_argument("--noises", nargs="+", default=["laboratory"], choices=NOISES)
    parser.add_argument("--models", nargs="+", default=["auto", "none"], choices=("auto", "none"))
    parser.add_argument("--seed", type=int, default=0, help="of the first capture")
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    return parser.parse_args()


def main() -> None:
    arguments = parsed()
    print(f"{arguments.runs} captures of {arguments.seconds:g} s at 1 kHz each; R L K J B; seed {arguments.seed}")
    print(f"{'':39s}  | std of z{'':22s} | mean of z{'':21s} | % within 95 %{'':17s} | std, %{'':29s} | % noise model,")
    print(f"{'':39s}  | {'':29s} | {'':29s} | {'':29s} | {'':34s} | white, not determined")
    seeds = range(arguments.seed, arguments.seed + arguments.runs)
    with ProcessPoolExecutor(arguments.jobs) as pool:
        for case, model in product(cases(arguments), arguments.models):
            found = pool.map(partial(one, case, model), seeds, chunksize=4)
            runs = list(tqdm(found, total=len(seeds), file=sys.stderr, leave=False, disable=not sys.stderr.isatty()))
            print(line(case, model, runs), flush=True)


if __name__ == "__main__":
    main()
