"""Mechanisms of the live estimator, each switched off: `make mutants` says which test fails without it."""

from __future__ import annotations

from collections.abc import Sequence

from tests.mutants.named import Named

_TRACKER = (
    "tests/unit/tracking/test_*.py",
    "tests/unit/pipeline/test_two_witnesses.py",
    "tests/recovery/test_tracking_*.py",
    "tests/recovery/test_tracking.py",
)
#: A motor whose winding settles between two samples.
_SETTLES = ("tests/recovery/test_tracking.py::test_follows_linear_ageing_with_honest_intervals[re40-prbs]",)
_PACKAGE = "servo_daemon/tracking/"


def _off(name: str, file: str, old: str, new: str, first: tuple[str, ...] = ()) -> Named:
    """Args: first: the tests most likely to notice."""
    return Named(name, _PACKAGE + file, old, new, (*first, *_TRACKER))


def _gate(reason: str, function: str) -> Named:
    return _off(
        f"gate: {reason}", "validity/gates.py", f", {function}),", ", lambda e, q: np.zeros_like(q)),",
        ("tests/unit/tracking/test_gates.py",),
    )  # fmt: skip


MECHANISMS: Sequence[Named] = (
    _off(
        "the sensors' noise is not learned",
        "noise/watch.py",
        "self._channel[name] = noise.adapted(self._channel[name], s.excess, span_s, self._updates[name], nis)",
        "pass",
    ),
    _off(
        "a level of a slow drive that is far too large falls as slowly as any",
        "noise/levels.py",
        "if nis < _FAR_NIS and update > _SETTLED_UPDATES:",
        "if False:",
    ),
    _off(
        "process noise does not rise",
        "noise/levels.py",
        "            return ProcessNoise(min(self.factor * _RISE, FACTOR_MOST))",
        "            return self",
    ),
    _off(
        "a torque that was raised too far does not recede",
        "noise/watch.py",
        "self._too_much = raised and s.nis < noise.NIS_LOW",
        "self._too_much = False",
        ("tests/unit/test_contributing.py",),
    ),
    _off(
        "what moves the current is not told by the shaft",
        "noise/watch.py",
        "follow = s.correlation + self._cross_weight() * self._crossed",
        "follow = s.correlation",
        _SETTLES,
    ),
    _off(
        "the voltage's noise is not steered",
        "noise/watch.py",
        "follow = s.correlation + self._cross_weight() * self._crossed",
        "follow = None",
        _SETTLES,
    ),
    _off(
        "the shaft's word weighs no more where the winding settles",
        "noise/watch.py",
        "return _CROSS_WEIGHT + (_CROSS_WEIGHT_SETTLED - _CROSS_WEIGHT) * self.settled**2",
        "return _CROSS_WEIGHT",
        (
            "tests/recovery/test_tracking_honesty.py::test_the_winding_is_right_where_the_shaft_s_balance_does_not_close[re40-pick_and_place]",
        ),
    ),
    _off(
        "a slow drive's ticks are not pooled",
        "noise/watch.py",
        "if s.count < noise.FEWEST_TO_LEARN:",
        "if s.count < 1:",
    ),
    _off("a slow drive's noise is not learned anew", "noise/watch.py", "        if self._pool:", "        if False:"),
    _off("the first samples' noise is all the sensor's", "noise/watch.py", "if var < first.var:", "if False:"),
    _off(
        "what the shaft's balance leaves is not expected",
        "noise/watch.py",
        "if factor > self._of(name).factor and not self._too_much:",
        "if False:",
    ),
    _off(
        "what the armature's balance leaves is not expected",
        "noise/watch.py",
        'if var / noise.input_variance(input_rms, input_lsb) > self._of("current_A").factor:',
        "if False:",
    ),
    _off(
        "a current's noise moves no shaft",
        "noise/setting.py",
        "return flows * (R * self._watch.settled) ** 2 * (1.0 - slow)",
        "return 0.0",
    ),
    _off(
        "what no sample of a slow torque shows is not expected",
        "noise/setting.py",
        "unexplained = max(unexplained, size**2 * self._signal_scales.unseen_square * sampling.period_s)",
        "pass",
    ),
    _off(
        "the voltage's steps leave nothing of L open",
        "noise/setting.py",
        'return self._quantised.inductance_std(period_s, self._value) if "L" in self._value else 0.0',
        "return 0.0",
    ),
    _off(
        "raised process noise is white",
        "noise/watch.py",
        "self.white = bool(correlation < out and unexplained < limit)",
        "self.white = bool(correlation < out)",
    ),
    _off(
        "the first samples are not re-linearised",
        "supervision.py",
        "self._relinearisation.begin(start, trusted=sure)",
        "self._relinearisation.begin(start, trusted=True)",
    ),
    _off(
        "… not where a value has jumped",
        "restart/relinearisation.py",
        "if not self._due and not self._has_moved():",
        "if not self._due:",
    ),
    _off(
        "no start by maximum likelihood",
        "supervision.py",
        "self._likelihood_restart.begin(asked=not sure)",
        "self._likelihood_restart.begin(asked=False)",
    ),
    _off("… it is cross-checked all the same", "supervision.py", "self.validity.waive_cross_check()", "pass"),
    _off(
        "a filter that has diverged goes on",
        "restart/divergence.py",
        "return self.suspicious_ticks >= _DIVERGED_TICKS and well_known(self._rls.estimate(), self._core)",
        "return False",
    ),
    _off(
        "a filter that could begin better goes on",
        "supervision.py",
        "begins_again=fresh and self._divergence.could_begin_better(self.ticks)",
        "begins_again=False",
    ),
    _off(
        "a start that was guessed is not taken for less",
        "supervision.py",
        "if self.validity.begins_to_follow and self._guessed:",
        "if False:",
    ),
    _off("a frozen sensor is searched for a step", "supervision.py", "        if ended.alike:", "        if False:"),
    _off(
        "an unexplained tick is learned from",
        "changes/actions.py",
        'if action == "undo" and self._before is not None:',
        "if False:",
    ),
    _off(
        "no step is searched for",
        "changes/actions.py",
        "return (action, []) if found is None else",
        "return (action, []) if True else",
    ),
    _off(
        "a step need not stand out of how values wander",
        "changes/actions.py",
        "least = max(_NOTICEABLE * scale, _WANDERS * float(self._wander.spread(len(after))[k]))",
        "least = _NOTICEABLE * scale",
    ),
    _off("the watch for steps never rests", "changes/jumps.py", "        if self._rest > 0:", "        if False:"),
    _off("unexplained ticks are never the rule", "changes/jumps.py", "return self._usual < _RULE", "return True"),
    _gate("what happens between two samples", "blind_to_inductance"),
    _gate("no regression confirms what is not explained", "unexplained"),
    _gate("unexcited", "unexcited"),
    _gate("unconfirmed", "unconfirmed"),
    _gate("vague", "vague"),
    _gate("lost", "lost"),
    _gate("unclaimable", "unclaimable"),
    _gate("without a second opinion", "without_second_opinion"),
    _gate("between two lags", "between_two_lags"),
    _gate("resistance without torque constant", "resistance_without_torque_constant"),
    _gate("inductance without resistance", "inductance_without_resistance"),
    _off(
        "no regression has to speak for a start",
        "validity/confirmation.py",
        "if not tick.settled or self.cross_check.done:",
        "if True:",
    ),
    _off(
        "a model that lacks something is known as exactly as any",
        "validity/mismatch.py",
        "discrepancy = 0.0 if tick.white else _DISCREPANCY_STD",
        "discrepancy = 0.0",
    ),
    _off(
        "… L too",
        "validity/mismatch.py",
        'if name == "L" and not tick.white:',
        "if False:",
    ),
    _off(
        "what the balances leave open is not told",
        "validity/mismatch.py",
        "known = (found.get(name, 0.0), self._dry",
        "known = (0.0, self._dry",
    ),
    _off(
        "what the balances say instead is not told",
        "validity/mismatch.py",
        "error, var = said.get(name, (0.0, 0.0))",
        "error, var = (0.0, 0.0)",
    ),
    _off(
        "a friction that is hidden leaves nothing open",
        "validity/mismatch.py",
        "self._dry = self._dry if dry is None else dry",
        "self._dry = {}",
    ),
    _off("an effect's parameters are as sure as the filter", "validity/mismatch.py", "self._doubt_effects()", "pass"),
    _off(
        "what K leaves open is not left open of the shaft",
        "validity/mismatch.py",
        "        self._carry_over_torque()\n",
        "",
    ),
    _off(
        "the armature's regression has no say",
        "validity/mismatch.py",
        "self._left_by_steps(tick), self._by_armature(values, tick)",
        "self._left_by_steps(tick), {}",
    ),
    _off(
        "the balances need not have judged a start",
        "validity/validity_gate.py",
        "settled=settled and not self._unjudged,",
        "settled=settled,",
    ),
    _off(
        "the regressions do not follow a lag",
        "validity/validity_gate.py",
        'self._rls.follow_lag(values["t_lag"])',
        "pass",
    ),
    _off(
        "what is not shown stays as sure as it was",
        "validity/validity_gate.py",
        "walk * (shown | (std < self._idle_std))",
        "walk * shown",
    ),
    _off(
        "the instrumental trajectory is left as late as it was taken",
        "validity/validity_gate.py",
        "limit = _LED_ASTRAY_STD if self._follows else QUALIFIED",
        "limit = QUALIFIED",
    ),
    _off(
        "the regressions take spikes before the filter runs",
        "plant_tracker.py",
        "self._rls.update(self._signal_scales.without_spikes(stretch), noise_var)",
        "self._rls.update(stretch, noise_var)",
    ),
    _off(
        "the regressions take what the filter does not believe",
        "supervision.py",
        "return replace(stretch, usable=stretch.usable & ~outliers)",
        "return stretch",
    ),
    _off(
        "the regressions take what is undone",
        "supervision.py",
        "return replace(stretch, usable=np.zeros_like(stretch.usable))",
        "return stretch",
    ),
)
