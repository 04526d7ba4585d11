"""What a model declines, and what its estimates are worth where it should have: for `benchmarks/learning.py`.

Faults are those of `learning_windows`, which the training knows nothing of (it draws its own,
`learning/examples/faults.py`).
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import learning_windows as windows_of
from servo_daemon.learning.examples.drawing import CORE, TrainingSpec, draw_parameters
from servo_daemon.learning.examples.targets import baseline
from servo_daemon.learning.examples.training import TrainingSet, labelled, servo_loop, simulate_window
from servo_daemon.learning.model.model import LearnedModel, Predictions
from servo_daemon.samples import SampleBlock

_OUTSIDE = ((1.0, 1.5), (1.5, 2.0), (2.0, 4.0), (1.5, 4.0))


def abstention(spec: TrainingSpec, model: LearnedModel, test: TrainingSet, count: int) -> None:
    """Prints what is accepted of familiar motors, and declined of others and of faults; count: windows of each."""
    known = baseline(test.features, spec.nominal, spec.spread).known
    ok = model.predict(test.features).accepted
    print(f"\naccepted of familiar motors: {100 * ok[known].mean():.1f} % of windows with a regression; goal 95 %")
    _outside(spec, model, count)
    _faults(spec, model, count)
    print(flush=True)


def _outside(spec: TrainingSpec, model: LearnedModel, count: int) -> None:
    rng, loop = np.random.default_rng(5), servo_loop(spec)
    core = draw_parameters(TrainingSpec(dict(spec.nominal), seed=6), count)
    for low, high in _OUTSIDE:
        drawn = []
        for k in range(count):
            row, which = core[k].copy(), int(rng.integers(len(CORE)))
            beyond = spec.spread * low * (high / low) ** rng.random()
            row[which] = spec.nominal[CORE[which]] * beyond ** rng.choice((-1.0, 1.0))
            drawn.append((labelled(*simulate_window(spec, 10_000_000 + k, row, loop), k), which))
        found = [(model.predict(f.features), f, which) for f, which in drawn if f is not None]
        passed = [(p, f, which) for p, f, which in found if p.accepted[0]]
        regression = [p.declined[0] for p, _, _ in found if "no regression" not in p.declined[0]]
        held = [_held(p, f)[which] for p, f, which in passed]
        wide = [np.log(p.high[0, which] / max(p.low[0, which], 1e-300)) / 2 for p, _, which in passed]
        share, of_regression = 1 - len(passed) / len(found), np.mean([bool(r) for r in regression])
        print(
            f"declined, one parameter {low:g}-{high:g} x outside the range: {100 * share:.1f} % "
            f"({100 * of_regression:.1f} % of those with a regression); of the accepted the 95 % interval of that "
            f"parameter holds {100 * np.mean(held):.0f} %, median half width {100 * np.median(wide):.0f} %",
            flush=True,
        )


def _held(p: Predictions, f: TrainingSet) -> list[bool]:
    return [bool(x) for x in ((p.low <= f.truth) & (f.truth <= p.high))[0]]


def _faults(spec: TrainingSpec, model: LearnedModel, count: int) -> None:
    """Of windows that are accepted as they are."""
    rng, loop = np.random.default_rng(5), servo_loop(spec)
    core = draw_parameters(TrainingSpec(dict(spec.nominal), seed=6), count)
    good: list[tuple[SampleBlock, TrainingSet]] = []
    for k in range(count):
        block, truth = simulate_window(spec, 20_000_000 + k, core[k], loop)
        found = labelled(block, truth, k)
        if found is not None and model.predict(found.features).accepted[0]:
            good.append((block, found))
    for name, fault in windows_of.FAULTS.items():
        held = []
        for block, healthy in good:
            found = labelled(fault(block, rng), {}, 0)
            p = None if found is None else model.predict(found.features)
            if p is not None and p.accepted[0]:
                held.append(_held(p, healthy)[: len(CORE)])
        share = 100 * (1 - len(held) / len(good))
        inside = (
            f"; of the accepted the 95 % intervals of R, L, K, J, B hold {100 * np.mean(held):.0f} %" if held else ""
        )
        print(f"declined, {name}: {share:.1f} % of {len(good)}{inside}", flush=True)
