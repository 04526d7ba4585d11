"""The paper's third method measured: learners, targets, intervals, abstention, time and memory; all from one run.

    python benchmarks/learning.py                    # 9,800 motors to learn: 2,000 of these calibrate, 2,000 test
    python benchmarks/learning.py --motors 5000 --times                                     # time and memory only
    python benchmarks/learning.py --motors 1500 --test 600 --classic 40 --generated 60 --faulty 200      # a few minutes

Every learner gets four settings, chosen on the same held-out motors, and is then fitted on all but the calibration
motors. Errors are |log(estimate/truth)|, medians over the test motors whose window has a regression. The learners are
tested on our own simulation ("inverse crime": the same equations made the training) and on motors of the tests'
independent generator, which has other equations' code, another integrator and other motions.
"""

from __future__ import annotations

import argparse
import os
import resource
import sys
import time
import warnings
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import learning_windows as windows_of
from benchmarks.learning_abstention import abstention
from benchmarks.learning_rivals import compare_learners, errors_of, print_errors
from servo_daemon.learning.examples.drawing import CORE, TrainingSpec, draw_parameters
from servo_daemon.learning.examples.training import (
    HEALTHY,
    TARGETS,
    TrainingSet,
    labelled,
    servo_loop,
    simulate_training,
    simulate_window,
    stacked,
)
from servo_daemon.learning.features.features import compute_features
from servo_daemon.learning.model.model import LearnedModel
from servo_daemon.learning.training.fitting import train_model
from servo_daemon.samples import F64
from servo_daemon.simulate import PAPER_MOTOR


def main() -> None:
    arguments = _arguments()
    spec = TrainingSpec(dict(PAPER_MOTOR))
    began, cpu = time.perf_counter(), _cpu_s()
    train = simulate_training(spec, arguments.motors, novel=True)
    simulated = time.perf_counter() - began
    model = train_model(spec, train)
    whole = time.perf_counter() - began
    _workers_done()
    print(
        f"{arguments.motors} motors: simulated in {simulated:.0f} s, trained in {whole - simulated:.0f} s, together "
        f"{whole:.0f} s ({_cpu_s() - cpu:.0f} s of cores), peak {_peak_MB():.0f} MB; goal 180 s, 1500 MB"
    )
    facts = model.facts
    print(
        f"screening keeps {facts['features_kept']} of {facts['features']} features, costs "
        f"{100 * facts['screening_loss']:+.1f} % of the error; goal: half, 2 %\n"
    )
    if arguments.times:
        _times(spec, model)
        return
    test = simulate_training(TrainingSpec(dict(PAPER_MOTOR), seed=1), arguments.test)
    other = _generated(spec, arguments.generated)
    _coverage(model, test, "own simulation")
    _coverage(model, other, "generator")
    abstention(spec, model, test, arguments.faulty)
    _times(spec, model)
    tests = {"own simulation": test, "generator": other}
    compare_learners(spec, model, train.only(train.kind == HEALTHY), tests)
    _classic(spec, model, arguments.classic)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--motors", type=int, default=9800, help="simulated to learn; 2,000 of them calibrate")
    parser.add_argument("--test", type=int, default=2600, help="simulated to test; about 2,000 have a regression")
    parser.add_argument("--generated", type=int, default=300)
    parser.add_argument("--classic", type=int, default=150, help="windows for the filter and output error")
    parser.add_argument("--faulty", type=int, default=1200, help="windows of each fault and of each distance outside")
    parser.add_argument("--times", action="store_true", help="only time and memory")
    return parser.parse_args()


def _workers_done() -> None:
    """What worker processes took is counted when they have ended."""
    from joblib.externals.loky import get_reusable_executor

    get_reusable_executor().shutdown(wait=True)


def _cpu_s() -> float:
    return sum(sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


def _peak_MB() -> float:
    """Of this process and of its workers, each taken for as large as the largest."""
    own, worker = (resource.getrusage(w).ru_maxrss / 1024 for w in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own + (os.cpu_count() or 1) * worker


def _generated(spec: TrainingSpec, count: int) -> TrainingSet:
    found = [labelled(*windows_of.generated(spec, k), k) for k in range(count)]
    return stacked([f for f in found if f is not None])


# -- the other estimators, intervals, times ----------------------------------------------------------


def _classic(spec: TrainingSpec, model: LearnedModel, count: int) -> None:
    fresh = TrainingSpec(dict(spec.nominal), seed=2)
    loop, core = servo_loop(fresh), draw_parameters(fresh, count)
    rows: dict[str, list[F64]] = {"RF + GRNN": [], "EKF": [], "output error": []}
    truth = []
    for k in range(count):
        block, true = simulate_window(fresh, k, core[k], loop)
        found = labelled(block, true, k)
        if found is None:
            continue
        p = model.predict(found.features)
        if not p.accepted[0]:
            continue
        rows["RF + GRNN"].append(p.value[0, :5])
        rows["EKF"].append(windows_of.ekf(block, spec.nominal))
        rows["output error"].append(windows_of.output_error(block, spec.nominal))
        truth.append(windows_of.truth_row(true))
    print(f"median error, %, on the {len(truth)} of {count} further windows that the model accepts")
    for title, values in rows.items():
        value = np.array(values)
        print_errors(f"{title} ({int(np.isfinite(value).all(axis=1).sum())})", {"": errors_of(value, np.array(truth))})
    print()


def _coverage(model: LearnedModel, test: TrainingSet, where: str) -> None:
    p = model.predict(test.features)
    ok = p.accepted
    inside = ((p.low <= test.truth) & (test.truth <= p.high))[ok].mean(axis=0)
    width = np.median((np.log(p.high / np.maximum(p.low, 1e-300)) / 2)[ok][:, :5], axis=0)
    cells = ", ".join(f"{n} {100 * c:.1f} %" for n, c in zip(TARGETS, inside, strict=True))
    half = ", ".join(f"{n} {100 * w:.1f} %" for n, w in zip(CORE, width, strict=True))
    print(f"95 % intervals, {where}, {int(ok.sum())} accepted of {len(ok)} motors: hold {cells}; half widths {half}")


def _times(spec: TrainingSpec, model: LearnedModel) -> None:
    long = TrainingSpec(dict(spec.nominal), window_s=10.0)
    block, _ = simulate_window(long, 1, np.array([spec.nominal[n] for n in CORE]), servo_loop(long))
    features = compute_features(block)
    for name, work, goal in (
        ("features of 10 s at 1 kHz", lambda: compute_features(block), 10.0),
        ("prediction", lambda: model.predict(features[None]), 2.0),
    ):
        took = []
        for _ in range(30):
            began = time.perf_counter()
            work()
            took.append(1e3 * (time.perf_counter() - began))
        print(f"{name}: best {min(took):.2f} ms, median {np.median(took):.2f} ms; goal {goal:g} ms")


if __name__ == "__main__":
    warnings.filterwarnings("ignore", category=RuntimeWarning)
    main()
