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

#: While a step is looked for, nothing is published as known better than this, 1 σ over its scale (below
#: `validity.gates.LOST`); signed parameters, which have no qualification to lose by it
#: (free within 0.25 .. 1).
_OPEN_STD, _OPEN_SIGNED_STD = 0.13, 0.5
#: A parameter that has stepped is named if it moved by this share of its scale, and by so many standard deviations of
#: how it wandered before (two invented steps of K under a hidden brush drop: 3.9).
_NOTICEABLE, _WANDERS = 0.02, 6.0


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
        return self.search.promising

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
        action: jumps.Action = self.watch.judge(test.unexplained, self.search.running) if judged else "learn"
        if action == "undo" and self._before is not None:
            before = self._known_before()
            self._ekf.put_parameters(before.mean, before.covariance)
            self._ekf.forget_motion(self._ekf.x)  # it was led astray as well
        if searched is None:
            self.search.clear()
            return action, []
        self.search.take(end_s)
        found = self.search.look(test.unexplained, searched and self.watch.sudden)
        return (action, []) if found is None else ("accept", self._take_over(found, end_s))

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
        return self._named(Known(self._masks.names, found.mean, found.covariance, found.before_s), found.k, time_s)

    def _known_before(self) -> Known:
        """What was known of the parameters before something happened."""
        assert self._before is not None
        state, time_s = self._before
        mean, covariance = self._ekf.parameters_of(state)
        return Known(self._masks.names, mean, covariance, time_s)

    def _opening(self) -> F64:
        """Added to the coordinates' variances while a step is looked for, shape (n,)."""
        std = np.where(self._masks.logarithmic, _OPEN_STD, _OPEN_SIGNED_STD) * self._validity.excitation.scales
        return np.asarray(np.where(self._masks.free, std**2, 0.0))

    def _named(self, before: Known, k: int, time_s: float) -> list[Message]:
        """What is told of a parameter that has stepped: nothing, if it is not published, or has wandered as far."""
        after, scale = self._ekf.coordinates, float(self._validity.excitation.scales[k])
        least = max(_NOTICEABLE * scale, _WANDERS * float(self._wander.spread(len(after))[k]))
        known = self._masks.published[k] and self._validity.qualification.qualified[k]
        if not known or abs(float(after[k] - before.mean[k])) <= least:
            return []
        self._wander.clear()  # what follows is about another value
        return [jumps.message(self._masks.parameters[k], before, float(after[k]), time_s)]

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
