"""`cost`: a filter step in C and in the virtual machine against filterpy, and 32 drives at 1 kHz."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from servo_daemon.config import DriveConfig
from servo_daemon.kalman.ekf import Ekf, Loop
from servo_daemon.kalman.filterpy_ekf import FilterpyLoop
from servo_daemon.kalman.model import build_ekf_step
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.pipeline.publish import resolutions
from servo_daemon.plant.build import build_plant
from servo_daemon.plant.compiled import SampleLoop
from servo_daemon.samples import F64, SampleBlock, make_block
from servo_daemon.tracking.plan.settings import TrackerSettings
from servo_daemon.tracking.plant_tracker import make_tracker
from tests.recovery.generator import MOTORS, PAPER, Scenario, generate
from tests.recovery.tracking.bound import CHANNELS, WALK_PER_SQRT_MIN, bound_recording, known_noise_filter, rows
from tests.recovery.tracking.follow import NAMES, info_of

from .rival_filters import Task, filterpy_ekf

DRIVES, WARM_S, MEASURED_S, BLOCK = 32, 20.0, 20.0, 100
REPEATS, RIVAL_SAMPLES = 5, 3000
LIMIT_US = {"c": 2.5, "vm": 15.0}
LIMIT_FILTERPY, LIMIT_DRIVES = 30.0, 0.15


def report_cost() -> None:
    """Prints both."""
    _report_step()
    _report_drives()


def _report_step() -> None:
    recording, variances = bound_recording(PAPER, "multisine", 30.0, 1)
    drift = WALK_PER_SQRT_MIN**2 / 60
    plant = build_plant()
    _, function = build_ekf_step(plant, CHANNELS)
    template = known_noise_filter(np.log([getattr(PAPER, n) for n in NAMES]), variances, drift, 1)
    samples = rows(recording, template.layout)

    def shortest_us(loop: Loop, taken: F64, repeats: int) -> float:
        best = np.inf
        for _ in range(repeats):
            ekf = Ekf(plant, CHANNELS, loop)
            ekf._state[:], ekf._constants[:] = template._state, template._constants
            began = time.perf_counter()
            ekf.update(taken)
            best = min(best, time.perf_counter() - began)
        return 1e6 * best / len(taken)

    compiled = SampleLoop(function)
    us = {compiled.backend: shortest_us(compiled, samples, REPEATS)}
    us["vm"] = shortest_us(SampleLoop(function, compiled=False), samples, REPEATS)
    readable = shortest_us(FilterpyLoop(plant, CHANNELS), np.ascontiguousarray(samples[:RIVAL_SAMPLES]), 2)
    short, _ = bound_recording(PAPER, "multisine", RIVAL_SAMPLES / 1000, 1)
    began = time.perf_counter()
    filterpy_ekf(Task(short, PAPER, {n: getattr(PAPER, n) for n in NAMES}))
    users = 1e6 * (time.perf_counter() - began) / RIVAL_SAMPLES
    print("\nOne filter step, 8 states, 2 measurements, µs (the shortest of several runs)")
    print(f"  filterpy, our plant's exact step {readable:7.1f};  filterpy, a user's own model {users:7.1f}")
    for backend, value in us.items():
        ratios = f"{readable / value:.0f} × and {users / value:.0f} × faster (limit {LIMIT_FILTERPY:g})"
        print(f"  ours, {backend:3} {value:6.2f} (limit {LIMIT_US[backend]:g}): {ratios}")


def _report_drives() -> None:
    """Block after block, drive after drive: the estimators by themselves, and as the daemon has them, with the cutting
    into ticks and a record ten times a second."""
    estimators, pipelines = [], []
    blocks: list[list[SampleBlock]] = []
    for k in range(DRIVES):
        motor = list(MOTORS.values())[k % len(MOTORS)]
        recording = generate(motor, Scenario("pick_and_place", seconds=WARM_S + MEASURED_S, seed=k))
        nominal = {n: 1.4 * float(getattr(motor, n)) for n in NAMES}
        block = make_block(
            recording.time_s,
            voltage_V=recording.voltage_V,
            current_A=recording.current_A,
            position_rad=recording.position_rad,
        )
        blocks.append([block.slice(a, a + BLOCK) for a in range(0, len(block), BLOCK)])
        config, info = DriveConfig(nominal=nominal), info_of(recording)
        estimators.append(make_tracker(block.channels, TrackerSettings(nominal=nominal), resolutions(config, info)))
        pipelines.append(Pipeline(config, info))

    def estimate(k: int, block: SampleBlock) -> None:
        estimators[k].take(block)
        estimators[k].close_tick(block)

    def publish(k: int, block: SampleBlock) -> None:
        pipelines[k].process(block, rows=False)
        pipelines[k].current()

    print(
        f"{DRIVES} drives at 1 kHz, blocks of {BLOCK} samples, the {MEASURED_S:.0f} s after the first {WARM_S:.0f} s:"
    )
    for what, work in (("the estimators", estimate), ("with ticks and a record ten times a second", publish)):
        spent = _spent(blocks, work)
        share, each = spent / MEASURED_S, 1e6 * spent / (DRIVES * 1000 * MEASURED_S)
        print(f"  {what}: {100 * share:.1f} % of a core, {each:.2f} µs a sample")
    print(f"  (limit {100 * LIMIT_DRIVES:.0f} % for the estimators)")


def _spent(blocks: list[list[SampleBlock]], work: Callable[[int, SampleBlock], None]) -> float:
    """Seconds of CPU after the warm-up."""
    spent = 0.0
    for turn in range(len(blocks[0])):
        began = time.process_time()
        for k, of_drive in enumerate(blocks):
            work(k, of_drive[turn])
        if turn * BLOCK >= 1000 * WARM_S:
            spent += time.process_time() - began
    return spent
