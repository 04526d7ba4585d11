"""What a model leaves that noise does not explain bends each cut of a recording otherwise: the mean over several."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servo_daemon.diagnosis.trial.cuts import mean_over_cuts
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.full_data_fit import fit_full_data, fit_runs
from servo_daemon.diagnosis.trial.split import segment_length_s
from servo_daemon.diagnosis.trial.trial import Trial, first_trial
from servo_daemon.identification.output_error import OutputErrorFit, Recording
from servo_daemon.samples import SampleBlock, make_block
from tests.recovery.generator import PAPER, Scenario, generate, typical

pytestmark = pytest.mark.usefixtures("generator_built")
MODEL = ("coulomb_friction",)
SECONDS = 12.0


def captured(*, torque_driven: bool = True, disturbed: bool = True) -> SampleBlock:
    """Dry friction, and a slow load that the model does not have."""
    load = {"periodic_disturbance": {"Tper": 0.02 * PAPER.working_torque_Nm, "f_per": 0.31, "phi_per": 0.4}}
    hidden = typical("coulomb_friction", PAPER, 0.1) | (load if disturbed else {})
    r = generate(PAPER, Scenario("multisine", seed=6, seconds=SECONDS, effects=hidden))
    if not torque_driven:
        return make_block(r.time_s, voltage_V=r.voltage_V, current_A=r.current_A, position_rad=r.position_rad)
    return make_block(r.time_s, torque_Nm=PAPER.K * r.truth.current_A, position_rad=r.position_rad)


def fitted(block: SampleBlock) -> tuple[Data, Trial, OutputErrorFit]:
    recordings = (Recording("a", block),)
    data = Data.of(recordings, {}, MODEL, segment_length_s(recordings))
    trial = first_trial(data, MODEL, {"J": PAPER.J, "B": PAPER.B, "Tc": 0.1 * PAPER.working_torque_Nm})
    return data, trial, fit_full_data(data, trial, None)


@pytest.mark.slow
def test_the_mean_of_five_cuts_is_published_with_how_far_they_lie_apart() -> None:
    data, trial, fit = fitted(captured())
    mean = mean_over_cuts(data, trial, fit)
    single = []
    for length in (1.0, 2**0.5, 2.0, 2**1.5, 4.0):
        cut = fit_runs(data, trial, {**trial.values, **fit.values}, length * data.split.segment_s)
        single.append([np.log(cut.parameters[n].value or np.nan) for n in ("J", "B", "Tc")])
    truth = {"J": PAPER.J, "B": PAPER.B, "Tc": 0.1 * PAPER.working_torque_Nm}
    for name, logs in zip(truth, np.transpose(single), strict=True):
        p = mean.parameters[name]
        assert p.value is not None and p.std is not None
        assert np.log(p.value) == pytest.approx(np.mean(logs), abs=1e-6)
        assert p.std / p.value >= np.std(logs, ddof=1)
        assert abs(p.value - truth[name]) < 3.0 * p.std
    assert mean.solution.point.linearisation.residuals[0].shape == fit.solution.point.linearisation.residuals[0].shape


@pytest.mark.slow
def test_where_the_supply_has_noise_or_noise_is_all_a_fit_stands() -> None:
    data, trial, fit = fitted(captured(torque_driven=False))
    assert mean_over_cuts(data, trial, fit) is fit
    data, trial, fit = fitted(captured(disturbed=False))
    white = replace(fit, residual={name: replace(test, white=True) for name, test in fit.residual.items()})
    assert mean_over_cuts(data, trial, white) is white
