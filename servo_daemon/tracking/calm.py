"""Ticks of a calm drive, several of which are judged together.

While a model explains its samples and every parameter that the motion shows is known, a tick changes little of what can
be said. Of each only what cannot be made up for later is done: its innovations are tested, noise learns from them, and
where filter and samples were is kept for a search of the step that may come. The first tick with anything to it is
judged at once, together with those that have waited.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from servo_daemon.conditioning.gaps import is_whole
from servo_daemon.kalman.ekf import Ekf
from servo_daemon.kalman.records import ChannelStatistics
from servo_daemon.regression.sampling import WINDOW_S
from servo_daemon.samples import SampleBlock, concatenate
from servo_daemon.tracking.changes.actions import JumpActions
from servo_daemon.tracking.noise.watch import InnovationTest, InnovationWatch
from servo_daemon.tracking.plan.settings import TICK_S

#: So many ticks of a calm drive are judged together: what is published of its parameters is half a second old at most
#: (docs/performance.md).
TOGETHER = 5
#: A drive is calm after so many ticks to which there was nothing: as many as the balances look back over,
#: so that what they say is of a motor that does as it did before.
TICKS_TO_CALM = round(WINDOW_S / TICK_S)


@dataclass(frozen=True, slots=True)
class Taken:
    """Ticks that are to be judged now.

    Attributes:
        samples: of all.
        ticks: how many.
        last: samples of the last.
        statistics, test: of the last one's innovations; None: the filter's state is not sound.
    """

    samples: SampleBlock
    ticks: int
    last: int
    statistics: Mapping[str, ChannelStatistics]
    test: InnovationTest | None


class CalmTicks:
    """Those of one running filter.

    Attributes:
        calm: nothing that was judged last is in doubt or about to change.
    """

    def __init__(self, ekf: Ekf, watch: InnovationWatch, jumps: JumpActions) -> None:
        self._ekf, self._watch, self._jumps = ekf, watch, jumps
        self._waiting: list[SampleBlock] = []
        self._eventful = 0  # the last tick to which there was something
        self.calm = False

    def begin(self) -> None:
        """The filter starts, and its ticks are counted anew."""
        self._eventful = 0

    def rest(self, tick: int, *, eventful: bool, certain: bool) -> None:
        """Ticks up to this one have been judged.

        Args:
            eventful: there was something to them.
            certain: nothing is in doubt or about to change now.
        """
        if eventful:
            self._eventful = tick
        self.calm = certain and tick - self._eventful >= TICKS_TO_CALM

    @property
    def waiting(self) -> int:
        """How many ticks are not judged yet."""
        return len(self._waiting)

    def take(self, tick: SampleBlock, before_s: float | None, period_s: float | None) -> Taken | None:
        """A tick that has ended. Returns what is to be judged; None: it may wait.

        Args:
            before_s: end of the last tick that was judged.
            period_s: usual distance of two samples.
        """
        statistics, test = {}, None
        if self._ekf.is_plausible():
            statistics = self._ekf.take_statistics()
            test = self._watch.judge(statistics)
            if self._may_wait(tick, test, before_s, period_s):
                self._waiting.append(tick)
                self._watch.learn(statistics, (period_s or 0.0) * len(tick))
                self._jumps.pass_over(float(tick.time_s[-1]))
                return None
        ticks, self._waiting, self.calm = [*self._waiting, tick], [], False
        return Taken(concatenate(ticks), len(ticks), len(tick), statistics, test)

    def _may_wait(
        self, tick: SampleBlock, test: InnovationTest, before_s: float | None, period_s: float | None
    ) -> bool:
        if not self.calm or len(self._waiting) == TOGETHER - 1 or test.unexplained:
            return False
        return is_whole(tick, float(self._waiting[-1].time_s[-1]) if self._waiting else before_s, period_s)
