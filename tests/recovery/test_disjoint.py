"""Standard deviations from parts of a recording, against what is hidden in it."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.identification.output_error import FitOptions, OutputErrorFit, fit_output_error
from servo_daemon.identification.output_error.precision.disjoint import spread_std
from servo_daemon.samples import F64
from tests.recovery.captures import capture
from tests.recovery.generator import PAPER, Scenario

pytestmark = pytest.mark.usefixtures("generator_built")
_SECONDS = 10.0


def over_pieces(R_later: float) -> OutputErrorFit:
    """The linear motor fitted to free runs of a recording in whose second half R is another."""
    n = round(_SECONDS * Scenario("multisine").rate_hz)
    R: F64 = np.where(np.arange(n) < n // 2, PAPER.R, R_later)
    recording = capture(PAPER, Scenario("multisine", seconds=_SECONDS, ageing={"R": R}, seed=71))
    nominal = {name: float(getattr(PAPER, name)) for name in ("R", "L", "K", "J", "B")}
    options = FitOptions(nominal=nominal, thorough=False, segment_s=0.5, noise_model="none")
    return fit_output_error([recording], (), options)


def test_parts_that_agree_differ_by_what_slopes_say() -> None:
    fit = over_pieces(PAPER.R)
    spread = spread_std(fit.problem, fit.solution.point)
    assert spread is not None
    slopes = np.sqrt(np.diag(fit.after.covariance))[: fit.problem.n_shared]
    assert np.all(spread < 2.5 * slopes)
    assert np.median(spread / slopes) > 0.2


def test_parts_that_disagree_are_what_is_not_known() -> None:
    """R grows by a tenth: 5 % beside what is published, of which slopes know nothing."""
    fit = over_pieces(1.1 * PAPER.R)
    spread = spread_std(fit.problem, fit.solution.point)
    assert spread is not None
    k = fit.problem.free.index("R")
    assert 0.01 < spread[k] < 0.06
    assert np.sqrt(fit.after.covariance[k, k]) < 0.5 * spread[k]


def test_too_few_parts_tell_nothing() -> None:
    recording = capture(PAPER, Scenario("multisine", seconds=1.0, seed=71))
    nominal = {name: float(getattr(PAPER, name)) for name in ("R", "L", "K", "J", "B")}
    options = FitOptions(nominal=nominal, thorough=False, segment_s=0.5, noise_model="none")
    fit = fit_output_error([recording], (), options)
    assert spread_std(fit.problem, fit.solution.point) is None
