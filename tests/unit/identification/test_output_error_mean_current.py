"""A current that is the mean over the row before it, of windings slower and faster than a row."""

from __future__ import annotations

from dataclasses import replace

import pytest

from servo_daemon.commands.fit.notes import result_notes
from servo_daemon.identification.output_error.fit import fit_output_error
from servo_daemon.identification.output_error.fitted import FitOptions, OutputErrorFit
from servo_daemon.identification.output_error.problem.setup import Recording
from servo_daemon.plant.build import build_plant
from servo_daemon.samples import SampleBlock
from tests.mean_current import MOTOR, PERIOD_S, recorded


def fitted(block: SampleBlock) -> OutputErrorFit:
    return fit_output_error([Recording("means.csv", block)])


def assert_known(fit: OutputErrorFit, L: float, stds: float, share: float = 1.0) -> None:
    for name, true in {**MOTOR, "L": L}.items():
        found = fit.parameters[name]
        if name == "B":  # next to nothing of it shows in 3 s
            continue
        if found.value is not None and found.std is not None:  # Simpson's rule is 0.15 % off for the fastest winding
            assert abs(found.value - true) < max(stds * found.std, 2e-3 * true), name
        assert found.std is None or found.std < share * true, name


@pytest.mark.parametrize("time_constant", [0.15, 0.5, 1.0, 5.0])
def test_means_are_compared_with_means(time_constant: float) -> None:
    """Of 0.15 rows to 5; taken for values at the samples L was 2.7 times too large, at 12 of its std, for 0.25 rows."""
    L = time_constant * PERIOD_S * MOTOR["R"]
    fit = fitted(replace(recorded(L, means=True), current_mean=True))
    assert fit.residual["current_A"].white
    assert_known(fit, L, 4.0, 0.01)
    assert all(fit.parameters[n].value is not None for n in ("R", "L", "K", "J"))
    assert not fit.current_is_mean


@pytest.mark.parametrize("time_constant", [0.25, 1.0, 5.0])
def test_means_that_nobody_told_are_seen(time_constant: float) -> None:
    L = time_constant * PERIOD_S * MOTOR["R"]
    fit = fitted(recorded(L, means=True))
    assert fit.current_is_mean
    assert_known(fit, L, 3.0)
    assert any("# current: mean" in note for note in result_notes(fit, {}))


@pytest.mark.parametrize("friction_Nm", [0.0, 0.02])
def test_a_current_at_its_samples_is_no_mean(friction_Nm: float) -> None:
    assert not fitted(recorded(1.2e-3, means=False, friction_Nm=friction_Nm)).current_is_mean


def test_recordings_of_both_kinds_are_compared_with_values_at_the_samples() -> None:
    """One model shows one kind; a mixture is told as what it is, a misfit."""
    one, other = recorded(1.2e-3, means=True), recorded(1.2e-3, means=False, seed=6)
    fit = fit_output_error([Recording("a", replace(one, current_mean=True)), Recording("b", other)])
    assert not fit.problem.plant.mean_current and not fit.residual["current_A"].white
    assert_known(fit, 1.2e-3, 3.0)


def test_a_plant_for_means_is_cut_evenly_and_one_of_a_late_sensor_is_not() -> None:
    plant = build_plant(("coulomb_friction",)).for_runs_of(0.05, mean_current=True)
    assert plant.mean_current and plant.pieces >= 8 and plant.pieces % 2 == 0
    assert plant.with_effects(()).mean_current
    assert not build_plant(("measurement_delay",)).for_runs_of(1e-3, mean_current=True).mean_current


def test_a_trial_that_carries_states_on_is_fitted_to_means_as_well() -> None:
    """As a diagnosis tries its models: short segments, whose slow states come from one run over everything."""
    block = replace(recorded(0.3e-3, means=True), current_mean=True)
    values = {**MOTOR, "L": 0.3e-3}
    options = FitOptions(nominal=values, thorough=False, segment_s=0.5, misfit=False)
    fit = fit_output_error([Recording("means.csv", block)], ("winding_heating",), options)
    assert fit.problem.plant.mean_current and fit.values["L"] == pytest.approx(0.3e-3, rel=0.01)
