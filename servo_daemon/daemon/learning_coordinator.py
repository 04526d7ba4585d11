"""Learned models for the drives: found among the kept ones, or trained, one at a time, in a process of its own.

The worker only writes down what a drive needs and takes what has come (`Subscription`); looking through files, loading
scikit-learn (a second) and training are the coordinator's thread's and its process' work.
"""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from servo_daemon.background import Background
from servo_daemon.config import DriveConfig, LearningConfig
from servo_daemon.config.changes import looked_up
from servo_daemon.errors import ServoDaemonError
from servo_daemon.learning.examples.drive import rounded_rate, same_rate
from servo_daemon.pipeline.training_spec import training_spec
from servo_daemon.published.snapshot import EstimatorView

if TYPE_CHECKING:
    from servo_daemon.learning.examples.drawing import TrainingSpec
    from servo_daemon.learning.model.model import LearnedModel
    from servo_daemon.learning.training.background import BackgroundTraining

log = logging.getLogger(__name__)

#: A drive that has run for less is not worth the training yet, s.
TRAIN_AFTER_S = 30.0
#: How often the coordinator looks at its subscriptions and at the training, s.
_TURN_S = 0.25


@dataclass(frozen=True, slots=True)
class _Wanted:
    """For which drive a model is looked for."""

    config: DriveConfig
    channels: tuple[str, ...]
    rate_hz: float
    since_s: float  # monotonic

    def serves(self, config: DriveConfig, channels: tuple[str, ...], rate_hz: float) -> bool:
        same = config is self.config or looked_up(self.config, config) == config  # but for limits and the like
        return same and channels == self.channels and same_rate(rate_hz, self.rate_hz)


class Subscription:
    """One drive's requests for a model and their answers. `follow`, `take` and `begin_again` belong to the worker, the
    rest to the coordinator."""

    def __init__(self, drive: str) -> None:
        self.drive = drive
        self.wanted: _Wanted | None = None
        self.answered: _Wanted | None = None  # what the coordinator is done with, well or not
        self._given: tuple[_Wanted, LearnedModel] | None = None
        self._taken: tuple[_Wanted, LearnedModel] | None = None
        self.view = EstimatorView({}, {"mode": "waiting", "reason": "no samples yet"})

    def follow(self, config: DriveConfig, channels: tuple[str, ...], period_s: float | None) -> None:
        """What the drive is now: another model is looked for as soon as it is another drive."""
        if not period_s:
            return
        wanted = self.wanted
        if wanted is None or not wanted.serves(config, channels, 1.0 / period_s):
            self.wanted = _Wanted(config, channels, 1.0 / period_s, time.monotonic())

    def take(self) -> LearnedModel | None:
        """A model that has come since the last call, if it is still the one that is wanted."""
        given = self._given
        if given is None or given is self._taken or given[0] is not self.wanted:
            return None
        self._taken = given
        return given[1]

    def begin_again(self) -> None:
        """What was taken is needed once more: the pipeline that had it is gone."""
        self._taken = None

    def give(self, wanted: _Wanted, model: LearnedModel) -> None:
        """The coordinator has found it."""
        self.answered, self._given = wanted, (wanted, model)

    def tell(self, mode: str, **detail: float | int | bool | str | None) -> None:
        """What is published as long as there is no model."""
        self.view = EstimatorView({}, {"mode": mode, **detail})


class LearningCoordinator(Background):
    """Finds or trains the models of all subscriptions in a thread of its own.

    Args:
        config: how to train.
    """

    def __init__(self, config: LearningConfig) -> None:
        super().__init__("learning")
        self._config = config
        self._subscriptions: list[Subscription] = []
        self._training: BackgroundTraining | None = None
        self._for: tuple[Subscription, _Wanted] | None = None
        self._looked: dict[str, _Wanted] = {}  # for which the files have been looked through, by drive

    def subscribe(self, drive: str) -> Subscription:
        """The subscription of a drive; any time."""
        subscription = Subscription(drive)
        self._subscriptions = [*self._subscriptions, subscription]
        return subscription

    def unsubscribe(self, subscription: Subscription) -> None:
        """End a subscription: the drive has gone."""
        self._subscriptions = [s for s in self._subscriptions if s is not subscription]

    def start(self) -> None:
        """Again where the first subscriptions have come since."""
        if self._subscriptions and not self._thread.is_alive():
            super().start()

    # -- the coordinator's thread -----------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            while not self._stop.wait(_TURN_S):
                try:
                    self._turn()
                except Exception:  # the drives go on without a refresh
                    log.exception("learned models: given up for now")
                    if self._stop.wait(60.0):
                        return
        finally:
            if self._training is not None:
                self._training.stop()

    def _turn(self) -> None:
        if self._training is not None:
            self._follow_training()
        for subscription in self._subscriptions:
            wanted = subscription.wanted
            if wanted is not None and wanted is not subscription.answered:
                self._serve(subscription, wanted)

    def _serve(self, subscription: Subscription, wanted: _Wanted) -> None:
        """A kept model at once; else one is trained when it is the drive's turn."""
        try:
            spec = _spec(wanted)
        except ServoDaemonError as error:
            subscription.answered = wanted
            subscription.tell("unavailable", reason=str(error))
            return
        if self._for is not None and self._for[1] is wanted:
            return
        model = self._kept(subscription, wanted, spec)
        if model is not None:
            log.info("drive %s: RF+GRNN model of %s motors", subscription.drive, model.facts.get("motors"))
            subscription.give(wanted, model)
        elif not self._config.train:
            subscription.answered = wanted
            subscription.tell("unavailable", reason="no kept model fits this drive, and [learning] train is false")
        elif time.monotonic() - wanted.since_s < TRAIN_AFTER_S:
            subscription.tell("waiting", reason=f"training begins when the drive has run for {TRAIN_AFTER_S:.0f} s")
        elif self._training is not None:
            subscription.tell("waiting", reason="the model of another drive is being trained")
        else:
            self._train(subscription, wanted, spec)

    def _kept(self, subscription: Subscription, wanted: _Wanted, spec: TrainingSpec) -> LearnedModel | None:
        """A kept model; looked for once, and again after each training, which may have made one for this drive, too."""
        from servo_daemon.learning.model.cache import kept_model

        if self._looked.get(subscription.drive) is wanted:
            return None
        self._looked[subscription.drive] = wanted
        return kept_model(spec, self._config.learner)

    def _train(self, subscription: Subscription, wanted: _Wanted, spec: TrainingSpec) -> None:
        from servo_daemon.learning.training.background import BackgroundTraining

        log.info("drive %s: training an RF+GRNN model with %d motors", subscription.drive, self._config.motors)
        self._for = subscription, wanted
        self._training = BackgroundTraining(spec, self._config.motors, self._config.nice, self._config.learner)
        self._follow_training()

    def _follow_training(self) -> None:
        assert self._training is not None and self._for is not None
        subscription, wanted = self._for
        model = self._training.model()
        if self._training.running:
            if wanted is subscription.wanted:
                subscription.tell("training", motors_done=self._training.done, motors=self._config.motors)
            return
        if model is not None:
            subscription.give(wanted, model)
        else:
            log.warning("drive %s: no RF+GRNN model: %s", subscription.drive, self._training.error)
            subscription.answered = wanted
            subscription.tell("unavailable", reason=self._training.error)
        self._training = self._for = None
        self._looked.clear()


def _spec(wanted: _Wanted) -> TrainingSpec:
    return training_spec(wanted.config, rate_hz=rounded_rate(wanted.rate_hz), channels=wanted.channels)
