"""A name whose own parameters are those of what it contains is that one's."""

from __future__ import annotations

import pytest

from servo_daemon.diagnosis.search.select import Selection
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.full_data_fit import FullDataFits
from servo_daemon.diagnosis.trial.split import segment_length_s
from servo_daemon.diagnosis.trial.trial import first_trial, fit_trial
from servo_daemon.diagnosis.verdict.adequacy import believed
from tests.recovery.captures import capture
from tests.recovery.generator import GEAR_MOTOR, Scenario, typical

pytestmark = pytest.mark.usefixtures("generator_built")


@pytest.mark.parametrize("hidden", ["coulomb_friction", pytest.param("asymmetric_friction", marks=pytest.mark.slow)])
def test_equal_levels_are_coulomb_friction(hidden: str) -> None:
    """As if the search had come to levels by direction, whatever is in the data."""
    rich = "asymmetric_friction"
    effects = typical(hidden, GEAR_MOTOR, 0.2)
    made = capture(GEAR_MOTOR, Scenario("multisine", 4.0, effects=effects, seed=2))
    data = Data.of([made], {}, (), segment_length_s([made]))
    base = first_trial(data, (), {})
    chosen = fit_trial(data, (rich,), {**base.values, "Tc": 0.05, "Tc_neg": 0.05, "B_neg": base.values["B"]})
    assert chosen is not None
    belief = believed(Selection(data, base, chosen, (rich,), (), {}), FullDataFits(data))
    assert belief.selection.added == (hidden,)
    assert belief.extended is not None
    assert belief.extended.problem.plant.effects == (hidden,)
