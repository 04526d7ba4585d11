"""What `[drive.estimation]` and `[drive.drift]` say arrives in the estimates, each seen by what it does."""

from __future__ import annotations

import pytest

from servo_daemon.config import DriveConfig, EstimationConfig
from servo_daemon.kalman.filterpy_ekf import FilterpyLoop
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.plant.compiled import SampleLoop
from servo_daemon.published.snapshot import ParameterEstimate
from servo_daemon.samples import F64, SampleBlock
from servo_daemon.simulate import PAPER_MOTOR, SimulatedDrive, make_settings


def recording(seconds: float) -> SampleBlock:
    return SimulatedDrive(make_settings(rate_hz=500.0, seed=3)).next_block(round(500 * seconds))


def config(drift: dict[str, str] | None = None, **estimation: object) -> DriveConfig:
    return DriveConfig(nominal=dict(PAPER_MOTOR), drift=drift or {}, estimation=EstimationConfig(**estimation))  # type: ignore[arg-type]


def published(drive: DriveConfig, block: SampleBlock) -> dict[str, ParameterEstimate]:
    """At the end of the recording."""
    pipeline = Pipeline(drive)
    pipeline.process(block, rows=False)
    last = pipeline.finish()
    assert last is not None
    return {p.name: p for p in last.parameters}


def known_std(p: ParameterEstimate) -> float:
    assert p.status == "tracking", p
    assert p.std is not None
    return p.std


@pytest.mark.parametrize("engine", ["compiled", "filterpy"])
def test_the_engine_that_is_asked_for_takes_the_samples(engine: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The two agree to rounding, so only who was asked tells them apart."""
    block, taken = recording(3.0), {"compiled": 0, "filterpy": 0}
    loops: tuple[tuple[str, type], ...] = (("compiled", SampleLoop), ("filterpy", FilterpyLoop))
    for name, loop in loops:

        def run(self: object, state: F64, constants: F64, samples: F64, name: str = name, own=loop.run) -> F64:  # type: ignore[no-untyped-def]
            taken[name] += len(samples)
            return own(self, state, constants, samples)  # type: ignore[no-any-return]

        monkeypatch.setattr(loop, "run", run)
    pipeline = Pipeline(config(engine=engine))
    started = next(k for k in range(0, len(block), 50) if pipeline.process(block.slice(k, k + 50)) and taken[engine])
    before = dict(taken)
    pipeline.process(block.slice(started + 50, started + 100), rows=False)
    assert taken[engine] - before[engine] >= 50
    assert engine == "filterpy" or taken["filterpy"] == 0


def test_a_parameter_that_may_change_faster_is_known_less_well() -> None:
    block = recording(8.0)
    slow, fast = (published(config(drift={"R": text}), block) for text in ("0.1 %/h", "300 %/h"))
    assert known_std(fast["R"]) > 3 * known_std(slow["R"])


def test_l_is_never_known_better_than_current_and_voltage_are_in_step() -> None:
    """A delay of the current by δ looks like an inductance of δ R."""
    block = recording(8.0)
    apart, together = (published(config(skew_s=skew_s), block)["L"] for skew_s in (2e-4, 0.0))
    floor = 2e-4 * PAPER_MOTOR["R"]
    assert known_std(together) < 0.3 * floor
    assert known_std(apart) == pytest.approx((known_std(together) ** 2 + floor**2) ** 0.5, rel=0.02)
