"""What every drive has: the time of its samples, what they measured last, and what its channels determine.

A drive from whose channels no model can be run has no more than that; the others have estimators (`plant_tracker`).
"""

from __future__ import annotations

from servo_daemon.kalman.ekf import Ekf
from servo_daemon.kalman.gaussian import Gaussian
from servo_daemon.numerics import upper_median
from servo_daemon.parameters import Parameter
from servo_daemon.regression.estimate import RegressionEstimate
from servo_daemon.regression.motor_rls import MotorRls
from servo_daemon.samples import SampleBlock
from servo_daemon.tracking.noise.watch import InnovationWatch
from servo_daemon.tracking.plan.settings import TICK_S, Message, Resolutions, TrackerSettings
from servo_daemon.tracking.plan.signals import SignalPlan
from servo_daemon.tracking.validity.fusion import Trusted


class Tracker:
    """The estimator of a drive from whose channels no model can be run.

    Attributes:
        plan: what these channels determine.
        first_s, last_s: device time from where time counts, and of the last sample.
        measured_state: what was measured last, by channel.
        sample_period_s: usual distance of two samples.
        ekf, rls: the estimators, where there are any.
    """

    def __init__(
        self, channels: tuple[str, ...], settings: TrackerSettings, resolutions: Resolutions, plan: SignalPlan
    ) -> None:
        self.channels, self.settings, self.resolutions, self.plan = channels, settings, resolutions, plan
        self.nominal = dict(settings.nominal or {})
        self.last_s: float | None = None
        self.first_s: float | None = None
        self._seen_s: float | None = None  # the first sample
        self.measured_state: dict[str, float | None] = {}
        self.sample_period_s: float | None = None
        self._tick_end_s: float | None = None
        self.restarts = 0
        self.watch = InnovationWatch(plan.measured)

    @property
    def ekf(self) -> Ekf | None:
        return None

    @property
    def rls(self) -> MotorRls | None:
        return None

    @property
    def is_calm(self) -> bool:
        """Whether the next ticks may be judged together, some at a time."""
        return False

    @property
    def waits(self) -> bool:
        """Whether the last tick is to be judged with later ones: what is known of the parameters is as before it."""
        return False

    @property
    def settled(self) -> bool:
        """Whether the filter has run long enough for its parameters to qualify; at once where none can run."""
        return True

    @property
    def explained(self) -> bool:
        """Whether the model explains the data; see `Notifications`."""
        return True

    @property
    def examines_jump(self) -> bool:
        """Whether something unexplained is being looked into: the filter may yet be set back."""
        return False

    @property
    def jump_is_sudden(self) -> bool:
        """Whether it came after samples that the model explained: the motor has changed, it is not the model that lacks
        something."""
        return False

    @property
    def position_lsb_rad(self) -> float:
        """The encoder's step; 0: none, or not known yet."""
        return 0.0

    @property
    def winding(self) -> RegressionEstimate | None:
        """R and L by the regression where the shaft has never turned, so that no filter can start; else None."""
        return None

    @property
    def stands(self) -> bool:
        """Whether the shaft has not moved since the first sample."""
        return False

    @property
    def ages_s(self) -> list[float | None]:
        """How long ago the motion last showed each parameter of the plant and it was known; None: it never was."""
        return []

    @property
    def free(self) -> tuple[Parameter, ...]:
        """The parameters that are estimated and published, in the plant's order."""
        return ()

    def published(self) -> Gaussian | None:
        """What is to be published of all parameters; see `JumpActions`. None before the filter runs."""
        return None

    def last_known(self, _: str) -> Trusted | None:
        """A parameter of the plant as it was when it was last known; None: it never was."""
        return None

    def worth_keeping(self) -> Gaussian | None:
        """Qualified parameters, and those that are held, for a later run, with what may have changed meanwhile; None
        where none is qualified or the filter is not well."""
        return None

    def take(self, block: SampleBlock) -> None:
        """Samples of one tick or a part of it, in order."""
        if self._seen_s is None:
            self._seen_s = float(block.time_s[0])
            self.first_s = self._seen_s if self.first_s is None else self.first_s
        self.last_s = float(block.time_s[-1])
        for name in ("current_A", "velocity_rad_s", "position_rad"):
            values = getattr(block, name)
            self.measured_state[name] = None if values is None else float(values[-1])

    def close_tick(self, tick: SampleBlock) -> list[Message]:
        """Do what is slower than a sample, over exactly the samples of this tick."""
        self._see_period(tick)
        return []

    def _see_period(self, tick: SampleBlock) -> None:
        """The usual distance of two samples, from within the tick. A drive that is slower than the ticks has one in
        each: then it is the least distance to the tick before, which a missing sample does not make longer."""
        before_s, self._tick_end_s = self._tick_end_s, float(tick.time_s[-1])
        known_s = self.sample_period_s
        if len(tick) > 1:
            self.sample_period_s = upper_median(tick.time_s[1:] - tick.time_s[:-1])
        elif before_s is not None and (known_s is None or known_s >= TICK_S):
            distance_s = self._tick_end_s - before_s
            self.sample_period_s = distance_s if known_s is None else min(known_s, distance_s)
