"""Long free runs that drift, and what is said of them."""

from __future__ import annotations

import pytest

from servo_daemon.identification.output_error import FitOptions, Recording, fit_output_error
from servo_daemon.identification.procedure.drift import Drift, drift_of
from servo_daemon.samples import SampleBlock, make_block
from tests.recovery.generator import RE40, Scenario, generate

LOAD = {"constant_load_torque": {"TL": 0.05 * RE40.working_torque_Nm}}


def recorded(motion: str, load: bool) -> SampleBlock:
    """20 s without a voltage: torque in, angle out."""
    r = generate(RE40, Scenario(motion, seconds=20.0, effects=LOAD if load else {}, seed=3))
    return make_block(r.time_s, current_A=r.current_A, position_rad=r.position_rad)


def judged(block: SampleBlock, effects: tuple[str, ...] = ()) -> tuple[Drift | None, float | None]:
    """What is said of the fit, and its J over the truth."""
    recordings, options = [Recording("capture", block)], FitOptions(fixed={"K": RE40.K})
    fit = fit_output_error(recordings, effects, options)
    J = fit.parameters["J"].value
    return drift_of(fit, recordings, options), None if J is None else J / RE40.J


def test_a_load_that_the_model_lacks_bends_a_long_free_run() -> None:
    drift, share = judged(recorded("multisine", load=True))
    assert share is None or abs(share - 1.0) > 0.5  # that is what there is to say
    assert drift is not None
    assert drift.channel == "position_rad"
    assert drift.share > 0.9
    _, seen = drift.biased["J"]
    assert abs(seen / RE40.J - 1.0) < 0.4


@pytest.mark.parametrize("motion", ["reversals", pytest.param("steps", marks=pytest.mark.slow)])
def test_a_model_that_lacks_nothing_is_left_alone(motion: str) -> None:
    drift, share = judged(recorded(motion, load=False))
    assert share == pytest.approx(1.0, rel=0.03)
    assert drift is None


@pytest.mark.slow
def test_with_the_load_in_the_model_nothing_is_said() -> None:
    drift, share = judged(recorded("multisine", load=True), ("constant_load_torque",))
    assert share == pytest.approx(1.0, rel=0.03)
    assert drift is None
