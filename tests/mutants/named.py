"""Mutants with a name: each is a fault that the tests once let pass, or a setting that would be ignored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

CONFIGURED = ("tests/unit/pipeline/test_configured_estimation.py",)
FAMILIARITY = ("tests/unit/learning/test_learning_familiarity.py",)
NOVELTY = ("tests/unit/learning/test_learning_novelty.py", "tests/unit/learning/test_learning_model.py")
REFRESH = ("tests/unit/learning/test_refresh.py",)
REGRESSION = ("tests/unit/regression/test_rls*.py", "tests/recovery/test_tracking.py")
HELD = ("tests/unit/tracking/test_excitation_fusion.py",)
JUDGE = ("tests/unit/pipeline/test_two_witnesses.py", "tests/unit/tracking/test_jumps.py")
GAIN = ("tests/unit/diagnosis/test_*.py", "tests/recovery/test_hidden.py")


@dataclass(frozen=True, slots=True)
class Named:
    """A fault.

    Attributes:
        name: what is wrong with it.
        file: from the top of the tree.
        old, new: text that stands in the file exactly once, and what takes its place.
        tests: patterns of the fast tests of which one must fail.
    """

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]

    def applied(self, source: str) -> str | None:
        """The source with this fault; None: stale, the text is not there once."""
        return source.replace(self.old, self.new) if source.count(self.old) == 1 else None


NAMED: Sequence[Named] = (
    Named(
        "engine ignored: the tracker is not told",
        "servo_daemon/pipeline/publish.py",
        "drift, config.estimation.engine)",
        'drift, "compiled")',
        CONFIGURED,
    ),
    Named(
        "engine ignored: the tracker does not ask",
        "servo_daemon/tracking/plant_tracker.py",
        'if self.settings.engine != "filterpy":',
        "if True:",
        CONFIGURED,
    ),
    Named(
        "drift ignored: the tracker is not told",
        "servo_daemon/pipeline/publish.py",
        "config.nominal, drift, config",
        "config.nominal, {}, config",
        CONFIGURED,
    ),
    Named(
        "drift ignored: the default is taken",
        "servo_daemon/tracking/plan/settings.py",
        "if given is not None and not offset:",
        "if False:",
        CONFIGURED,
    ),
    Named(
        "skew ignored",
        "servo_daemon/pipeline/publish.py",
        "return self._config.estimation.skew_s * self._value",
        "return 0.0 * self._value",
        CONFIGURED,
    ),
    Named(
        "all windows are familiar",
        "servo_daemon/learning/learners/familiarity.py",
        "return np.asarray(np.min(below, axis=0) / (len(self.mass_) + 1.0))",
        "return np.ones(len(z))",
        FAMILIARITY,
    ),
    Named(
        "familiarity declines nothing",
        "servo_daemon/learning/model/model.py",
        "np.where(familiarity < LEAST_FAMILIARITY,",
        "np.where(familiarity < -1.0,",
        NOVELTY,
    ),
    Named(
        "familiarity without what lies outside the components",
        "servo_daemon/learning/learners/familiarity.py",
        "np.sqrt(p.explained_variance_)), -outside",
        "np.sqrt(p.explained_variance_)), 0.0 * outside",
        FAMILIARITY,
    ),
    Named(
        "familiarity without the mass along the components",
        "servo_daemon/learning/learners/familiarity.py",
        "return self._kernel.mass(along / np.sqrt(p.explained_variance_)), -outside",
        "return -outside, -outside",
        FAMILIARITY,
    ),
    Named(
        "no window is novel",
        "servo_daemon/learning/model/novelty.py",
        "return np.asarray(above / (len(self.known_) + 1.0))",
        "return np.ones(len(novel))",
        NOVELTY,
    ),
    Named(
        "novelty declines nothing",
        "servo_daemon/learning/model/model.py",
        "np.where(usual < MOST_NOVEL,",
        "np.where(usual < -1.0,",
        NOVELTY,
    ),
    Named(
        "the refresh's gate is left open",
        "servo_daemon/learning/refresh/refresh.py",
        "if distance**2 <= GATE:",
        "if distance**2 <= 1e9 * GATE:",
        REFRESH,
    ),
    Named(
        "a refresh that is not proven enters",
        "servo_daemon/learning/refresh/refresh.py",
        "if not self._challenge.trusted:",
        "if False:",
        REFRESH,
    ),
    Named(
        "a refresh enters a filter that knows better",
        "servo_daemon/learning/refresh/refresh.py",
        "return not knows_better,",
        "return True,",
        REFRESH,
    ),
    Named(
        "the regression's windows 100 times as long",
        "servo_daemon/regression/rls.py",
        "self._n, self._spans_s = n, tuple(spans_s)",
        "self._n, self._spans_s = n, tuple(100.0 * s for s in spans_s)",
        REGRESSION,
    ),
    Named(
        "what a window leaves of its rows is all taken for noise",
        "servo_daemon/regression/rls_fit.py",
        "return max(0.0, fit.left - min(by_noise, told))",
        "return 0.0",
        REGRESSION,
    ),
    Named(
        "what the newest rows say against the regression is ignored",
        "servo_daemon/regression/rls.py",
        "covariance = fit.inverse * own + fits[0].inverse * changed",
        "covariance = fit.inverse * own",
        REGRESSION,
    ),
    Named(
        "a value is held for ever on a motion that shows it",
        "servo_daemon/tracking/validity/fusion.py",
        "if trusted.unconfirmed_s > hold_s:",
        "if False:",
        HELD,
    ),
    Named(
        "a value is held against the running filter",
        "servo_daemon/tracking/validity/fusion.py",
        "> EXCLUDED_STDS * math.hypot(trusted.std, present[1])",
        "> 1e9 * math.hypot(trusted.std, present[1])",
        HELD,
    ),
    Named(
        "the regression overrules a filter that is white and calm",
        "servo_daemon/tracking/validity/confirmation.py",
        "confirms(value, spread, values[name]) or calm_s > found.span_s",
        "confirms(value, spread, values[name])",
        JUDGE,
    ),
    Named(
        "a step of a motor that was never explained is named",
        "servo_daemon/tracking/changes/jumps.py",
        "self.calm and explained, self._usual",
        "self.calm, self._usual",
        JUDGE,
    ),
    Named(
        "gain: scored on the part that was fitted",
        "servo_daemon/diagnosis/trial/trial.py",
        "return self.scored(self.split.measuring)",
        "return self.scored(TRAIN)",
        GAIN,
    ),
    Named(
        "gain: the models are fitted to the part that measures",
        "servo_daemon/diagnosis/verdict/gain.py",
        "data, chosen, parts = selection.data, selection.chosen, selection.data.split.before_measuring",
        "data, chosen, parts = selection.data, selection.chosen, (0, 1, 2)",
        GAIN,
    ),
    Named(
        "gain: errors instead of their squares",
        "servo_daemon/diagnosis/trial/compare.py",
        "b, w, g, n = (x.mean_square(weights) for x in (base, worse, better, floor))",
        "b, w, g, n = (x.mean_square(weights) ** 0.5 for x in (base, worse, better, floor))",
        GAIN,
    ),
    Named(
        "gain: no noise floor",
        "servo_daemon/diagnosis/trial/compare.py",
        "return w - g, b - n",
        "return w - g, b - 0.0 * n",
        GAIN,
    ),
)
