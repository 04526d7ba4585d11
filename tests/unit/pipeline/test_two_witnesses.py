"""Filter and regression disagree: the innovations decide which of them is believed."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.config import DriveConfig
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.published.snapshot import ParameterEstimate
from servo_daemon.regression.estimate import RegressionEstimate
from servo_daemon.regression.motor_rls import MotorRls
from servo_daemon.simulate import PAPER_MOTOR, SimulatedDrive, make_settings

#: How far back the regression says that it looks, s.
SPAN_S = 4.0
_CORE = ("R", "L", "K", "J", "B")


def followed(monkeypatch: pytest.MonkeyPatch, friction: float) -> list[ParameterEstimate]:
    """R as published, a tick at a time, beside a regression that goes on being sure of an R 60 % too large.

    Args:
        friction: N·m that the model lacks.
    """
    honest = MotorRls.estimate

    def wrong(self: MotorRls) -> RegressionEstimate | None:
        if honest(self) is None:
            return None
        value = np.array([PAPER_MOTOR[name] * (1.6 if name == "R" else 1.0) for name in _CORE])
        return RegressionEstimate(_CORE, value, np.diag(np.square(0.01 * value)), SPAN_S, closes=True)

    monkeypatch.setattr(MotorRls, "estimate", wrong)
    effects = {"coulomb_friction": {"Tc": friction}} if friction else {}
    block = SimulatedDrive(make_settings(rate_hz=500.0, effects=effects)).next_block(6000)
    estimates = Pipeline(DriveConfig(nominal=dict(PAPER_MOTOR))).process(block)
    return [e.parameters[0] for e in estimates]


def test_a_white_and_calm_filter_is_not_overruled(monkeypatch: pytest.MonkeyPatch) -> None:
    R = followed(monkeypatch, 0.0)
    known = [p.status == "tracking" for p in R]
    assert True in known and known.index(True) * 0.1 > SPAN_S
    assert all(known[known.index(True) :])
    last = R[-1]
    assert last.value is not None and last.std is not None
    assert abs(last.value - PAPER_MOTOR["R"]) < 4.0 * last.std < 0.05 * PAPER_MOTOR["R"]


def test_one_that_does_not_explain_its_data_is(monkeypatch: pytest.MonkeyPatch) -> None:
    R = followed(monkeypatch, 0.08 * PAPER_MOTOR["K"] * 15.0)
    assert "tracking" not in [p.status for p in R]
