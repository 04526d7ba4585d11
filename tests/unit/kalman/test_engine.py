"""Which engine runs what: new samples the one that was asked for, what is gone over again the compiled one."""

from __future__ import annotations

from collections import Counter
from functools import cache
from typing import Any

import numpy as np
import pytest

from servo_daemon.config import DriveConfig, parse_config
from servo_daemon.kalman.filterpy_ekf import FilterpyLoop
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.plant.compiled import SampleLoop
from servo_daemon.published.snapshot import Estimate
from servo_daemon.samples import F64, SampleBlock
from servo_daemon.simulate import DEFAULT_NOMINAL, SimulatedDrive, make_settings

#: Slow enough for filterpy, long enough for both looks at the start and for a step of R to be found, Hz and s.
RATE_HZ, SECONDS, STEP_S = 200.0, 10.0, 6.5


@cache
def recording() -> SampleBlock:
    settings = make_settings(seed=4, rate_hz=RATE_HZ, ageing=[f"R=+0.2@{STEP_S}s"])
    return SimulatedDrive(settings).next_block(round(RATE_HZ * SECONDS))


def drive(engine: str) -> DriveConfig:
    estimation = {"engine": engine, "refresh": False}
    table = {"driver": "simulated", "nominal": dict(DEFAULT_NOMINAL), "estimation": estimation}
    return parse_config({"drive": [table]}).drive[0]


def run(engine: str, monkeypatch: pytest.MonkeyPatch) -> tuple[Estimate, Counter[str], list[str]]:
    """The last estimate, how many samples went through each loop, and the kinds of events."""
    steps: Counter[str] = Counter()

    def counted(loop: type[Any]) -> Any:
        original = loop.run

        def run(self: Any, state: F64, constants: F64, samples: F64) -> F64:
            steps[loop.__name__] += len(samples)
            return original(self, state, constants, samples)

        return run

    with monkeypatch.context() as patched:
        for loop in (FilterpyLoop, SampleLoop):
            patched.setattr(loop, "run", counted(loop))
        pipeline = Pipeline(drive(engine))
        pipeline.process(recording(), rows=False)
    estimate = pipeline.current()
    assert estimate is not None
    return estimate, steps, [kind for kind, _, _ in pipeline.messages]


def test_filterpy_takes_each_sample_once_and_what_is_gone_over_again_is_compiled(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found, steps, kinds = run("filterpy", monkeypatch)
    samples = len(recording())
    assert "parameter_jump" in kinds, "a search has gone over samples again, too"
    assert steps["FilterpyLoop"] <= samples, "no sample twice"
    assert steps["FilterpyLoop"] > 0.75 * samples, "all but those before the start are filterpy's"
    assert steps["SampleLoop"] > 10 * samples, "those that are gone over again are many more"
    other, without, _ = run("compiled", monkeypatch)
    assert without["FilterpyLoop"] == 0
    for ours, theirs in zip(found.parameters, other.parameters, strict=True):
        assert ours.status == theirs.status and ours.value is not None and theirs.value is not None
        assert theirs.std is not None
        assert abs(ours.value - theirs.value) < 0.01 * theirs.std
    assert np.isfinite([p.value for p in found.parameters if p.value is not None]).all()
