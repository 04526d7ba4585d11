"""Every learner on the same features of the same motors, with the same tuning budget: for `benchmarks/learning.py`."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from servo_daemon.learning.examples.drawing import TrainingSpec
from servo_daemon.learning.examples.targets import Target, baseline, bounded, decode, encode
from servo_daemon.learning.examples.training import TrainingSet
from servo_daemon.learning.features.preparation import Preparation
from servo_daemon.learning.learners.grnn import GRNN
from servo_daemon.learning.learners.screening import forest
from servo_daemon.learning.model.model import LearnedModel
from servo_daemon.learning.training.fitting import roles
from servo_daemon.samples import F64

Fit = Callable[[F64, F64], Callable[[F64], F64]]


def _estimator(make: Callable[[], Any]) -> Fit:
    return lambda X, y: make().fit(X, y).predict


def _grnn_settings(X: F64, y: F64) -> list[Fit]:
    """Bandwidths are fitted once; then as they are, narrower and wider."""
    h = GRNN(random_state=0).fit(X, y).bandwidth_
    return [_estimator(lambda s=s: GRNN(bandwidth=s * h, random_state=0)) for s in (0.9, 1.0, 1.1, 1.25)]  # type: ignore[misc]


def _settings(name: str, X: F64, y: F64) -> list[Fit]:
    from sklearn.ensemble import HistGradientBoostingRegressor
    from sklearn.linear_model import Ridge
    from sklearn.multioutput import MultiOutputRegressor
    from sklearn.neighbors import KNeighborsRegressor

    if name == "grnn":
        return _grnn_settings(X, y)
    if name == "forest":
        return [_estimator(lambda k=k: forest(100, 0).set_params(min_samples_leaf=k)) for k in (1, 3, 8, 20)]  # type: ignore[misc]
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


def compare_learners(
    spec: TrainingSpec, model: LearnedModel, train: TrainingSet, tests: Mapping[str, TrainingSet]
) -> None:
    """Prints a table; train: healthy windows; tests: those of held-out motors, by name."""
    base = baseline(train.features, spec.nominal, spec.spread)
    train = train.only(base.known)
    role = roles(train.motor, spec.seed)
    fit, held = role != "calibrate", role[role != "calibrate"] == "screen"
    train = train.only(fit)
    prepared = Preparation().fit(train.features)
    known = {k: t.only(baseline(t.features, spec.nominal, spec.spread).known) for k, t in tests.items()}
    print(_heading("median error, %, of R, L, K, J, B and of all", known))
    print_errors("regression (RLS)", {k: errors_of(t.features[:, :5], t.truth) for k, t in known.items()})
    drop = {k: np.exp(baseline(t.features, spec.nominal, spec.spread).centre[:, :5]) for k, t in known.items()}
    print_errors("regression with brush drop", {k: errors_of(drop[k], t.truth) for k, t in known.items()})
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
            found[key] = errors_of(np.exp(decode(target, y, b, spec.nominal)[:, :5]), t.truth)
        print_errors(title, found, time.perf_counter() - began)
    print()


def _tuned(
    spec: TrainingSpec,
    name: str,
    target: Target,
    train: TrainingSet,
    prepared: Preparation,
    columns: Any,
    held: Any,
) -> Callable[[F64], F64]:
    """The best of four settings on the held-out motors, fitted on all."""
    b = baseline(train.features, spec.nominal, spec.spread)
    y = bounded(target, encode(target, train.truth, b, spec.nominal))
    X = prepared.transform(train.features)[:, columns]
    settings = _settings(name, X[~held], y[~held])
    errors = [float(np.median(np.abs(s(X[~held], y[~held])(X[held]) - y[held]))) for s in settings]
    return settings[int(np.argmin(errors))](X, y)


def errors_of(value: F64, truth: F64) -> F64:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.abs(np.log(value / truth[:, :5]))


def _heading(text: str, tests: Mapping[str, TrainingSet]) -> str:
    return text + "".join(f" | {name}, {len(t)} windows" for name, t in tests.items())


def print_errors(title: str, errors: Mapping[str, F64], seconds: float | None = None) -> None:
    cells = []
    for e in errors.values():
        each = " ".join(f"{100 * v:5.2f}" for v in np.nanmedian(e, axis=0))
        cells.append(f"{each}  {100 * np.nanmedian(e):5.2f}")
    took = "" if seconds is None else f" | {seconds:.0f} s"
    print(f"  {title:32s} | {' | '.join(cells)}{took}", flush=True)
