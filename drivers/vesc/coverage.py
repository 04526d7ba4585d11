"""Whether a VESC's averages cover the time between two of our reads.

Each read begins an average anew, whoever reads it, and each of the fields for itself. One of them, the motor's current,
is read so seldom that another program, which reads them all, has read it since: then it is the mean over the last few
polls and not over all since our read before. That current is signed by power: the q current times the q voltage's sign.

    m_k − p̄_k = c (q̄_k − p̄_k)        p̄: the polls' mean since the read before, q̄: of the last of them

c is 0 where nobody else reads, and near 1 for the right number of last polls where somebody does. Where the current
does not change there is no telling; and then it is no matter what an average covers.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from drivers.can.decode import Bits
from servo_daemon.samples import F64

#: From one read of the seldom average to the next, s; no fewer polls than this. Another program that reads more often
#: than once in that time is met in every one.
CHECKED_EVERY_S, _FEWEST_POLLS = 0.2, 4
#: Reads that are judged together, and how many there must be. In the many a current that turns as fast as the other
#: program reads shows it, too.
_FEW, _MANY, _ENOUGH = 16, 64, 12
#: What c must be at least and at most, and how many of its std: of 12 reads without another program (Student's t of 11
#: degrees of freedom) one c in 10,000 is so many std off, and then it is not near 1.
_SHARE, _SURE = (0.4, 1.6), 6.0
#: What the steps of 0.01 A leave of a current at least: less than one of them is cut to nothing.
_STEP_A = 0.01


def polls_a_check(rate_hz: float) -> int:
    """Polls from one read of the seldom average to the next."""
    return max(_FEWEST_POLLS, round(CHECKED_EVERY_S * rate_hz))


class Coverage:
    """Of one drive.

    Args:
        polls: from one read of the seldom average to the next.

    Attributes:
        another: a program reads the averages, as the last reads of the seldom one show.
        known: there have been enough of these to show it.
    """

    def __init__(self, polls: int) -> None:
        self._last = np.unique(np.maximum(1, polls // 2 ** np.arange(1, 7)))  # polls, from one to half of them
        self.restart()

    def restart(self) -> None:
        """The next polls may be another motor's."""
        self.another = self.known = False
        self._since: list[tuple[float, float]] | None = None  # duration and current of each poll since the last read
        self._reads = 0
        self._judged: deque[F64] = deque(maxlen=_MANY)  # m − p̄, then q̄ − p̄ by the number of last polls

    def take(self, duration_s: float, motoring_A: float, seldom_A: float | None) -> None:
        """The next poll.

        Args:
            duration_s: since the poll before; NaN: one is missing between them.
            motoring_A: the poll's mean of the q current, with the sign of power. NaN: of no control cycle.
            seldom_A: the seldom average, where this poll has read it; NaN: of no control cycle.
        """
        if math.isnan(duration_s):
            self._since = None
        elif self._since is not None and not math.isnan(motoring_A):
            self._since.append((duration_s, motoring_A))
        if seldom_A is None:
            return
        since, self._since = self._since, []
        self._reads += 1
        self.known = self._reads > _ENOUGH  # the first of them began when somebody last looked
        if since is not None and len(since) > self._last[-1] and not math.isnan(seldom_A):
            polls = np.array(since)
            mean = _mean(polls)
            self._judged.append(np.array([seldom_A, *(_mean(polls[-n:]) for n in self._last)]) - mean)
            judged = np.array(self._judged)
            self.another = len(judged) >= _ENOUGH and (_is_another(judged[-_FEW:]) or _is_another(judged))


def _is_another(judged: F64) -> bool:
    """Shape (reads, 1 + numbers of last polls). No single read decides."""
    y, x = judged[:, :1], judged[:, 1:]
    return bool((_is_share(x, y) & _is_share(*_without_largest(x, y))).any())


def _without_largest(x: F64, y: F64) -> tuple[F64, F64]:
    largest = np.abs(x) == np.abs(x).max(axis=0)
    return np.where(largest, 0.0, x), np.where(largest, 0.0, y)


def _is_share(x: F64, y: F64) -> Bits:
    """Whether c of each column is a share and sure, shape (numbers of last polls,)."""
    xx, xy = np.maximum((x * x).sum(axis=0), np.finfo(float).tiny), (x * y).sum(axis=0)
    share = xy / xx
    var = np.maximum(((y - share * x) ** 2).sum(axis=0) / (len(x) - 1), _STEP_A**2) / xx
    sure: Bits = (share > _SHARE[0]) & (share < _SHARE[1]) & (share > _SURE * np.sqrt(var))
    return sure


def _mean(polls: F64) -> float:
    duration, current = polls.T
    return float(duration @ current / duration.sum())
