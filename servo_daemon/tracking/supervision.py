"""The watch over one running filter: noise, whiteness, jumps, excitation and soundness, after each tick."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from servo_daemon.kalman.ekf import Ekf
from servo_daemon.regression.motor_rls import MotorRls
from servo_daemon.regression.sampling import Sampling
from servo_daemon.regression.stretch import Stretch
from servo_daemon.tracking.calm import CalmTicks, Taken
from servo_daemon.tracking.changes import jumps
from servo_daemon.tracking.changes.actions import JumpActions
from servo_daemon.tracking.changes.search import JumpSearch
from servo_daemon.tracking.noise.setting import NoiseSetting
from servo_daemon.tracking.noise.watch import InnovationTest, InnovationWatch
from servo_daemon.tracking.notifications import Notifications
from servo_daemon.tracking.plan.parameter_masks import Mask, ParameterMasks
from servo_daemon.tracking.plan.settings import Message
from servo_daemon.tracking.restart.divergence import DivergenceMonitor
from servo_daemon.tracking.restart.maximum_likelihood import MaximumLikelihoodRestart
from servo_daemon.tracking.restart.relinearisation import FOUND_TICK, BatchRelinearisation
from servo_daemon.tracking.samples.filtering import Filtering
from servo_daemon.tracking.samples.signal_scales import SignalScales
from servo_daemon.tracking.start.starter import Start
from servo_daemon.tracking.validity.tick import Tick
from servo_daemon.tracking.validity.validity_gate import ValidityGate

#: After so many ticks, no sooner than anything can be published, jumps are looked for; a Cholesky factor is tried this
#: often.
_TICKS_TO_WATCH, _SOUNDNESS_EVERY = 8, 20
#: A step is one of a motor that the model has explained for so long before, s (a filter that has just started on data
#: with 30 % of dry friction that its model lacks looked white for 2 s, and then "K stepped").
_CALM_S = 2.5
#: When the filter begins to use its instrumental trajectory, the covariance is widened once, 1 σ over the scales.
#: (`test_spikes_of_the_current_bend_no_inductance` and `test_found_beside_every_motor` fail without it.)
_SECOND_START_STD = 0.1


@dataclass(frozen=True, slots=True)
class Ended:
    """Samples that have been filtered, as the regressions take them.

    Attributes:
        stretch: the samples.
        noise_var: of the measured channels, as far as it was known before.
        end_s: device time.
        period_s: usual distance of two samples.
        alike: for how many samples the current has shown one value; 0 while it flickers.
    """

    stretch: Stretch
    noise_var: Mapping[str, float]
    end_s: float
    period_s: float
    alike: int


@dataclass(frozen=True, slots=True)
class Judgement:
    """What follows from the ticks that have ended.

    Attributes:
        messages: to be told.
        restart: the filter has failed, and must begin again: why.
        begins_again: it had better begin again, from what the regression knows by now.
    """

    messages: list[Message] = field(default_factory=list)
    restart: str | None = None
    begins_again: bool = False


class FilterSupervision:
    """Supervises the filter of one drive while it runs.

    Attributes:
        validity: which parameters are excited, may move and are known.
        jumps: what is done about sudden changes.
        notifications: what has been told.
        ticks: number of the running filter's.
    """

    def __init__(
        self,
        masks: ParameterMasks,
        ekf: Ekf,
        rls: MotorRls,
        watch: InnovationWatch,
        filtering: Filtering,
        signal_scales: SignalScales,
    ) -> None:
        self._masks, self._ekf, self._rls, self._watch = masks, ekf, rls, watch
        self._filtering = filtering
        self.validity = ValidityGate(masks, ekf, rls)
        self.notifications = Notifications(masks, ekf, watch, lambda: self.validity.excitation.scales)
        self._noise = NoiseSetting(masks, ekf, rls, watch, signal_scales)
        search = JumpSearch(masks, ekf, filtering, self.validity, watch)
        self.jumps = JumpActions(masks, ekf, rls, self.validity, search)
        self._relinearisation = BatchRelinearisation(masks, ekf, filtering, self.validity, self._noise)
        self._likelihood_restart = MaximumLikelihoodRestart(masks, ekf, filtering, self._noise)
        self._divergence = DivergenceMonitor(masks, ekf, rls, self.validity, watch)
        self.together = CalmTicks(ekf, watch, self.jumps)
        self._guessed = False
        self.ticks = 0

    @property
    def suspicious(self) -> bool:
        """Whether the last innovations were far too large."""
        return self._divergence.suspicious_ticks > 0

    def begin(self, start: Start, trusted: Mask, end_s: float, period_s: float, *, whole: bool, sure: bool) -> None:
        """A filter has started.

        Args:
            trusted: parameters that are known from before, shape (n,).
            end_s: device time.
            period_s: usual distance of two samples.
            whole: all parameters were known before.
            sure: what was known before is not to be found anew from the first samples.
        """
        self.ticks, self._guessed = 0, not whole
        self.jumps.reset()
        self.validity.begin(trusted, end_s)
        self.together.begin()
        self._filtering.forget_outliers()
        self.validity.excitation.scales = self._noise.begin(start.input_lsb, self._noise.sampling(period_s))
        free = self._masks.free
        self._ekf.set_active(free, self.validity.walk(free))
        self._relinearisation.begin(start, trusted=sure)
        self._likelihood_restart.begin(asked=not sure)

    def reset(self) -> None:
        """The filter is about to begin again."""
        self._divergence.reset()
        self.validity.reset()

    def judge(self, taken: Taken, ended: Ended) -> Judgement:
        """Judge ticks of the running filter, one or several together.

        Args:
            taken: the ticks.
            ended: their samples.
        """
        self._noise.take(ended.stretch, ended.period_s)
        looked_at, self.ticks = self.ticks // _SOUNDNESS_EVERY, self.ticks + taken.ticks
        test = taken.test
        if test is None or (self.ticks // _SOUNDNESS_EVERY > looked_at and not self._ekf.is_sound()):
            return Judgement(restart="its covariance or state is no longer sound")
        action, messages = self._look_for_jump(test, ended)
        fresh = self._learn(taken, ended, action)
        self.jumps.remember(ended.end_s)
        if self._has_looked_again(ended.period_s):
            self.jumps.reset()
            self._watch.learn_anew()
        self.jumps.search.mark()
        judgement = self._judged(test, messages + self._noticed(ended), fresh=fresh)
        self.together.rest(
            self.ticks, eventful=_is_eventful(judgement, test, ended), certain=self._is_certain(judgement)
        )
        return judgement

    def _look_for_jump(self, test: InnovationTest, ended: Ended) -> tuple[jumps.Action, list[Message]]:
        """What is done with the samples, and what is to be told of a parameter that has stepped."""
        explained = self.notifications.explained and self.validity.calm_s > _CALM_S
        judged, searched = self.ticks > _TICKS_TO_WATCH and ended.stretch.complete, self._may_search(ended)
        action, messages = self.jumps.take(test, ended.end_s, explained=explained, judged=judged, searched=searched)
        if messages:
            self._relinearisation.end()
            self._likelihood_restart.end()
        return action, messages

    def _may_search(self, ended: Ended) -> bool | None:
        """Whether it may be looked for a parameter that has stepped; None: a sensor is frozen, and an offset would
        explain that best."""
        if ended.alike:
            return None
        settled = self.ticks >= FOUND_TICK and not self._relinearisation.is_open
        known = self.validity.qualification.qualified & self._masks.published
        return settled and ended.stretch.complete and bool(known.any())

    def _learn(self, taken: Taken, ended: Ended, action: jumps.Action) -> bool:
        """Let regressions, noise levels and what is known of the parameters follow the samples. Returns whether the
        regressions have been worked off."""
        period_s, excitation = ended.period_s, self.validity.excitation
        duration_s, last_s = max(period_s * len(taken.samples), 1e-6), max(period_s * taken.last, 1e-6)
        believed = self._believed(ended.stretch, action)
        fresh = self._rls.update(believed, ended.noise_var, self._noise.sampling(period_s), taken.ticks)
        if action == "learn" and ended.stretch.complete:
            self._watch.learn(taken.statistics, last_s)
        sampling = self._noise.sampling(period_s)
        if fresh:
            excitation.scales = self._noise.rescale(sampling)
        self._noise.set()
        self.validity.update(duration_s, fresh, self._tick(sampling, ended.end_s, fresh=fresh))
        if self.validity.begins_to_follow and self._guessed:
            # What was learned without the instrumental trajectory (from a start that was guessed, partly from the
            # colour of the noise) is taken for less.
            self._ekf.widen_parameters(
                np.where(self._masks.published, np.square(_SECOND_START_STD * excitation.scales), 0)
            )
        return fresh

    def _believed(self, stretch: Stretch, action: jumps.Action) -> Stretch:
        """What the filter does not believe, the regressions are not told either. Where that is the rule it is the model
        that is not to be believed, and a balance without those samples would close."""
        outliers = self._filtering.take_outliers()
        if action == "undo":
            return replace(stretch, usable=np.zeros_like(stretch.usable))
        if outliers is None or not self.jumps.watch.calm:
            return stretch
        return replace(stretch, usable=stretch.usable & ~outliers)

    def _tick(self, sampling: Sampling, end_s: float, *, fresh: bool) -> Tick:
        return Tick(
            settled=self.ticks >= _TICKS_TO_WATCH and not self._relinearisation.is_open,
            open=self.jumps.is_open,
            explained=self.jumps.watch.calm,
            white=self._watch.white,
            inductance_std=self._noise.inductance_std(sampling.period_s) if fresh else 0.0,
            sampling=sampling,
            end_s=end_s,
        )

    def _has_looked_again(self, period_s: float) -> bool:
        """Whether the first samples have just been re-linearised, and the filter goes on from what that came to."""
        if self._relinearisation.update(self.ticks, self._watch.white, period_s):
            return True
        if not self._relinearisation.is_over:
            return False
        if not self._likelihood_restart.update(self.ticks, self.validity.excitation.scales, self._divergence):
            return False
        self.validity.begin_anew(follows=True)
        self.validity.waive_cross_check()
        return True

    def _noticed(self, ended: Ended) -> list[Message]:
        known = (self.validity.qualification.qualified | self.validity.excitation.excited)[self._masks.published]
        # (Before that they are of a filter that is still finding its values and noise: they refute no model.)
        seen = self.ticks >= FOUND_TICK and self._relinearisation.is_over and bool(known.any())
        frozen = self.notifications.whether_frozen(ended.stretch, ended.alike * ended.period_s)
        return self.notifications.whether_white(seen=seen) + frozen

    def _judged(self, test: InnovationTest, messages: list[Message], *, fresh: bool) -> Judgement:
        """With whether the filter has to begin again."""
        if self._divergence.has_diverged(test.nis):
            return Judgement(messages, "its innovations do not fit while the regression does")
        return Judgement(messages, begins_again=fresh and self._divergence.could_begin_better(self.ticks))

    def _is_certain(self, judgement: Judgement) -> bool:
        """Whether nothing is in doubt or about to change."""
        qualified, excited = self.validity.qualification.qualified, self.validity.excitation.excited
        shown = self._masks.published & excited & ~qualified
        return (
            judgement.restart is None
            and not judgement.begins_again
            and not self._relinearisation.is_open
            and not self._likelihood_restart.is_open
            and self.jumps.idle
            and self.notifications.explained
            and not np.count_nonzero(shown)
        )


def _is_eventful(judgement: Judgement, test: InnovationTest, ended: Ended) -> bool:
    """Whether there was something to the ticks."""
    told = bool(judgement.messages) or judgement.restart is not None
    missing = not ended.stretch.complete or ended.stretch.gap is not None
    return told or test.unexplained or missing or ended.alike > 0
