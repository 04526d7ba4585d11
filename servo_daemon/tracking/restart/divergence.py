"""Divergence monitor: whether a running filter should begin again, from what the regressions know."""

from __future__ import annotations

from servo_daemon.kalman.ekf import Ekf
from servo_daemon.parameters import LINEAR
from servo_daemon.regression.motor_rls import MotorRls
from servo_daemon.tracking.noise.watch import InnovationWatch
from servo_daemon.tracking.plan.parameter_masks import ParameterMasks
from servo_daemon.tracking.start.starting_point import well_known
from servo_daemon.tracking.validity.cross_check import on_one_line
from servo_daemon.tracking.validity.gates import QUALIFIED
from servo_daemon.tracking.validity.validity_gate import ValidityGate

#: Diverged: innovations this many times larger than they should be, for as many ticks, while the regression is well
#: (see `make calibrate`).
_DIVERGED_NIS, _DIVERGED_TICKS = 6.0, 20
#: A filter that started from little has this long to find out for itself, ticks (free within 25 .. 100).
_TICKS_TO_BEGIN_BETTER = 50


class DivergenceMonitor:
    """Compares one running filter with its regressions.

    Attributes:
        suspicious_ticks: in a row, whose innovations are far too large.
    """

    def __init__(
        self, masks: ParameterMasks, ekf: Ekf, rls: MotorRls, validity: ValidityGate, watch: InnovationWatch
    ) -> None:
        self._ekf, self._rls, self._validity, self._watch = ekf, rls, validity, watch
        free = [(k, p.name) for k, p in enumerate(masks.parameters) if masks.published[k] and p in LINEAR]
        self._core = [name for _, name in free]
        self._index = [k for k, _ in free]
        self._index_but_L = [k for k, name in free if name != "L"]
        self.suspicious_ticks = self._begun_better = 0

    def reset(self) -> None:
        """Count anew: the filter begins again."""
        self.suspicious_ticks = 0

    def has_diverged(self, nis: float) -> bool:
        """After each tick: whether the filter no longer fits its data while the regression does (without it
        `test_a_filter_that_no_longer_fits_begins_again_where_the_regression_does` fails).

        Args:
            nis: of the tick's innovations, the worst channel's.
        """
        self.suspicious_ticks = self.suspicious_ticks + 1 if nis > _DIVERGED_NIS else 0
        return self.suspicious_ticks >= _DIVERGED_TICKS and well_known(self._rls.estimate(), self._core)

    def could_begin_better(self, tick: int) -> bool:
        """Each time that the regressions are worked off: whether the filter had to start from little and still does not
        know what the regression knows by now (without it `test_live_a_shaft_that_is_let_go_is_a_motor_like_any_other`
        fails).

        Args:
            tick: number of the running filter's.
        """
        if tick < _TICKS_TO_BEGIN_BETTER * 2**self._begun_better:
            return False
        # (L is not claimed by a model that lacks something: beginning again would not help it.)
        index = self._index if self._watch.white else self._index_but_L
        std = self._ekf.coordinate_std[index] / self._validity.excitation.scales[index]
        lost = ~self._validity.qualification.qualified[index] & (
            (std > QUALIFIED) | ~self._validity.confirmation.parameters[index]
        )
        if not lost.any() or not well_known(self._rls.estimate(), self._core):
            return False
        self._begun_better += 1  # what did not help is tried less and less often
        return True

    @property
    def of_its_start(self) -> bool:
        """Whether the filter has not found its values on a motion that should show them, or goes along a line on which
        it hardly can."""
        known, excited = self._validity.qualification.qualified, self._validity.excitation.excited
        lost = (known | excited)[self._index_but_L].any() and not known[self._index_but_L].all()
        found = self._rls.estimate()
        return bool(lost) or (found is not None and bool(on_one_line(found)))
