"""Whether a drive's worker keeps up with its samples, and what is done where it does not.

A drive that sends more than its filter can work off (`engine = "filterpy"` at a kilohertz, a small machine without a
compiler) falls behind for ever. So it loses the oldest of its own samples, many at a time and seldom: a filter goes on
from a gap every few seconds, not from one in every block. What is late because something took long once (the first
compilation, many drives that start), or because other programs have the processor, is worked off without loss; that it
is behind is told.
"""

from __future__ import annotations

from servo_daemon.daemon.lines.reader import BlockQueue
from servo_daemon.tracking.plan.settings import Message

#: Samples that have waited for longer are late, s: a watcher sees the drive as it was then.
LATE_S = 2.0
#: A worker that has been late for so long and does not catch up will not, s. A compiled filter works off what came
#: during ten seconds of compiling in one.
PATIENCE_S = 5.0
#: It catches up where what waits has become so much less meanwhile: at that pace all is worked off in ten minutes. (In
#: two, before: 32 drives that need 0.86 of a core are 50 s late after their starts and catch up in five.)
_CATCHES_UP = 1.0 - PATIENCE_S / 600.0
#: A process that works as fast as it can uses this much of a processor at least; one that is late and uses less waits
#: for others.
_OWN_SHARE = 0.8
#: What is left of the waiting samples then: those of the last so many seconds.
KEPT_S = 0.25
#: It keeps up again once none has waited longer than `CALM_WAIT_S` for `CALM_S`, s.
CALM_WAIT_S, CALM_S = 0.5, 30.0


class Backlog:
    """Whether the samples of all drives that wait become fewer.

    Attributes:
        falls: they do; what is late meanwhile says nothing of later.
    """

    def __init__(self) -> None:
        self.falls = False
        self._looked_s, self._waited_s = 0.0, 0.0

    def see(self, waited_s: float, now_s: float) -> None:
        """
        Args:
            waited_s: how long the oldest sample of each drive has waited, in all.
            now_s: host monotonic.
        """
        if now_s - self._looked_s >= PATIENCE_S:
            self.falls = waited_s < _CATCHES_UP * self._waited_s
            self._looked_s, self._waited_s = now_s, waited_s


class LoadWatch:
    """Watches the queue of one drive's samples, and tells when its worker falls behind and when it has caught up.

    Attributes:
        overloaded: the drive loses samples because its worker does not keep up.
        behind: its samples are late and none is lost, because other programs have the processor.
    """

    def __init__(self) -> None:
        self.overloaded = self.behind = False
        self._late_since: float | None = None
        self._waited_before_s = 0.0  # when it began to be late, or had last caught up a part
        self._used_before_s: float | None = None  # the process' CPU time when it began to be late
        self._calm_since: float | None = None
        self._dropped = self._dropped_before = 0  # now, and when the overload began

    def wait(self, queue: BlockQueue, now_s: float, before: int) -> list[Message]:
        """The drive waits for its turn, which will take long.

        Args:
            now_s: host monotonic.
            before: so many drives have theirs first.

        Returns:
            what is to be told: once, as soon as its samples are late.
        """
        waited_s = queue.waited_s(now_s)
        if self.behind or waited_s <= LATE_S:
            return []
        self.behind = True
        text = f"drives start one after the other, {before} before it: its samples wait, and none is left out"
        return [("behind", text, {"waited_s": round(waited_s, 3), "drives_before": before})]

    def relieve(
        self, queue: BlockQueue, now_s: float, used_s: float | None = None, *, held_up: bool = False
    ) -> list[Message]:
        """Before each round of the worker: drop all but the last `KEPT_S` where it does not keep up.

        Args:
            now_s: host monotonic.
            used_s: CPU time of this process so far; None: not known, whoever is late is taken for overloaded.
            held_up: drives start one after the other, or catch up: that this one is late now says nothing of later.

        Returns:
            what is to be told.
        """
        waited_s = queue.waited_s(now_s)
        if held_up:
            self._late_since = None
        told = self._judge(waited_s, queue.dropped, now_s, used_s)
        if self.overloaded and waited_s > LATE_S:
            queue.drop_before(now_s - KEPT_S)
        return told

    def _judge(self, waited_s: float, dropped: int, now_s: float, used_s: float | None) -> list[Message]:
        """
        Args:
            waited_s: how long the oldest of the waiting samples has waited; 0: none waits.
            dropped: samples that have been dropped since the start.
        """
        late, lost = waited_s > LATE_S, dropped - self._dropped
        if not late:
            self._late_since = None
        elif self._late_since is None or self._has_caught_up_a_part(waited_s, now_s):
            self._late_since, self._waited_before_s, self._used_before_s = now_s, waited_s, used_s
        too_late = self._late_since is not None and now_s - self._late_since >= PATIENCE_S
        told: list[Message] = []
        if too_late and self._is_starved(now_s, used_s):
            too_late = False
            if not self.behind:
                self.behind = True
                text = f"other programs have the processor: its samples wait for {waited_s:.1f} s, and none is left out"
                told.append(("behind", text, {"waited_s": round(waited_s, 3)}))
        elif self.behind and waited_s <= CALM_WAIT_S:
            self.behind = False
            told.append(("behind_over", "its samples are worked off as they come again", {}))
        if not self.overloaded and (too_late or lost > 0):
            self.overloaded, self._dropped_before = True, self._dropped
            text = "its samples come faster than they are worked off: the oldest are left out, and counted as lost"
            told.append(("overloaded", text, {"waited_s": round(waited_s, 3)}))
        elif self.overloaded and self._is_calm(waited_s, lost, now_s):
            self.overloaded = False
            left_out = dropped - self._dropped_before
            text = f"its samples are worked off as they come again; {left_out} were left out"
            told.append(("overload_over", text, {"samples_lost": left_out}))
        self._dropped = dropped
        return told

    def _has_caught_up_a_part(self, waited_s: float, now_s: float) -> bool:
        if self._late_since is None or now_s - self._late_since < PATIENCE_S:
            return False
        return waited_s < _CATCHES_UP * self._waited_before_s

    def _is_starved(self, now_s: float, used_s: float | None) -> bool:
        if used_s is None or self._used_before_s is None or self._late_since is None or now_s <= self._late_since:
            return False
        return used_s - self._used_before_s < _OWN_SHARE * (now_s - self._late_since)

    def _is_calm(self, waited_s: float, lost: int, now_s: float) -> bool:
        if lost > 0 or waited_s > CALM_WAIT_S:
            self._calm_since = None
            return False
        self._calm_since = now_s if self._calm_since is None else self._calm_since
        over = now_s - self._calm_since >= CALM_S
        if over:
            self._calm_since = None
        return over
