"""What the refresh by RF and GRNN is worth to the filter: the daemon's own pipeline with and without it, on recordings
of the independent generator.

    python benchmarks/refresh.py                  # 40 s a run
    python benchmarks/refresh.py --motors 800     # with the model that `compare` would train

Per case: seconds until all of R, L, K, J, B are within 3 % of the truth and stay there, after the start or after the
step; RMS error of all five over the last third, in %; how many refreshes entered the filter, how many were declined.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from servo_daemon.config import DriveConfig
from servo_daemon.learning.cache import obtain_model
from servo_daemon.learning.drawing import CORE, TrainingSpec
from servo_daemon.learning.model import LearnedModel
from servo_daemon.learning.refresh import Refresh, enter
from servo_daemon.learning.run import Job, train
from servo_daemon.samples import F64, SampleBlock, make_block
from servo_daemon.service.pipeline import Pipeline
from servo_daemon.service.publish import SavedState
from servo_daemon.simulate import PAPER_MOTOR
from tests.recovery.generator import PAPER, Recording, Scenario, generate

_WITHIN = 0.03
_STEP_S = 20.0


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
        out[f"{motion}: friction that the model lacks"] = Case(replace(plain, effects=friction), PAPER_MOTOR)
        out[f"{motion}: brush drop that the model lacks"] = Case(replace(plain, effects=brushes), PAPER_MOTOR)
    return out


def _block(r: Recording) -> SampleBlock:
    return make_block(r.time_s, voltage_V=r.voltage_V, current_A=r.current_A, position_rad=r.position_rad)


def run(case: Case, recording: Recording, model: LearnedModel | None) -> tuple[F64, F64, int, int]:
    """Relative errors at every tick, shape (m, 5) (NaN: nothing published), times (m,), refreshes entered, declined."""
    saved = None
    if case.saved:
        mean = tuple(float(np.log(case.nominal[n])) for n in CORE)
        saved = SavedState((), CORE, mean, tuple(tuple(row) for row in np.diag(np.full(5, 0.03**2)).tolist()))
    pipeline = Pipeline(DriveConfig(nominal=dict(case.nominal)), None, saved)
    refresh = None if model is None else Refresh(model, every_s=5.0)
    block, rows, times, entered, declined = _block(recording), [], [], 0, 0
    for k in range(0, len(block), 100):
        piece = block.slice(k, k + 100)
        for e in pipeline.process(piece):
            value = {p.name: p.value for p in e.parameters}
            rows.append([np.nan if value[n] is None else value[n] for n in CORE])
            times.append(e.time_s)
        tracker = pipeline._tracker
        if refresh is None or tracker is None:
            continue
        found = refresh.update(piece, tracker.published())
        declined += found is not None and bool(found.declined)
        if found is not None and found.pseudo is not None and tracker.ekf is not None:
            enter(tracker.ekf, found.pseudo)
            entered += 1
    time = np.array(times)
    at = np.searchsorted(recording.truth.time_s, time).clip(max=len(block) - 1)
    truth = np.column_stack([recording.truth.parameters[n][at] for n in CORE])
    return np.array(rows, dtype=np.float64) / truth - 1.0, time, entered, declined


def _score(errors: F64, time: F64, event_s: float) -> tuple[float, float]:
    """Seconds from the event until all are within 3 % for good (inf: never), and the RMS error of the last third, %."""
    bad = ~(np.abs(errors) < _WITHIN).all(axis=1) & (time > event_s)
    last = np.flatnonzero(bad)
    back = 0.0 if not len(last) else (np.inf if last[-1] == len(time) - 1 else time[last[-1] + 1] - event_s)
    end = errors[time > time[-1] * 2 / 3]
    return float(back), 100 * float(np.sqrt(np.nanmean(np.square(end))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--motors", type=int, default=5000)
    parser.add_argument("--seconds", type=float, default=40.0)
    parser.add_argument("--only", default="", help="cases whose name contains this")
    arguments = parser.parse_args()
    spec = TrainingSpec(dict(PAPER_MOTOR))
    make: Callable[[], LearnedModel] = lambda: train(spec, Job(arguments.motors))  # noqa: E731
    model, _ = obtain_model(spec, arguments.motors, make)
    print(f"{'case':52s}  back within 3 %, s: without, with | RMS, %: without, with | entered, declined")
    for name, case in _cases(arguments.seconds).items():
        if arguments.only not in name:
            continue
        recording = generate(PAPER, case.scenario)
        without, time, _, _ = run(case, recording, None)
        refreshed, _, entered, declined = run(case, recording, model)
        a, b = _score(without, time, case.event_s), _score(refreshed, time, case.event_s)
        print(f"{name:52s}  {a[0]:8.1f} {b[0]:8.1f} | {a[1]:7.2f} {b[1]:7.2f} | {entered:3d} {declined:3d}", flush=True)


if __name__ == "__main__":
    main()
