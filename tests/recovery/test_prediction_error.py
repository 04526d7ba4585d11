"""Parameters from predictions, where noise that no recording shows decides when dry friction lets go of the shaft."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from servo_daemon.diagnosis.trial.full_data_fit import honest
from servo_daemon.identification.output_error import FitOptions, OutputErrorFit, fit_output_error
from servo_daemon.identification.output_error.problem.setup import Recording
from servo_daemon.identification.prediction_error import predicted_fit
from tests.recovery.captures import capture
from tests.recovery.generator import GEAR_MOTOR, PAPER, Motor, Scenario
from tests.recovery.generator.effects import EffectValues

pytestmark = [pytest.mark.usefixtures("generator_built"), pytest.mark.slow]
NAMES = ("R", "L", "K", "J", "B")


def free_runs(
    motor: Motor, motion: str, effects: Mapping[str, EffectValues], seed: int
) -> tuple[Recording, OutputErrorFit]:
    """A capture of 20 s, and its fit over free runs of half a second, begun 2 % beside the truth."""
    recording = capture(motor, Scenario(motion, seconds=20.0, effects=dict(effects), seed=seed))
    nominal = {n: v * (1.02 if k % 2 else 0.98) for k, (n, v) in enumerate(truth_of(motor, effects).items())}
    options = FitOptions(nominal=nominal, thorough=False, segment_s=0.5, noise_model="none")
    return recording, honest(fit_output_error([recording], tuple(effects), options))


def truth_of(motor: Motor, effects: Mapping[str, EffectValues]) -> dict[str, float]:
    own = {name: float(getattr(motor, name)) for name in NAMES}
    return own | {k: float(v) for values in effects.values() for k, v in values.items()}


def deviations(fit: OutputErrorFit, truth: Mapping[str, float]) -> dict[str, float]:
    """Error over standard deviation of what is estimated."""
    known = {n: fit.parameters[n] for n in truth}
    return {n: (p.value - truth[n]) / p.std for n, p in known.items() if p.value is not None and p.std}


def test_friction_near_standstill_is_not_bent_by_the_voltages_noise() -> None:
    """Free runs put its parameters 4 to 10 % off, at 4 to 20 of their standard deviations, each start others."""
    stribeck = {"Tc": 0.91884, "Ts": 1.470144, "ws": 0.42454}
    effects = {"stribeck_friction": stribeck}
    truth = truth_of(PAPER, effects)
    recording, biased = free_runs(PAPER, "reversals", effects, 618921)
    assert max(abs(d) for d in deviations(biased, truth).values()) > 4.0  # that this test can fail
    fit = predicted_fit(biased, [recording])
    assert fit is not None
    assert fit.white
    fit = honest(fit)
    found = deviations(fit, truth)
    assert found.keys() == truth.keys()
    assert max(abs(d) for d in found.values()) < 3.0, found
    for name in stribeck:
        std = fit.parameters[name].std
        assert std is not None
        assert std < 0.01 * truth[name]


def test_what_the_data_hardly_tell_is_not_taken_from_predictions() -> None:
    """Viscous friction and inertia against a friction that grows with the load, in a position servo's steps: the
    likelihood has a step wherever the shaft lets go a sample earlier, and put them 15 % off at 40 of its σ."""
    effects = {"load_dependent_friction": {"mu": 0.04}}
    recording, fit = free_runs(PAPER, "steps", effects, 256110)
    assert predicted_fit(fit, [recording]) is None


def test_a_model_that_lacks_something_is_not_explained_by_predictions() -> None:
    """A filter follows what is missing; its innovations say so."""
    effects = {"coulomb_friction": {"Tc": 0.09}, "gravity_load": {"Tg": 0.09, "phi_g": 0.3}}
    recording = capture(GEAR_MOTOR, Scenario("multisine", seconds=20.0, effects=effects, seed=5))
    options = FitOptions(nominal=truth_of(GEAR_MOTOR, {}), thorough=False, segment_s=0.5, noise_model="none")
    lacking = fit_output_error([recording], ("coulomb_friction",), options)
    assert predicted_fit(lacking, [recording]) is None


def test_without_friction_it_is_the_likelihood_of_free_runs() -> None:
    """Where nothing sticks both are the same estimate."""
    recording = capture(PAPER, Scenario("multisine", seconds=10.0, seed=7400))
    fit = fit_output_error([recording], (), FitOptions(nominal=truth_of(PAPER, {}), thorough=False))
    assert fit.white
    assert fit.noise is not None
    again = predicted_fit(fit, [recording])
    assert again is not None
    assert again.noise is not None
    for name in NAMES:
        p, q = fit.parameters[name], again.parameters[name]
        assert p.value is not None
        assert q.value is not None
        assert p.std is not None
        assert q.std is not None
        assert abs(p.value - q.value) < 0.3 * p.std
        assert q.std == pytest.approx(p.std, rel=0.1)
    assert np.isclose(again.noise.input_std, fit.noise.input_std, rtol=0.1)
