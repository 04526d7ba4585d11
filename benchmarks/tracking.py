"""Tracking on data of the independent generator: against the Cramér–Rao bound, and under ageing.

    .venv/bin/python -m benchmarks.tracking [bound] [ageing] [--runs 20] [--seconds 600]

bound   Gaussian sensor and voltage noise, no quantisation, random-walk ageing (5 %/√min in R and B, 2 in K, J and L),
        all variances known to filter and bound: the posterior Cramér–Rao bound (Tichavský, Muravchik & Nehorai, *IEEE
        Trans. Signal Process.* 46, 1998, eq. 21), its expectations taken along each run's own true path: for additive
        Gaussian noise the recursion is then the Riccati equation of the plant linearised at the truth.
ageing  the daemon's own pipeline, laboratory sensors (quantised encoder, unknown noise, jitter), R +40 %, K −15 %,
        B +80 %, J +30 % in five minutes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from drivers.base import DriveInfo
from servo_daemon.config import DriveConfig
from servo_daemon.estimators.base import Gaussian
from servo_daemon.estimators.ekf import Ekf, NoiseLevels
from servo_daemon.estimators.ekf_model import EkfLayout, predict
from servo_daemon.plant.build import build_plant
from servo_daemon.plant.compiled import SampleLoop
from servo_daemon.samples import make_block
from servo_daemon.service.pipeline import Pipeline
from tests.recovery.generator import MOTORS, Motor, Recording, Scenario, Sensors, generate, stream

F64 = np.ndarray
NAMES = ("R", "L", "K", "J", "B")
CHANNELS = ("current_A", "position_rad")
WALK_PER_SQRT_MIN = np.array([0.05, 0.02, 0.02, 0.02, 0.05])
MOTIONS = ("multisine", "prbs", "pick_and_place")
STRIDE = 100  # samples between two looks at the estimate
BURN_IN_S = 20.0
START_STD = 0.1


def random_walk(motor: Motor, n: int, rate_hz: float, seed: int) -> dict[str, F64]:
    """Parameters whose logarithms walk, shape (n,) each."""
    steps = stream(seed, "walk").normal(size=(n, 5)) * WALK_PER_SQRT_MIN / np.sqrt(60 * rate_hz)
    steps[0] = 0.0
    path = np.cumsum(steps, axis=0)
    return {name: getattr(motor, name) * np.exp(path[:, k]) for k, name in enumerate(NAMES)}


def bound_recording(
    motor: Motor, motion: str, seconds: float, seed: int
) -> tuple[Recording, tuple[float, float, float]]:
    """A recording with Gaussian noise of known variances: (input, current, position)."""
    n = round(1000 * seconds)
    sensors = Sensors(current_noise_A=0.003 * motor.rated_current_A, hidden_V=0.002 * motor.supply_V)
    ageing = random_walk(motor, n, 1000.0, seed)
    recording = generate(motor, Scenario(motion, seconds=seconds, ageing=ageing, sensors=sensors, seed=seed))
    std = 2 * np.pi / motor.counts_per_rev / np.sqrt(12)
    noisy = recording.position_rad + stream(seed, "position noise").normal(size=n) * std
    return replace(recording, position_rad=noisy), (sensors.hidden_V**2, sensors.current_noise_A**2, std**2)


def rows(recording: Recording, layout: EkfLayout) -> F64:
    out = np.ones((len(recording.time_s), layout.n_sample))
    out[:, 0] = recording.time_s
    out[:, 1] = np.diff(recording.time_s, prepend=recording.time_s[0])
    out[:, 2], out[:, 3] = recording.voltage_V, 0.0
    out[:, 4], out[:, 7] = recording.current_A, recording.position_rad
    return out


def riccati() -> SampleLoop:
    """Covariance of the plant linearised at given states: state P (column-major), sample x, q, u, t, h."""
    plant = build_plant()
    P, const, sample = ca.SX.sym("P", 64), ca.SX.sym("const", 8), ca.SX.sym("sample", 11)
    x, q, u, t, h = sample[:3], sample[3:8], sample[8], sample[9], ca.fmax(sample[10], 1e-9)
    step = predict(plant, x, q, u, t, h, const[0], ca.SX(0))
    F = ca.SX.eye(8)
    F[:3, :3], F[:3, 3:] = step.by_state, step.by_parameter
    Q = ca.SX.zeros(8, 8)
    Q[:3, :3], Q[3:, 3:] = step.noise, ca.diag(const[3:8]) * h
    C = F @ ca.reshape(P, 8, 8) @ F.T + Q
    for channel, r in ((0, const[1]), (2, const[2])):
        gain = C[:, channel] / (C[channel, channel] + r)
        C = C - gain @ C[channel, :] - C[:, channel] @ gain.T + (C[channel, channel] + r) * gain @ gain.T
    C = (C + C.T) / 2
    return SampleLoop(ca.Function("step", [P, const, sample], [ca.vec(C), ca.diag(C)[3:]]))


def bound_std(recording: Recording, variances: tuple[float, float, float], drift: F64) -> F64:
    """1 σ of each log parameter that no estimator beats, shape (n, 5)."""
    truth = recording.truth
    q = np.log(np.column_stack([truth.parameters[name] for name in NAMES]))
    x = np.column_stack([truth.current_A, truth.speed_rad_s, truth.position_rad])
    n = len(q)
    sample = np.zeros((n, 11))
    sample[1:, :3], sample[1:, 3:8], sample[1:, 8] = x[:-1], q[:-1], recording.voltage_V[:-1]
    sample[0, :3], sample[0, 3:8] = x[0], q[0]
    sample[:, 9], sample[:, 10] = recording.time_s, np.diff(recording.time_s, prepend=recording.time_s[0])
    P = np.diag([1.0, 1.0, 1.0] + [START_STD**2] * 5).T.reshape(-1).copy()
    return np.sqrt(riccati().run(P, np.concatenate([variances, drift]), sample))


def bound_run(arguments: tuple[str, str, float, int]) -> tuple[F64, F64, float]:
    """One run: squared error over squared bound, error rms over bound per parameter; share inside 95 %."""
    name, motion, seconds, seed = arguments
    recording, variances = bound_recording(MOTORS[name], motion, seconds, seed)
    drift = WALK_PER_SQRT_MIN**2 / 60
    bound = bound_std(recording, variances, drift)[STRIDE - 1 :: STRIDE]
    plant = build_plant()
    ekf = Ekf(plant, CHANNELS, drift)
    truth = np.log(np.column_stack([recording.truth.parameters[n] for n in NAMES]))
    start = truth[0] + stream(seed, "start").normal(size=5) * START_STD
    ekf.start(Gaussian(NAMES, start, np.eye(5) * START_STD**2))
    ekf.set_noise(NoiseLevels(variances[0], 0.0, variances[1:]))
    ekf.set_active(np.ones(5), np.ones(5))
    samples = rows(recording, ekf.layout)
    mean, std = np.empty((len(samples) // STRIDE, 5)), np.empty((len(samples) // STRIDE, 5))
    for k in range(len(mean)):
        ekf.update(samples[k * STRIDE : (k + 1) * STRIDE])
        found = ekf.estimate()
        mean[k], std[k] = found.mean, found.std
    error = mean - truth[STRIDE - 1 :: STRIDE][: len(mean)]
    late = np.arange(len(mean)) * STRIDE > 1000 * BURN_IN_S
    rmse = np.sqrt(np.mean(error[late] ** 2, axis=0))
    limit = np.sqrt(np.mean(bound[: len(mean)][late] ** 2, axis=0))
    return rmse, limit, float(np.mean(np.abs(error[late]) < 1.96 * std[late]))


def report_bound(runs: int, seconds: float) -> None:
    print(f"\nCramér–Rao bound: RMSE in % and ratio to the bound, {runs} runs of {seconds:.0f} s at 1 kHz")
    print("motor  motion          " + "".join(f"{n:>15}" for n in NAMES) + "   worst   inside 95 %")
    every: list[F64] = []
    with ProcessPoolExecutor(2) as pool:
        for name in MOTORS:
            for motion in MOTIONS:
                jobs = [(name, motion, seconds, 1000 * k + 7) for k in range(runs)]
                results = list(pool.map(bound_run, jobs))
                ratio = np.array([rmse / limit for rmse, limit, _ in results])
                rmse = np.median([rmse for rmse, _, _ in results], axis=0)
                cells = "".join(
                    f"{100 * e:8.3f} {r:5.2f}×" for e, r in zip(rmse, np.median(ratio, axis=0), strict=True)
                )
                inside = np.mean([i for _, _, i in results])
                print(f"{name:6} {motion:15} {cells} {ratio.max():7.2f} {100 * inside:9.1f} %", flush=True)
                every.append(ratio)
    ratios = np.concatenate(every)
    print(f"median over all {np.median(ratios):.2f} (limit 1.3), worst run {ratios.max():.2f} (limit 2)")


AGEING_LIMIT = {"R": 0.004, "L": 0.03, "K": 0.0012, "J": 0.002, "B": 0.008}
AGEING_END = {"R": 1.40, "L": 1.0, "K": 0.85, "J": 1.30, "B": 1.80}


def ageing_recording(motor: Motor, motion: str, seconds: float, seed: int) -> Recording:
    """Laboratory sensors, parameters that move linearly to their end."""
    n = round(1000 * seconds)
    ageing = {name: getattr(motor, name) * np.linspace(1.0, end, n) for name, end in AGEING_END.items()}
    return generate(motor, Scenario(motion, seconds=seconds, ageing=ageing, seed=seed))


def tracked(recording: Recording, nominal: dict[str, float]) -> tuple[F64, F64, F64, F64]:
    """The daemon's pipeline over a recording: time, value, std and whether it is tracking, shapes (m,) and (m, 5)."""
    counts = float(recording.metadata["counts_per_rev"])
    pipeline = Pipeline(DriveConfig(nominal=nominal), DriveInfo("benchmark", counts_per_rev=counts))
    channels = {c: getattr(recording, c) for c in ("voltage_V", "current_A", "position_rad")}
    estimates = pipeline.process(make_block(recording.time_s, **channels))
    value = np.array([[p.value or np.nan for p in e.parameters] for e in estimates])
    std = np.array([[p.std or np.nan for p in e.parameters] for e in estimates])
    tracking = np.array([[p.status == "tracking" for p in e.parameters] for e in estimates])
    return np.array([e.time_s for e in estimates]), value, std, tracking


def ageing_run(arguments: tuple[str, str, float, int]) -> tuple[F64, F64, F64, F64]:
    """One run: relative RMS error, share inside 95 %, interval's width over the error, share tracking; (5,) each."""
    name, motion, seconds, seed = arguments
    motor = MOTORS[name]
    recording = ageing_recording(motor, motion, seconds, seed)
    time_s, value, std, tracking = tracked(recording, {n: 1.4 * getattr(motor, n) for n in NAMES})
    truth = np.column_stack([np.interp(time_s, recording.truth.time_s, recording.truth.parameters[n]) for n in NAMES])
    late = (time_s > BURN_IN_S)[:, None] & tracking
    error = np.where(late, value / truth - 1, np.nan)
    relative_std = np.where(late, std / truth, np.nan)
    rms = np.sqrt(np.nanmean(error**2, axis=0))
    inside = np.nanmean(np.where(late, np.abs(error) < 1.96 * relative_std, np.nan), axis=0)
    wide = np.sqrt(np.nanmean(relative_std**2, axis=0)) / rms
    return rms, inside, wide, tracking[time_s > BURN_IN_S].mean(axis=0)


def report_ageing(runs: int, seconds: float) -> None:
    seconds = min(seconds, 300.0)
    print(
        f"\nLinear ageing in {seconds:.0f} s (R +40 %, K −15 %, B +80 %, J +30 %), laboratory sensors, {runs} runs each"
    )
    print("RMS error in %, share of truths inside 95 %, std over RMS error, share of the time tracking")
    print("motor  motion           " + "".join(f"{n:>26}" for n in NAMES))
    with ProcessPoolExecutor(2) as pool:
        for name in MOTORS:
            for motion in MOTIONS:
                jobs = [(name, motion, seconds, 1000 * k + 11) for k in range(runs)]
                rms, inside, wide, share = (
                    np.mean(part, axis=0) for part in zip(*pool.map(ageing_run, jobs), strict=True)
                )
                cells = "".join(
                    f"{100 * rms[k]:8.3f} {100 * inside[k]:5.1f}% {wide[k]:4.1f} {100 * share[k]:5.0f}%"
                    for k in range(5)
                )
                print(f"{name:6} {motion:15}  {cells}", flush=True)
    limits = ", ".join(f"{n} {100 * limit:g} %" for n, limit in AGEING_LIMIT.items())
    print(f"limits of the RMS error: {limits}")


def main() -> None:
    parts: dict[str, Callable[[int, float], None]] = {"bound": report_bound, "ageing": report_ageing}
    parser = argparse.ArgumentParser()
    parser.add_argument("parts", nargs="*", choices=list(parts), default=list(parts))
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=600.0)
    arguments = parser.parse_args()
    for part in arguments.parts or parts:
        parts[part](arguments.runs, arguments.seconds)


if __name__ == "__main__":
    main()
