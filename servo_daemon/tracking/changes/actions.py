"""Carries out on the filter what the watch for jumps decides, and knows what to publish meanwhile."""

from __future__ import annotations

import numpy as np

from servo_daemon.kalman.ekf import Ekf
from servo_daemon.kalman.gaussian import Gaussian
from servo_daemon.regression.motor_rls import MotorRls
from servo_daemon.samples import F64
from servo_daemon.tracking.changes import jumps
from servo_daemon.tracking.changes.jumps import JumpWatch, Known
from servo_daemon.tracking.changes.search import Found, JumpSearch
from servo_daemon.tracking.changes.wander import Wander
from servo_daemon.tracking.noise.watch import InnovationTest
from servo_daemon.tracking.plan.parameter_masks import ParameterMasks
from servo_daemon.tracking.plan.settings import Message
from servo_daemon.tracking.validity.validity_gate import ValidityGate


class JumpActions:
    """Carries out on one filter what the watch for jumps decides. `watch` decides, `remember` is called after every
    tick that is quiet."""

    def __init__(
        self, masks: ParameterMasks, ekf: Ekf, rls: MotorRls, validity: ValidityGate, search: JumpSearch
    ) -> None:
        self._masks, self._ekf, self._rls, self._validity = masks, ekf, rls, validity
        self.watch = JumpWatch()
        self.search = search
        self._before: tuple[F64, float] | None = None
        self._wander = Wander()

    def reset(self) -> None:
        self.watch.reset()
        self.search.clear()
        self._before = None
        self._wander.clear()

    @property
    def quiet(self) -> bool:
        """Whether no change is being examined."""
        return self.watch.quiet and not self.search.running

    @property
    def idle(self) -> bool:
        """Whether nothing has been examined lately, either."""
        return self.quiet and self.watch.idle

    @property
    def is_open(self) -> bool:
        """Whether a change is being examined."""
        return self.watch.is_open or self.search.promising

    def remember(self, time_s: float) -> None:
        """Keep what is known now, unless a change is being examined."""
        if self.quiet:
            self._before = self._ekf.snapshot(), time_s
            self._wander.add(self._ekf.coordinates.copy())

    def pass_over(self, end_s: float) -> None:
        """A tick while it is `idle`, to which there was nothing.

        Args:
            end_s: of device time.
        """
        self.watch.observe(False, self.watch.sudden)
        self.search.take(end_s)
        self.remember(end_s)
        self.search.mark()

    def take(
        self, test: InnovationTest, end_s: float, *, explained: bool, judged: bool, searched: bool | None
    ) -> tuple[jumps.Action, list[Message]]:
        """The tick that has just passed: what is done with it, and what is to be told.

        Args:
            test: of its innovations.
            end_s: of device time.
            explained: the model has explained the samples before it.
            judged: it is complete, and the filter has run for long enough.
            searched: which parameter has stepped may be looked for; None: nothing that is seen now says anything of it.
        """
        self.watch.observe(test.unexplained, explained)
        action: jumps.Action = "learn"
        if judged:
            action = self.watch.judge(test.unexplained, test.settled, self.search.running)
        messages = self._act(action, end_s)
        if searched is None:
            self.search.clear()
            return action, messages
        self.search.take(end_s)
        may_begin = searched and self.watch.sudden and not self.watch.is_open
        found = self.search.look(test.unexplained, may_begin)
        if found is None:
            return action, messages
        return "accept", messages + self._take_over(found, end_s)

    def _act(self, action: jumps.Action, time_s: float) -> list[Message]:
        """Do with the last tick what the watch for jumps has decided.

        Args:
            time_s: the tick's end.
        """
        if self._before is None or action in ("learn", "settle"):
            return []
        before = self._known_before()
        if action in ("undo", "open", "reject"):
            self._ekf.put_parameters(before.mean, before.covariance)
            self._ekf.forget_motion(self._ekf.x)  # it was led astray as well
        if action == "open":
            self._ekf.widen_parameters(self._opening())
        if action == "accept":
            return self._report(before, time_s)
        return []

    def _take_over(self, found: Found, time_s: float) -> list[Message]:
        """A parameter has stepped: the filter goes on with it.

        Args:
            time_s: the tick's end.
        """
        self._ekf.restore(found.state)
        self._ekf.take_statistics()
        self._ekf.take_information()
        self.watch.explain()
        self._rls.expect_change()
        self._validity.stepped(found.k)
        before = Known(self._masks.names, found.mean, found.covariance, found.before_s)
        candidates = (self._masks.published & self._validity.qualification.qualified) | self._masks.biases
        alone = np.zeros_like(candidates)
        alone[found.k] = candidates[found.k]
        scales = self._validity.excitation.scales
        moved = jumps.jumped(before, self._ekf.coordinates, self._ekf.coordinate_std, scales, alone)
        return self._named(before, moved, time_s)

    def _known_before(self) -> Known:
        """What was known of the parameters before something happened."""
        assert self._before is not None
        state, time_s = self._before
        mean, covariance = self._ekf.parameters_of(state)
        return Known(self._masks.names, mean, covariance, time_s)

    def _opening(self) -> F64:
        """Added to the coordinates' variances while a jump is looked for, shape (n,)."""
        std = (
            np.where(self._masks.logarithmic, jumps.OPEN_STD, jumps.OPEN_SIGNED_STD) * self._validity.excitation.scales
        )
        return np.asarray(np.where(self._masks.free, std**2, 0.0))

    def _report(self, before: Known, time_s: float) -> list[Message]:
        excitation, qualified = self._validity.excitation, self._validity.qualification.qualified
        candidates = (self._masks.published & qualified & excitation.excited) | self._masks.biases
        moved = jumps.jumped(before, self._ekf.coordinates, self._ekf.coordinate_std, excitation.scales, candidates)
        self._rls.expect_change()
        stayed = self._masks.free.copy()
        stayed[moved] = False
        at = np.flatnonzero(stayed)
        self._ekf.take_in(at, before.mean[at], before.covariance[np.ix_(at, at)])
        return self._named(before, moved, time_s) if self.watch.sudden else []

    def _named(self, before: Known, moved: list[int], time_s: float) -> list[Message]:
        """What is told of parameters that have moved: those published that have not wandered as far before, either."""
        after, published = self._ekf.coordinates, self._masks.published
        steps = np.abs(after - before.mean) > jumps.SIGNIFICANT * self._wander.spread(len(after))
        if any(published[k] and steps[k] for k in moved):
            self._wander.clear()  # what follows is about another value
        return [
            jumps.message(self._masks.parameters[k], before, float(after[k]), time_s)
            for k in moved
            if published[k] and steps[k]
        ]

    def published(self) -> Gaussian | None:
        """What is to be published of all parameters; None before the filter runs. Beside the filter's own spread: what
        the balances leave open. While something unexplained is being looked into it is what was known before, with the
        spread that it has by now."""
        if not self._ekf.started:
            return None
        balance = np.square(self._validity.mismatch.std)
        if self._before is None or not self.is_open:
            g = self._ekf.estimate()
            return Gaussian(g.names, g.mean, _widened(g.covariance, balance))
        before = self._known_before()
        return Gaussian(before.names, before.mean, _widened(before.covariance, self._opening() + balance))


def _widened(covariance: F64, var: F64) -> F64:
    """With more on its diagonal, var shape (n,)."""
    out = covariance.copy()
    out.flat[:: len(var) + 1] += var
    return out
