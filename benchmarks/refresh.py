"""What the refresh by RF and GRNN is worth to the filter: the daemon's own pipeline with and without it, on recordings
of the independent generator.

    python benchmarks/refresh.py                  # 40 s a run
    python benchmarks/refresh.py --motors 800     # with the model that `compare` would train

Per case: seconds until all of R, L, K, J, B are within 3 % of the truth and stay there, after the start or after the
step; RMS error of all five over the last third, in %; how many refreshes entered the filter, how many were declined.
"model": what the learned model by itself would reach on the same run, its word taken for each window as it comes.
"bound": what could be made of the model's windows by whoever knew the truth: of all estimates so far whose windows
began after the event, weighted for each parameter in the best way there is. Whatever enters, when, and with what
covariance: an estimate that is made of these windows comes no sooner within 3 %, and no closer.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from servo_daemon.config import DriveConfig, EstimationConfig
from servo_daemon.learning.examples.drawing import CORE, TrainingSpec
from servo_daemon.learning.model.cache import obtain_model
from servo_daemon.learning.model.model import LearnedModel
from servo_daemon.learning.training.run import Job, train
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.pipeline.publish import SavedState
from servo_daemon.samples import F64, SampleBlock, make_block
from servo_daemon.simulate import PAPER_MOTOR
from tests.recovery.generator import PAPER, Recording, Scenario, generate

_WITHIN = 0.03
_STEP_S = 20.0
_EVERY_S, _WINDOW_S = 5.0, 5.0


@dataclass(frozen=True)
class Case:
    """A run: the recording's scenario, what the daemon is told, when something happens (0: at the start)."""

    scenario: Scenario
    nominal: Mapping[str, float]
    saved: bool = False
    event_s: float = 0.0


def _wrong(factor: float) -> dict[str, float]:
    """Nominal values wrong by a factor, up and down in turn."""
    return {n: v * factor ** (1 if k % 2 else -1) for k, (n, v) in enumerate(PAPER_MOTOR.items())}


def _cases(seconds: float) -> dict[str, Case]:
    n = round(1000 * seconds)
    late = np.arange(n) >= 1000 * _STEP_S
    out: dict[str, Case] = {}
    friction = {"coulomb_friction": {"Tc": 0.08 * PAPER.working_torque_Nm}}
    brushes = {"brush_voltage_drop": {"Vb": 0.02 * PAPER.supply_V}}
    for motion in ("multisine", "pick_and_place", "reversals"):
        plain = Scenario(motion, seconds, seed=3)
        out[f"{motion}: nominal values 3 x wrong"] = Case(plain, _wrong(3.0))
        out[f"{motion}: saved state 3 x wrong"] = Case(plain, _wrong(3.0), saved=True)
        out[f"{motion}: no nominal values"] = Case(plain, {})
        for name in ("R", "J"):
            values = np.where(late, 1.3, 1.0) * PAPER_MOTOR[name]
            out[f"{motion}: step of {name}"] = Case(replace(plain, ageing={name: values}), PAPER_MOTOR, event_s=_STEP_S)
        load = np.where(late, 0.3 * PAPER.working_torque_Nm, 0.0)
        out[f"{motion}: load step"] = Case(replace(plain, ageing={"TL": load}), PAPER_MOTOR, event_s=_STEP_S)
        out[f"{motion}: friction that the model lacks"] = Case(replace(plain, effects=friction), _wrong(1.3))
        out[f"{motion}: brush drop that the model lacks"] = Case(replace(plain, effects=brushes), _wrong(1.3))
    return out


def _block(r: Recording) -> SampleBlock:
    return make_block(r.time_s, voltage_V=r.voltage_V, current_A=r.current_A, position_rad=r.position_rad)


@dataclass(frozen=True)
class Run:
    """What the daemon's pipeline said at every tick.

    Attributes:
        time_s: shape (m,).
        published, learned: relative errors, shape (m, 5), of what is published and of the learned model by itself, its
            last window's estimate held; NaN: nothing there.
        bound: shape (m, 5), the least that any weighted mean of the model's windows is off; NaN: there is none yet.
        entered, declined: how many windows.
    """

    time_s: F64
    published: F64
    learned: F64
    bound: F64
    entered: int = 0
    declined: int = 0


def run(case: Case, recording: Recording, model: LearnedModel | None) -> Run:
    """The daemon's own pipeline over a recording."""
    saved = None
    if case.saved:
        mean = tuple(float(np.log(case.nominal[n])) for n in CORE)
        saved = SavedState((), CORE, mean, tuple(tuple(row) for row in np.diag(np.full(5, 0.03**2)).tolist()))
    estimation = EstimationConfig(refresh_every_s=_EVERY_S, refresh_window_s=_WINDOW_S)
    pipeline = Pipeline(DriveConfig(nominal=dict(case.nominal), estimation=estimation), None, saved)
    pipeline.use_learned(model)
    block, times, rows, own, ends = _block(recording), [], [], [], []
    said = dict.fromkeys(CORE, np.nan)
    entered = declined = 0
    for e in pipeline.process(block):
        published = {p.name: p.value for p in e.parameters}
        rows.append([np.nan if published[n] is None else published[n] for n in CORE])
        grnn = e.estimators.get("grnn")
        if grnn is not None:
            entered, declined = int(grnn.detail["applied"] or 0), int(grnn.detail["windows_declined"] or 0)
            said |= {n: value for n, (value, _) in grnn.parameters.items() if value is not None}
        ends.append(np.nan if grnn is None or not grnn.parameters else float(grnn.detail["window_end_s"] or np.nan))
        own.append([said[n] for n in CORE])
        times.append(e.time_s)
    time = np.array(times)
    at = np.searchsorted(recording.truth.time_s, time).clip(max=len(block) - 1)
    truth = np.column_stack([recording.truth.parameters[n][at] for n in CORE])
    learned = np.array(own) / truth - 1.0
    bound = _bound(learned, np.array(ends), case.event_s + (_WINDOW_S if case.event_s else 0.0))
    return Run(time, np.array(rows, dtype=np.float64) / truth - 1.0, learned, bound, entered, declined)


def _bound(learned: F64, ends: F64, first_end_s: float) -> F64:
    """The least errors of weighted means, shape (m, 5).

    Args:
        learned: errors of the model's windows as they came, shape (m, 5).
        ends: when the window ended that is told at each tick, shape (m,); NaN: none is.
        first_end_s: windows count that end no sooner.
    """
    counts = (ends >= first_end_s)[:, None]
    lowest = np.minimum.accumulate(np.where(counts, learned, np.inf))
    highest = np.maximum.accumulate(np.where(counts, learned, -np.inf))
    least = np.where((lowest < 0.0) & (highest > 0.0), 0.0, np.minimum(np.abs(lowest), np.abs(highest)))
    return np.where(np.isfinite(lowest), least, np.nan)


def _score(errors: F64, time: F64, event_s: float) -> tuple[float, float]:
    """Seconds from the event until all are within 3 % for good (inf: never), and the RMS error of the last third, %."""
    bad = ~(np.abs(errors) < _WITHIN).all(axis=1) & (time > event_s)
    last = np.flatnonzero(bad)
    back = 0.0 if not len(last) else (np.inf if last[-1] == len(time) - 1 else time[last[-1] + 1] - event_s)
    end = errors[time > time[-1] * 2 / 3]
    return float(back), 100 * float(np.sqrt(np.mean(np.square(end)))) if np.isfinite(end).all() else float(np.nan)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--motors", type=int, default=5000)
    parser.add_argument("--seconds", type=float, default=40.0)
    parser.add_argument("--only", default="", help="cases whose name contains this")
    arguments = parser.parse_args()
    spec = TrainingSpec(dict(PAPER_MOTOR))
    make: Callable[[], LearnedModel] = lambda: train(spec, Job(arguments.motors))  # noqa: E731
    model, _ = obtain_model(spec, arguments.motors, make)
    columns = "without   with  model  bound"
    print(f"{'':50s}  within 3 %, s: {columns} |  RMS, %: {columns} | entered, declined")
    for name, case in _cases(arguments.seconds).items():
        if arguments.only not in name:
            continue
        recording = generate(PAPER, case.scenario)
        without, refreshed = run(case, recording, None), run(case, recording, model)
        tried = (without.published, refreshed.published, refreshed.learned, refreshed.bound)
        scores = [_score(errors, without.time_s, case.event_s) for errors in tried]
        back = " ".join(f"{s:6.1f}" for s, _ in scores)
        rms = " ".join(f"{r:6.2f}" for _, r in scores)
        print(
            f"{name:50s}                 {back} |          {rms} | {refreshed.entered:3d} {refreshed.declined:3d}",
            flush=True,
        )


if __name__ == "__main__":
    main()
