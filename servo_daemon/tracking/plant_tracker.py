"""One drive's estimators together: RLS from the first sample, the EKF once it can start, and the watch over both.

Fed segments of samples (`take`, any size) and ticks (`close_tick`, always the same samples whatever the segments were);
only ticks change anything but the filter's own recursion.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from servo_daemon.conditioning.layout import Stretches
from servo_daemon.kalman.ekf import Ekf
from servo_daemon.kalman.gaussian import Gaussian
from servo_daemon.parameters import Parameter
from servo_daemon.plant.build import PlantModel
from servo_daemon.regression.estimate import RegressionEstimate
from servo_daemon.regression.motor_rls import MotorRls
from servo_daemon.regression.sampling import Sampling
from servo_daemon.regression.stretch import Stretch
from servo_daemon.samples import F64, SampleBlock
from servo_daemon.tracking.calm import CalmTicks, Taken
from servo_daemon.tracking.changes import jumps
from servo_daemon.tracking.changes.actions import JumpActions
from servo_daemon.tracking.changes.search import JumpSearch
from servo_daemon.tracking.noise.setting import NoiseSetting
from servo_daemon.tracking.notifications import Notifications
from servo_daemon.tracking.plan.parameter_masks import make_masks
from servo_daemon.tracking.plan.settings import Message, Resolutions, TrackerSettings
from servo_daemon.tracking.plan.signals import SignalPlan, plan_signals
from servo_daemon.tracking.prior_transfer import PriorTransfer, trusted_mask
from servo_daemon.tracking.restart.divergence import DivergenceMonitor
from servo_daemon.tracking.restart.maximum_likelihood import MaximumLikelihoodRestart
from servo_daemon.tracking.restart.relinearisation import FOUND_TICK, BatchRelinearisation
from servo_daemon.tracking.samples.filtering import Filtering
from servo_daemon.tracking.samples.signal_scales import SignalScales
from servo_daemon.tracking.start.starter import Start, Starter
from servo_daemon.tracking.tracker import Tracker
from servo_daemon.tracking.validity.excitation import Excitation
from servo_daemon.tracking.validity.fusion import Trusted
from servo_daemon.tracking.validity.gates import Qualification
from servo_daemon.tracking.validity.tick import Tick
from servo_daemon.tracking.validity.validity_gate import ValidityGate

#: A saved state may be of yesterday's temperature and load: added 1 σ.
_SAVED_STD = 0.03
#: After so many ticks, no sooner than anything can be published, jumps are looked for; a Cholesky factor is tried this
#: often.
_TICKS_TO_WATCH, _SOUNDNESS_EVERY = 8, 20
#: From then on a filter that took over from another may speak for the drive.
_TICKS_TO_SETTLE = 10
#: A step is one of a motor that the model has explained for so long before, s (a filter that has just started on data
#: with 30 % of dry friction that its model lacks looked white for 2 s, and then "K stepped").
_CALM_S = 2.5
#: When the filter begins to use its instrumental trajectory, the covariance is widened once, 1 σ over the scales.
_SECOND_START_STD = 0.1


class PlantTracker(Tracker):
    """The estimators of one drive whose signals drive a plant.

    Args:
        plant: the plan's.
        prior: what a saved state knows of all that is estimated, or of some of it.
    """

    def __init__(
        self,
        channels: tuple[str, ...],
        settings: TrackerSettings,
        resolutions: Resolutions,
        plan: SignalPlan,
        plant: PlantModel,
        prior: Gaussian | None = None,
    ) -> None:
        super().__init__(channels, settings, resolutions, plan)
        self._plant = plant
        usable = prior is not None and set(plan.held) <= set(prior.names) <= {*plan.free, *plan.held}
        self._prior = prior if usable else None
        self._transfer: PriorTransfer | None = None
        loop = None
        if settings.engine == "filterpy":
            from servo_daemon.kalman.filterpy_ekf import FilterpyLoop

            loop = FilterpyLoop(plant, plan.measured, settings.mean_current)
        self._ekf = Ekf(plant, plan.measured, loop, mean_input=settings.mean_current)
        sees_angle = "position_rad" in plan.measured
        self._rls = MotorRls(plant, plan.known, plan.biases, self.nominal, sees_angle=sees_angle)
        self._masks = make_masks(plan, settings, self._rls.in_regression)
        self._validity = ValidityGate(self._masks, self._ekf, self._rls)
        self._notifications = Notifications(self._masks, self._ekf, self.watch, lambda: self.excitation.scales)
        self._stretches = Stretches()
        self._starter = Starter(plan, self.nominal, self._rls.names)
        self._signal_scales = SignalScales(plant)
        self._noise = NoiseSetting(self._masks, self._ekf, self._rls, self.watch, self._signal_scales)
        self._filtering = Filtering(self._ekf, self._signal_scales)
        search = JumpSearch(self._masks, self._ekf, self._filtering, self._validity, self.watch)
        self._jumps = JumpActions(self._masks, self._ekf, self._rls, self._validity, search)
        self._relinearisation = BatchRelinearisation(
            self._masks, self._ekf, self._filtering, self._validity, self._noise
        )
        self._likelihood_restart = MaximumLikelihoodRestart(self._masks, self._ekf, self._filtering, self._noise)
        self._divergence = DivergenceMonitor(self._masks, self._ekf, self._rls, self._validity, self.watch)
        self._together = CalmTicks(self._ekf, self.watch, self._jumps, self._signal_scales)
        self._ticks = 0

    @property
    def ekf(self) -> Ekf:
        return self._ekf

    @property
    def rls(self) -> MotorRls:
        return self._rls

    def begin_with(self, transfer: PriorTransfer) -> None:
        """Begin with what another model's tracker knew; before the first samples."""
        self._prior, self._transfer = transfer.known if transfer.known.names else None, transfer
        self.first_s = transfer.origin_s

    @property
    def settled(self) -> bool:
        return self._ekf.started and self._ticks > _TICKS_TO_SETTLE

    @property
    def is_calm(self) -> bool:
        return self._together.calm

    @property
    def waits(self) -> bool:
        return self._together.waiting > 0

    @property
    def excitation(self) -> Excitation:
        """What the motion says about each parameter."""
        return self._validity.excitation

    @property
    def qualification(self) -> Qualification:
        """Which parameters are known."""
        return self._validity.qualification

    @property
    def explained(self) -> bool:
        return self._notifications.explained

    @property
    def examines_jump(self) -> bool:
        return self._jumps.is_open

    @property
    def jump_is_sudden(self) -> bool:
        return self._jumps.watch.sudden

    def assimilate(self, known: Gaussian, widen_std: F64) -> None:
        """Take what is known from elsewhere as a measurement of some of the parameters. What was being examined as a
        jump is not examined any more: what it would go back to is put in doubt as well.

        Args:
            known: of coordinates by name.
            widen_std: added to the filter's own 1 σ of these before; zeros: nothing.
        """
        at = np.array([self._masks.names.index(name) for name in known.names])
        order = np.argsort(at)
        if widen_std.any():
            var = np.zeros(len(self._masks.names))
            var[at] = np.square(widen_std)
            self._ekf.widen_parameters(var)
        self._ekf.take_in(at[order], known.mean[order], known.covariance[np.ix_(order, order)])
        if self.examines_jump and widen_std.any():
            self._jumps.reset()
        self._jumps.search.clear()

    @property
    def _prior_is_whole(self) -> bool:
        """What was known before this filter began is of all parameters."""
        return self._prior is not None and {*self.plan.free} <= {*self._prior.names}

    @property
    def position_lsb_rad(self) -> float:
        return self._filtering.layout.position_lsb

    def published(self) -> Gaussian | None:
        return self._jumps.published()

    @property
    def winding(self) -> RegressionEstimate | None:
        return self._rls.winding

    def last_known(self, name: str) -> Trusted | None:
        return None if self.last_s is None else self._validity.last_known.of(self._masks.names.index(name), self.last_s)

    @property
    def ages_s(self) -> list[float | None]:
        return [] if self.last_s is None else self._validity.last_known.ages_s(self.last_s)

    @property
    def free(self) -> tuple[Parameter, ...]:
        return tuple(p for p in self._plant.parameters if p.name in self.plan.free)

    def take(self, block: SampleBlock) -> None:
        first, before_s = self._seen_s is None, self.last_s
        super().take(block)
        if first:
            assert self.first_s is not None
            self._filtering.layout.origin_s = self.first_s
        self._filtering.take(block, before_s, self.sample_period_s)

    def close_tick(self, tick: SampleBlock) -> list[Message]:
        if not self._ekf.started:
            stretch, noise_var = self._stretch_of(tick)
            self._rls.update(self._signal_scales.without_spikes(stretch), noise_var)
            return self._try_start(tick)
        taken = self._together.take(tick, self._tick_end_s, self.sample_period_s)
        if taken is None:
            return []
        stretch, noise_var = self._stretch_of(taken.samples)
        self._noise.take(stretch, self.sample_period_s or 0.0)
        return self._watch(stretch, taken, noise_var)

    def _stretch_of(self, tick: SampleBlock) -> tuple[Stretch, Mapping[str, float]]:
        """Samples as the regressions take them, and variances of the measured channels, as far as known before."""
        period_s, before_s = self.sample_period_s, self._tick_end_s  # with which the filter has taken its samples
        super().close_tick(tick)
        assert self.first_s is not None
        # (In the first tick, of which nothing was known before it, gaps are told by its own period.)
        stretch = self._stretches.of(tick, self.first_s, before_s, period_s or self.sample_period_s)
        noise_var = self._noise_var()
        self._signal_scales.take(stretch, self._filtering.layout.position_lsb, noise_var)
        return stretch, noise_var

    def _noise_var(self) -> dict[str, float]:
        """Of the measured channels: as the filter has found it, or what the resolutions alone make of it."""
        if self._ekf.started:
            return self.watch.least_noise_var
        steps = {name: self.resolutions.of(name) for name in self.plan.measured}
        return {name: step**2 / 12.0 for name, step in steps.items() if step is not None}

    def _try_start(self, tick: SampleBlock) -> list[Message]:
        assert self._seen_s is not None
        elapsed = float(tick.time_s[-1]) - self._seen_s
        if self._rls.winding is not None:
            return []  # nothing of the motion to start from: the regression speaks for the winding
        found = self._rls.estimate()
        scales = dict(zip(self._plant.parameter_names, self._signal_scales.scales(self.nominal), strict=True))
        start = self._starter.take(tick, elapsed, self._prior, found, self.resolutions, scales)
        if start is None:
            return []
        self._begin(start)
        source = "the saved state" if self._prior is not None else "regression and nominal values"
        if self._transfer is not None:
            source = "what the filter with another model knew"
        return [("filter_started", f"filter started from {source}", {})]

    def _begin(self, start: Start) -> None:
        self.watch.start(start.noise)
        self._filtering.layout.expect_steps(start.position_lsb, start.input_lsb)
        self._ekf.start(start.parameters, held_input=self._filtering.layout.last_input)
        self._jumps.reset()
        saved = () if self._prior is None else (*self._prior.names, *self.plan.biases)
        trusted = trusted_mask(self._masks.names, self._transfer, saved)
        self._validity.begin(trusted, self._tick_end_s or 0.0)
        self._ticks = 0
        self._together.begin()
        self._filtering.forget_outliers()
        self.excitation.scales = self._noise.begin(start.input_lsb, self._sampling())
        free = self._masks.free
        self._ekf.set_active(free, self._validity.walk(free))
        self._ekf.forget_state(self._filtering.first_state(start.last))
        if self._transfer is not None:
            self.qualification.qualified |= trusted
            self._transfer.hand_states_to(self._ekf)
        sure = self._prior_is_whole or self._transfer is not None
        self._relinearisation.begin(start, trusted=sure)
        self._likelihood_restart.begin(asked=not sure)

    def _watch(self, stretch: Stretch, taken: Taken, noise_var: Mapping[str, float]) -> list[Message]:
        """Noise, whiteness, jumps, excitation, soundness: after each tick of the running filter, or several of them.

        Args:
            noise_var: of the measured channels, as far as it was known before.
        """
        looked_at, self._ticks = self._ticks // _SOUNDNESS_EVERY, self._ticks + taken.ticks
        test = taken.test
        if test is None or (self._ticks // _SOUNDNESS_EVERY > looked_at and not self._ekf.is_sound()):
            return self._restart("its covariance or state is no longer sound")
        period_s = self.sample_period_s or 0.0
        duration_s, last_s = max(period_s * len(taken.samples), 1e-6), max(period_s * taken.last, 1e-6)
        end_s, judged = self._tick_end_s or 0.0, self._ticks > _TICKS_TO_WATCH and stretch.complete
        searched = self._may_search(stretch)
        explained = self._notifications.explained and self._validity.calm_s > _CALM_S
        action, messages = self._jumps.take(test, end_s, explained=explained, judged=judged, searched=searched)
        if messages:  # a step was named
            self._relinearisation.end()
            self._likelihood_restart.end()
        fresh = self._rls.update(self._believed(stretch, action), noise_var, self._sampling(), taken.ticks)
        if action == "learn" and stretch.complete:
            self.watch.learn(taken.statistics, last_s, rests=self._signal_scales.rests)
        sampling = self._sampling()
        if fresh:
            self.excitation.scales = self._noise.rescale(sampling)
            self._noise.learned(self.excitation.rate, sampling.period_s)
        self._noise.set()
        self._validity.update(duration_s, fresh, self._tick(sampling, fresh))
        if self._validity.begins_to_follow and not self._prior_is_whole:
            # What was learned without the instrumental trajectory (from a start that was guessed, partly from the
            # colour of the noise) is taken for less.
            self._ekf.widen_parameters(
                np.where(self._masks.published, np.square(_SECOND_START_STD * self.excitation.scales), 0)
            )
        self._jumps.remember(end_s)
        alike_s = self._stretches.alike("current_A") * period_s
        if self._has_looked_again():
            self._jumps.reset()
            self.watch.learn_anew()
        self._jumps.search.mark()
        known = (self.qualification.qualified | self.excitation.excited)[self._masks.published]
        # (Before that they are of a filter that is still finding its values and noise: they refute no model.)
        seen = self._ticks >= FOUND_TICK and bool(known.any())
        messages += self._notifications.whether_white(seen=seen) + self._notifications.whether_frozen(stretch, alike_s)
        if self._divergence.has_diverged(test.nis):
            messages += self._restart("its innovations do not fit while the regression does")
        elif fresh and self._divergence.could_begin_better(self._ticks):
            self._begin_again()
        eventful = (
            bool(messages) or test.unexplained or not stretch.complete or stretch.gap is not None or alike_s > 0.0
        )
        self._together.rest(self._ticks, eventful=eventful, certain=self._is_certain)
        return messages

    @property
    def _is_certain(self) -> bool:
        """Whether nothing is in doubt or about to change."""
        shown = self._masks.published & self.excitation.excited & ~self.qualification.qualified
        return (
            self._ekf.started
            and not self._relinearisation.is_open
            and not self._likelihood_restart.is_open
            and self._jumps.idle
            and self.explained
            and not np.count_nonzero(shown)
        )

    def _has_looked_again(self) -> bool:
        """Whether the first samples have just been re-linearised, and the filter goes on from what that came to."""
        if self._relinearisation.update(self._ticks, self.watch.white, self.sample_period_s or 0.0):
            return True
        if self._relinearisation.is_open:
            return False
        if not self._likelihood_restart.update(self._ticks, self.excitation.scales, self._divergence):
            return False
        self._validity.begin_anew(follows=True)
        self._validity.waive_cross_check()
        return True

    def _may_search(self, stretch: Stretch) -> bool | None:
        """Whether it may be looked for a parameter that has stepped; None: a sensor is frozen, and an offset would
        explain that best."""
        if self._stretches.alike("current_A"):
            return None
        settled = self._ticks >= FOUND_TICK and not self._relinearisation.is_open
        return settled and stretch.complete and bool((self.qualification.qualified & self._masks.published).any())

    def _believed(self, stretch: Stretch, action: jumps.Action) -> Stretch:
        """What the filter does not believe, the regressions are not told either. Where that is the rule it is the model
        that is not to be believed, and a balance without those samples would close."""
        outliers = self._filtering.take_outliers()
        if action == "undo":
            return replace(stretch, usable=np.zeros_like(stretch.usable))
        if outliers is None or not self._jumps.watch.calm:
            return stretch
        return replace(stretch, usable=stretch.usable & ~outliers)

    def _tick(self, sampling: Sampling, fresh: bool) -> Tick:
        return Tick(
            settled=self._ticks >= _TICKS_TO_WATCH and not self._relinearisation.is_open,
            open=self._jumps.is_open,
            explained=self._jumps.watch.calm,
            white=self.watch.white,
            inductance_std=self._noise.inductance_std(sampling.period_s) if fresh else 0.0,
            sampling=sampling,
            end_s=self._tick_end_s or 0.0,
        )

    def _sampling(self) -> Sampling:
        signals = self._signal_scales
        return Sampling(
            self._noise_var(), signals.current_step_square, self.sample_period_s or 0.0, signals.samples_per_count
        )

    def _restart(self, why: str) -> list[Message]:
        """Something went wrong, and whoever watches the daemon is to know of it."""
        self._begin_again()
        self.restarts += 1
        return [("filter_restarted", f"filter restarted: {why}", {"restarts": self.restarts})]

    def _begin_again(self) -> None:
        """Back to the start: the next tick begins again from the regression."""
        self._ekf.reset()
        self._starter.reset()
        self._prior = self._transfer = None
        self._divergence.reset()
        self._validity.reset()

    def worth_keeping(self) -> Gaussian | None:
        if not self._ekf.started or not self._ekf.is_sound() or self._divergence.suspicious_ticks:
            return None
        known = self._masks.published & self.qualification.qualified
        if not self._jumps.quiet or not known.any():
            return None
        g, kept = self._ekf.estimate(), np.flatnonzero(known | ~self._masks.free)
        covariance = g.covariance + np.diag(np.square(_SAVED_STD * self.excitation.scales))
        return Gaussian(tuple(g.names[k] for k in kept), g.mean[kept], covariance[np.ix_(kept, kept)])


def make_tracker(
    channels: tuple[str, ...], settings: TrackerSettings, resolutions: Resolutions, prior: Gaussian | None = None
) -> Tracker:
    """The tracker of a drive with these channels; a `PlantTracker` where a model can be run.

    Args:
        prior: what a saved state knows; left out where it is of other parameters.
    """
    plan = plan_signals(channels, settings.effects, dict(settings.nominal or {}))
    if plan.plant is None:
        return Tracker(channels, settings, resolutions, plan)
    return PlantTracker(channels, settings, resolutions, plan, plan.plant, prior)
