"""One drive's estimators together: RLS from the first sample, the EKF once it can start, and the watch over both.

Fed segments of samples (`take`, any size) and ticks (`close_tick`, always the same samples whatever the segments were);
only ticks change anything but the filter's own recursion.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from servo_daemon.conditioning.layout import Stretches
from servo_daemon.kalman.ekf import Ekf, Loop
from servo_daemon.kalman.gaussian import Gaussian
from servo_daemon.parameters import Parameter
from servo_daemon.plant.build import PlantModel
from servo_daemon.regression.estimate import RegressionEstimate
from servo_daemon.regression.motor_rls import MotorRls
from servo_daemon.regression.stretch import Stretch
from servo_daemon.samples import F64, SampleBlock
from servo_daemon.tracking.plan.parameter_masks import make_masks
from servo_daemon.tracking.plan.settings import Message, Resolutions, TrackerSettings
from servo_daemon.tracking.plan.signals import SignalPlan, plan_signals
from servo_daemon.tracking.prior_transfer import PriorTransfer, trusted_mask
from servo_daemon.tracking.samples.filtering import Filtering
from servo_daemon.tracking.samples.signal_scales import SignalScales
from servo_daemon.tracking.start.starter import Start, Starter
from servo_daemon.tracking.supervision import Ended, FilterSupervision
from servo_daemon.tracking.tracker import Tracker
from servo_daemon.tracking.validity.excitation import Excitation
from servo_daemon.tracking.validity.fusion import Trusted
from servo_daemon.tracking.validity.gates import Qualification

#: A saved state may be of yesterday's temperature and load: added 1 σ (copper: 8 K at 0.39 %/K).
_SAVED_STD = 0.03
#: From then on a filter that took over from another may speak for the drive (a second; chosen; half and twice move no
#: tracking figure).
_TICKS_TO_SETTLE = 10


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
        prior: Gaussian | None,
    ) -> None:
        super().__init__(channels, settings, resolutions, plan)
        self._plant = plant
        usable = prior is not None and set(plan.held) <= set(prior.names) <= {*plan.free, *plan.held}
        self._prior = prior if usable else None
        self._transfer: PriorTransfer | None = None
        self._ekf = Ekf(plant, plan.measured, self._engine(plant), mean_input=settings.mean_current)
        sees_angle = "position_rad" in plan.measured
        self._rls = MotorRls(plant, plan.known, plan.biases, self.nominal, sees_angle=sees_angle)
        self._masks = make_masks(plan, settings, self._rls.in_regression)
        self._stretches = Stretches()
        self._starter = Starter(plan, self.nominal, self._rls.names)
        self._signal_scales = SignalScales(plant)
        self._filtering = Filtering(self._ekf, self._signal_scales)
        self._supervision = FilterSupervision(
            self._masks, self._ekf, self._rls, self.watch, self._filtering, self._signal_scales
        )

    def _engine(self, plant: PlantModel) -> Loop | None:
        if self.settings.engine != "filterpy":
            return None
        from servo_daemon.kalman.filterpy_ekf import FilterpyLoop

        return FilterpyLoop(plant, self.plan.measured, self.settings.mean_current)

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
        return self._ekf.started and self._supervision.ticks > _TICKS_TO_SETTLE

    @property
    def is_calm(self) -> bool:
        return self._supervision.together.calm

    @property
    def waits(self) -> bool:
        return self._supervision.together.waiting > 0

    @property
    def excitation(self) -> Excitation:
        """What the motion says about each parameter."""
        return self._supervision.validity.excitation

    @property
    def qualification(self) -> Qualification:
        """Which parameters are known."""
        return self._supervision.validity.qualification

    @property
    def explained(self) -> bool:
        return self._supervision.notifications.explained

    @property
    def examines_jump(self) -> bool:
        return self._supervision.jumps.is_open

    @property
    def jump_is_sudden(self) -> bool:
        return self._supervision.jumps.watch.sudden

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
        jumps = self._supervision.jumps
        if self.examines_jump and widen_std.any():
            jumps.reset()
        jumps.search.clear()

    @property
    def position_lsb_rad(self) -> float:
        return self._filtering.layout.position_lsb

    def published(self) -> Gaussian | None:
        return self._supervision.jumps.published()

    @property
    def winding(self) -> RegressionEstimate | None:
        return self._rls.winding

    @property
    def stands(self) -> bool:
        return self._rls.stands

    def last_known(self, name: str) -> Trusted | None:
        if self.last_s is None:
            return None
        return self._supervision.validity.last_known.of(self._masks.names.index(name), self.last_s)

    @property
    def ages_s(self) -> list[float | None]:
        return [] if self.last_s is None else self._supervision.validity.last_known.ages_s(self.last_s)

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
        taken = self._supervision.together.take(tick, self._tick_end_s, self.sample_period_s)
        if taken is None:
            return []
        stretch, noise_var = self._stretch_of(taken.samples)
        assert self._tick_end_s is not None
        alike = self._stretches.alike("current_A")
        ended = Ended(stretch, noise_var, self._tick_end_s, self.sample_period_s or 0.0, alike)
        judgement = self._supervision.judge(taken, ended)
        if judgement.restart is not None:
            return [*judgement.messages, *self._restart(judgement.restart)]
        if judgement.begins_again:
            self._begin_again()
        return judgement.messages

    def _stretch_of(self, tick: SampleBlock) -> tuple[Stretch, Mapping[str, float]]:
        """Samples as the regressions take them, and variances of the measured channels, as far as known before."""
        period_s, before_s = self.sample_period_s, self._tick_end_s  # with which the filter has taken its samples
        super().close_tick(tick)
        assert self.first_s is not None
        # (In the first tick, of which nothing was known before it, gaps are told by its own period.)
        period_s = period_s or self.sample_period_s
        stretch = self._stretches.of(tick, self.first_s, before_s, period_s)
        noise_var = self._noise_var()
        self._signal_scales.take(stretch, period_s or 0.0, self._filtering.layout.position_lsb, noise_var)
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
        plant = self._plant.for_filter_of(self.sample_period_s or 0.0)
        if plant is not self._ekf.plant:
            self._ekf.use(plant, self._engine(plant))
        self._ekf.start(start.parameters, held_input=self._filtering.layout.last_input)
        self._ekf.forget_state(self._filtering.first_state(start.last))
        saved = () if self._prior is None else (*self._prior.names, *self.plan.biases)
        trusted = trusted_mask(self._masks.names, self._transfer, saved)
        whole = self._prior is not None and {*self.plan.free} <= {*self._prior.names}
        sure = whole or self._transfer is not None
        end_s, period_s = self._tick_end_s or 0.0, self.sample_period_s or 0.0
        self._supervision.begin(start, trusted, end_s, period_s, whole=whole, sure=sure)
        if self._transfer is not None:
            self.qualification.qualified |= trusted
            self._transfer.hand_states_to(self._ekf)

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
        self._supervision.reset()

    def worth_keeping(self) -> Gaussian | None:
        if not self._ekf.started or not self._ekf.is_sound() or self._supervision.suspicious:
            return None
        known = self._masks.published & self.qualification.qualified
        if not self._supervision.jumps.quiet or not known.any():
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
