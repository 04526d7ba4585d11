"""`bound` and `realistic`: random-walk ageing against the Cramér–Rao bound.

bound      Gaussian sensor and voltage noise, no quantisation, random-walk ageing (5 %/√min in R and B, 2 in K, J and
           L), all variances known to filter and bound. The filter alone; `tracking` is what the daemon's own rules of
           excitation and qualification would say of it.
realistic  the same walk with a quantised encoder, converters, jitter, and noise that nobody told: the daemon's own
           pipeline, with its default settings and with the drift told. The bound is that of the ideal sensors (the
           quantisation as white noise of a count over √12) on the same path.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import numpy as np

from servo_daemon.kalman.ekf import Ekf
from servo_daemon.kalman.gaussian import Gaussian
from servo_daemon.kalman.layout import EkfLayout
from servo_daemon.kalman.records import NoiseLevels
from servo_daemon.parameters import LINEAR
from servo_daemon.plant.build import build_plant
from servo_daemon.samples import F64
from servo_daemon.tracking.plan.parameter_masks import ParameterMasks
from servo_daemon.tracking.validity.excitation import Excitation
from servo_daemon.tracking.validity.gates import Evidence, Qualification
from tests.recovery.generator import MOTORS, Motor, Recording, Scenario, Sensors, generate, stream
from tests.recovery.tracking.cramer_rao import START_STD, bound_std
from tests.recovery.tracking.follow import BURN_IN_S, MOTIONS, NAMES, Z95, Flags, nominal_of, sampled, tracked
from tests.recovery.tracking.score import Score, mean, score

WALK_PER_SQRT_MIN = np.array([0.05, 0.02, 0.02, 0.02, 0.05])
WALK_TOLD = {n: f"{100 * w:g} %/sqrt(min)" for n, w in zip(NAMES, WALK_PER_SQRT_MIN, strict=True)}
CHANNELS = ("current_A", "position_rad")
STRIDE = 100  # samples between two looks at the estimate: a tick
RATE_HZ = 1000.0


def random_walk(motor: Motor, n: int, seed: int) -> dict[str, F64]:
    """Parameters whose logarithms walk, shape (n,) each."""
    steps = stream(seed, "walk").normal(size=(n, 5)) * WALK_PER_SQRT_MIN / np.sqrt(60 * RATE_HZ)
    steps[0] = 0.0
    path = np.cumsum(steps, axis=0)
    return {name: getattr(motor, name) * np.exp(path[:, k]) for k, name in enumerate(NAMES)}


def ideal_sensors(motor: Motor) -> tuple[Sensors, tuple[float, float, float]]:
    """Gaussian noise only, and the variances of applied voltage, current and position (to be added)."""
    sensors = Sensors(current_noise_A=0.003 * motor.rated_current_A, hidden_V=0.002 * motor.supply_V)
    position_std = 2 * np.pi / motor.counts_per_rev / np.sqrt(12)
    return sensors, (sensors.hidden_V**2, sensors.current_noise_A**2, position_std**2)


def bound_recording(
    motor: Motor, motion: str, seconds: float, seed: int
) -> tuple[Recording, tuple[float, float, float]]:
    """A recording with Gaussian noise of known variances: (input, current, position)."""
    n = round(RATE_HZ * seconds)
    sensors, variances = ideal_sensors(motor)
    ageing = random_walk(motor, n, seed)
    recording = generate(motor, Scenario(motion, seconds=seconds, ageing=ageing, sensors=sensors, seed=seed))
    noise = stream(seed, "position noise").normal(size=n) * np.sqrt(variances[2])
    return replace(recording, position_rad=recording.position_rad + noise), variances


def rows(recording: Recording, layout: EkfLayout) -> F64:
    """The recording as the filter takes it, shape (n, layout.n_sample)."""
    out = np.ones((len(recording.time_s), layout.n_sample))
    out[:, 0] = recording.time_s
    out[:, 1] = np.diff(recording.time_s, prepend=recording.time_s[0])
    out[:, 2], out[:, 3], out[:, -1] = recording.voltage_V, 0.0, 0.0
    out[:, 4], out[:, 7] = recording.current_A, recording.position_rad
    return out


def known_noise_filter(truth: F64, variances: tuple[float, float, float], drift: F64, seed: int) -> Ekf:
    """The filter with all variances told, started 10 % (1 σ) beside the truth, shape (5,) of logarithms."""
    ekf = Ekf(build_plant(), CHANNELS)
    start = truth + stream(seed, "start").normal(size=5) * START_STD
    ekf.start(Gaussian(NAMES, start, np.eye(5) * START_STD**2))
    ekf.set_noise(NoiseLevels(variances[0], 0.0, variances[1:]))
    ekf.set_active(np.ones(5), drift)
    return ekf


def filtered(ekf: Ekf, samples: F64) -> tuple[F64, F64, Flags]:
    """Mean and std of the logarithms at each tick, and whether the daemon would call them tracking; (m, 5) each."""
    m = len(samples) // STRIDE
    mean_, std, tracking = np.empty((m, 5)), np.empty((m, 5)), np.zeros((m, 5), dtype=bool)
    excitation, qualification = Excitation(5), Qualification(5)
    all_ = np.ones(5, dtype=bool)
    masks = ParameterMasks(LINEAR, all_, ~all_, all_, all_, all_, np.zeros(5))
    for k in range(m):
        ekf.update(samples[k * STRIDE : (k + 1) * STRIDE])
        found = ekf.estimate()
        mean_[k], std[k] = found.mean, found.std
        excitation.update(ekf.take_information(), STRIDE / RATE_HZ)
        qualification.update(Evidence(masks, found.std, excitation.excited, all_))
        tracking[k] = qualification.qualified & excitation.excited
    return mean_, std, tracking


def bound_run(arguments: tuple[str, str, float, int]) -> tuple[F64, F64, float, F64]:
    """One run: RMS error and bound of the logarithms (5,), share inside 95 %, share of the time tracking (5,)."""
    name, motion, seconds, seed = arguments
    recording, variances = bound_recording(MOTORS[name], motion, seconds, seed)
    drift = WALK_PER_SQRT_MIN**2 / 60
    bound = bound_std(recording, variances, drift)[STRIDE - 1 :: STRIDE]
    truth = np.log(np.column_stack([recording.truth.parameters[n] for n in NAMES]))
    ekf = known_noise_filter(truth[0], variances, drift, seed)
    found, std, tracking = filtered(ekf, rows(recording, ekf.layout))
    error = found - truth[STRIDE - 1 :: STRIDE]
    late = np.arange(len(found)) * STRIDE > RATE_HZ * BURN_IN_S
    rmse = np.sqrt(np.mean(error[late] ** 2, axis=0))
    limit = np.sqrt(np.mean(bound[late] ** 2, axis=0))
    inside = float(np.mean(np.abs(error[late]) < Z95 * std[late]))
    return rmse, limit, inside, tracking[late].mean(axis=0)


def realistic_run(arguments: tuple[str, str, float, int]) -> tuple[F64, Score, Score]:
    """One run: the bound (5,), and the scores with default settings and with the drift told."""
    name, motion, seconds, seed = arguments
    motor = MOTORS[name]
    ideal, variances = ideal_sensors(motor)
    sensors = replace(Sensors.laboratory(motor), hidden_V=ideal.hidden_V)
    ageing = random_walk(motor, round(RATE_HZ * seconds), seed)
    recording = generate(motor, Scenario(motion, seconds=seconds, ageing=ageing, sensors=sensors, seed=seed))
    bound = bound_std(recording, variances, WALK_PER_SQRT_MIN**2 / 60)[round(RATE_HZ * BURN_IN_S) :]
    scores = []
    for drift in ({}, WALK_TOLD):
        track = tracked(recording, nominal_of(motor), drift=drift)
        late = track.time_s > BURN_IN_S
        truth = sampled(recording.truth.parameters, recording.truth.time_s, NAMES, track.time_s)
        scores.append(score(track.value[late], track.std[late], truth[late], track.tracking[late]))
    return np.sqrt(np.mean(bound**2, axis=0)), scores[0], scores[1]


def report_bound(runs: int, seconds: float) -> None:
    """Prints the table; limits: 1.3 in the median, 2 in the worst run, 92–98 % inside."""
    print(f"\nCramér–Rao bound: RMSE in % and ratio to the bound, {runs} runs of {seconds:.0f} s at 1 kHz")
    print(f"{'motor  motion':23}" + "".join(f"{n:>15}" for n in NAMES) + "   worst  inside 95 %  tracking (least)")
    every: list[F64] = []
    with ProcessPoolExecutor(2) as pool:
        for name in MOTORS:
            for motion in MOTIONS:
                results = list(pool.map(bound_run, [(name, motion, seconds, 1000 * k + 7) for k in range(runs)]))
                ratio = np.array([rmse / limit for rmse, limit, _, _ in results])
                rmse = np.median([r[0] for r in results], axis=0)
                pairs = zip(rmse, np.median(ratio, axis=0), strict=True)
                cells = "".join(f"{100 * e:8.3f} {r:5.2f}×" for e, r in pairs)
                inside, share = np.mean([r[2] for r in results]), np.mean([r[3] for r in results], axis=0)
                last = f"{ratio.max():7.2f} {100 * inside:9.1f} % {100 * share.min():9.0f} %"
                print(f"{name:6} {motion:15} {cells} {last} {NAMES[int(share.argmin())]}", flush=True)
                every.append(ratio)
    ratios = np.concatenate(every)
    print(f"median over all {np.median(ratios):.2f} (limit 1.3), worst run {ratios.max():.2f} (limit 2)")


def report_realistic(runs: int, seconds: float) -> None:
    """Prints two lines for each motor and motion."""
    print(f"\nThe same walk, laboratory sensors, unknown noise, jitter: {runs} runs of {seconds:.0f} s, the pipeline")
    print("RMS error in % while tracking, ratio to the ideal scenario's bound, inside 95 %, share of the time tracking")
    print(f"{'motor  motion          drift':31}" + "".join(f"{n:>27}" for n in NAMES))
    with ProcessPoolExecutor(2) as pool:
        for name in MOTORS:
            for motion in MOTIONS:
                results = list(pool.map(realistic_run, [(name, motion, seconds, 1000 * k + 7) for k in range(runs)]))
                for k, told in ((1, "default"), (2, "told")):
                    print(f"{name:6} {motion:15} {told:8} {_cells(results, k)}", flush=True)


def _cells(results: list[tuple[F64, Score, Score]], k: int) -> str:
    scores = [(r[0], r[1] if k == 1 else r[2]) for r in results]
    rms = mean(np.array([s.rms for _, s in scores]))
    ratio = mean(np.array([s.rms / limit for limit, s in scores]))
    inside, share = (mean(np.array([getattr(s, name) for _, s in scores])) for name in ("inside", "share"))
    return "".join(
        f"{100 * rms[p]:8.3f} {ratio[p]:6.2f}×{100 * inside[p]:4.0f} %{100 * share[p]:4.0f} %" for p in range(5)
    )
