"""The paper's third method measured: learners, targets, intervals, abstention, time and memory; all from one run.

    python benchmarks/learning.py                    # 5,000 motors to learn, 2,000 to calibrate of them, 2,000 to test
    python benchmarks/learning.py --motors 1500 --test 600 --classic 40 --generated 60      # a few minutes

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
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import learning_windows as windows_of
from servo_daemon.learning.drawing import CORE, TrainingSpec, draw_parameters
from servo_daemon.learning.features import compute_features
from servo_daemon.learning.grnn import GRNN
from servo_daemon.learning.model import LearnedModel, roles, train_model
from servo_daemon.learning.preparation import Preparation
from servo_daemon.learning.screening import forest
from servo_daemon.learning.targets import Target, baseline, bounded, decode, encode
from servo_daemon.learning.training import (
    TARGETS,
    TrainingSet,
    labelled,
    servo_loop,
    simulate_training,
    simulate_window,
)
from servo_daemon.samples import F64
from servo_daemon.simulate import PAPER_MOTOR

Fit = Callable[[F64, F64], Callable[[F64], F64]]


def main() -> None:
    arguments = _arguments()
    spec = TrainingSpec(dict(PAPER_MOTOR))
    began, cpu = time.perf_counter(), _cpu_s()
    train = simulate_training(spec, arguments.motors, jobs=arguments.jobs)
    simulated = time.perf_counter() - began
    model = train_model(spec, train, jobs=arguments.jobs)
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
    test = simulate_training(TrainingSpec(dict(PAPER_MOTOR), seed=1), arguments.test, jobs=arguments.jobs)
    other = _generated(spec, arguments.generated)
    _learners(spec, model, train, {"own simulation": test, "generator": other})
    _classic(spec, model, arguments.classic)
    _coverage(model, test, "own simulation")
    _coverage(model, other, "generator")
    _abstention(spec, model, test, arguments.classic)
    _times(spec, model)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--motors", type=int, default=8000, help="simulated to learn; a quarter of them calibrates")
    parser.add_argument("--test", type=int, default=2600, help="simulated to test; about 2,000 have a regression")
    parser.add_argument("--generated", type=int, default=300)
    parser.add_argument("--classic", type=int, default=150, help="windows for the filter and output error, per fault")
    parser.add_argument("--jobs", type=int, default=-1)
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
    kept = [f for f in found if f is not None]
    columns: list[Any] = [[getattr(f, name) for f in kept] for name in ("features", "truth", "motor")]
    return TrainingSet(*(np.concatenate(c) for c in columns))


# -- learners ----------------------------------------------------------------------------------------------------


def _estimator(make: Callable[[], Any]) -> Fit:
    return lambda X, y: make().fit(X, y).predict


def _grnn_settings(X: F64, y: F64) -> list[Fit]:
    """Bandwidths are fitted once; then as they are and wider, with all windows and with prototypes."""
    h = GRNN(max_windows=1500, max_iter=40, random_state=0).fit(X, y).bandwidth_
    settings = ((1.0, None), (1.0, 1000), (1.3, None), (0.8, None))
    return [
        _estimator(lambda s=s, n=n: GRNN(bandwidth=s * h, n_prototypes=n, random_state=0))  # type: ignore[misc]
        for s, n in settings
    ]


def _settings(name: str, X: F64, y: F64, jobs: int) -> list[Fit]:
    from sklearn.ensemble import HistGradientBoostingRegressor
    from sklearn.linear_model import Ridge
    from sklearn.multioutput import MultiOutputRegressor
    from sklearn.neighbors import KNeighborsRegressor

    if name == "grnn":
        return _grnn_settings(X, y)
    if name == "forest":
        return [_estimator(lambda k=k: forest(100, jobs, 0).set_params(min_samples_leaf=k)) for k in (1, 3, 8, 20)]  # type: ignore[misc]
    if name == "neighbours":
        return [_estimator(lambda k=k: KNeighborsRegressor(k, weights="distance")) for k in (4, 8, 16, 32)]  # type: ignore[misc]
    if name == "ridge":
        return [_estimator(lambda a=a: Ridge(a)) for a in (1.0, 10.0, 100.0, 1000.0)]  # type: ignore[misc]
    pairs = ((0.05, 15), (0.05, 31), (0.1, 15), (0.1, 31))
    return [
        _estimator(
            lambda r=r, n=n: MultiOutputRegressor(  # type: ignore[misc]
                HistGradientBoostingRegressor(loss="absolute_error", learning_rate=r, max_leaf_nodes=n, random_state=0)
            )
        )
        for r, n in pairs
    ]


def _learners(spec: TrainingSpec, model: LearnedModel, train: TrainingSet, tests: Mapping[str, TrainingSet]) -> None:
    base = baseline(train.features, spec.nominal, spec.spread)
    train = train.only(base.known)
    role = roles(train.motor, spec.seed)
    fit, held = role != "calibrate", role[role != "calibrate"] == "screen"
    train = train.only(fit)
    prepared = Preparation().fit(train.features)
    known = {k: t.only(baseline(t.features, spec.nominal, spec.spread).known) for k, t in tests.items()}
    print(_heading("median error, %, of R, L, K, J, B and of all", known))
    _print_errors("regression (RLS)", {k: _errors_of(t.features[:, :5], t.truth) for k, t in known.items()})
    drop = {k: np.exp(baseline(t.features, spec.nominal, spec.spread).centre[:, :5]) for k, t in known.items()}
    _print_errors("regression with brush drop", {k: _errors_of(drop[k], t.truth) for k, t in known.items()})
    everything, kept = np.arange(len(prepared.used_)), model.kept
    rows: Sequence[tuple[str, str, Target, Any]] = (
        ("RF + GRNN, log(P/P_regression)", "grnn", "correction", kept),
        ("RF + GRNN, log P (the paper's)", "grnn", "value", kept),
        ("RF alone", "forest", "correction", everything),
        ("GRNN without screening", "grnn", "correction", everything),
        ("k-nearest neighbours", "neighbours", "correction", kept),
        ("ridge", "ridge", "correction", kept),
        ("gradient boosting", "boosting", "correction", kept),
        ("gradient boosting, log P", "boosting", "value", kept),
    )
    for title, name, target, columns in rows:
        began = time.perf_counter()
        predictor = _tuned(spec, name, target, train, prepared, columns, held)
        found = {}
        for key, t in known.items():
            b = baseline(t.features, spec.nominal, spec.spread)
            y = predictor(prepared.transform(t.features)[:, columns])
            found[key] = _errors_of(np.exp(decode(target, y, b, spec.nominal)[:, :5]), t.truth)
        _print_errors(title, found, time.perf_counter() - began)
    print()


def _tuned(
    spec: TrainingSpec, name: str, target: Target, train: TrainingSet, prepared: Preparation, columns: Any, held: Any
) -> Callable[[F64], F64]:
    """The best of four settings on the held-out motors, fitted on all."""
    b = baseline(train.features, spec.nominal, spec.spread)
    y = bounded(target, encode(target, train.truth, b, spec.nominal))
    X = prepared.transform(train.features)[:, columns]
    settings = _settings(name, X[~held], y[~held], -1)
    errors = [float(np.median(np.abs(s(X[~held], y[~held])(X[held]) - y[held]))) for s in settings]
    return settings[int(np.argmin(errors))](X, y)


def _errors_of(value: F64, truth: F64) -> F64:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.abs(np.log(value / truth[:, :5]))


def _heading(text: str, tests: Mapping[str, TrainingSet]) -> str:
    return text + "".join(f" | {name}, {len(t)} windows" for name, t in tests.items())


def _print_errors(title: str, errors: Mapping[str, F64], seconds: float | None = None) -> None:
    cells = []
    for e in errors.values():
        each = " ".join(f"{100 * v:5.2f}" for v in np.nanmedian(e, axis=0))
        cells.append(f"{each}  {100 * np.nanmedian(e):5.2f}")
    took = "" if seconds is None else f" | {seconds:.0f} s"
    print(f"  {title:32s} | {' | '.join(cells)}{took}", flush=True)


# -- the other estimators, intervals, abstention, times ----------------------------------------------------------


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
        _print_errors(
            f"{title} ({int(np.isfinite(value).all(axis=1).sum())})", {"": _errors_of(value, np.array(truth))}
        )
    print()


def _coverage(model: LearnedModel, test: TrainingSet, where: str) -> None:
    p = model.predict(test.features)
    ok = p.accepted
    inside = ((p.low <= test.truth) & (test.truth <= p.high))[ok].mean(axis=0)
    width = np.median((np.log(p.high / np.maximum(p.low, 1e-300)) / 2)[ok][:, :5], axis=0)
    cells = ", ".join(f"{n} {100 * c:.1f} %" for n, c in zip(TARGETS, inside, strict=True))
    half = ", ".join(f"{n} {100 * w:.1f} %" for n, w in zip(CORE, width, strict=True))
    print(f"95 % intervals, {where}, {int(ok.sum())} accepted of {len(ok)} motors: hold {cells}; half widths {half}")


def _abstention(spec: TrainingSpec, model: LearnedModel, test: TrainingSet, count: int) -> None:
    regression = baseline(test.features, spec.nominal, spec.spread).known
    ok = model.predict(test.features).accepted
    print(f"\naccepted of familiar motors: {100 * ok[regression].mean():.1f} % of windows with a regression; goal 95 %")
    rng, loop = np.random.default_rng(5), servo_loop(spec)
    core = draw_parameters(TrainingSpec(dict(spec.nominal), seed=6), count)
    for low, high in ((1.0, 1.5), (1.5, 2.0), (2.0, 4.0)):
        declined = []
        for k in range(count):
            row, which = core[k].copy(), int(rng.integers(5))
            beyond = spec.spread * low * (high / low) ** rng.random()
            row[which] = spec.nominal[CORE[which]] * beyond ** rng.choice((-1.0, 1.0))
            found = labelled(*simulate_window(spec, 10_000_000 + k, row, loop), k)
            if found is not None:
                declined.append(not model.predict(found.features).accepted[0])
        print(f"declined, one parameter {low:g}-{high:g} x outside the range: {100 * np.mean(declined):.1f} %")
    good = []
    for k in range(count):
        block, _ = simulate_window(spec, 20_000_000 + k, core[k], loop)
        found = labelled(block, {}, k)
        if found is not None and model.predict(found.features).accepted[0]:
            good.append(block)
    for name, fault in windows_of.FAULTS.items():
        declined = []
        for block in good:
            found = labelled(fault(block, rng), {}, 0)
            declined.append(found is None or not model.predict(found.features).accepted[0])
        print(f"declined, {name}: {100 * np.mean(declined):.1f} % of {len(good)}")


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
