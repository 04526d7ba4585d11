"""What the motion says about each parameter now, over the last seconds, with hysteresis.

Two measures, and a parameter is excited only by both:

- statistical: the information that the filter gained from the samples (as if the parameter were free);
- systematic: what is left of it if the balances are only nearly right (`balances.py`), jointly for all parameters.

A parameter is excited when by each of them the last `WINDOW_S` alone would determine it to `ENTER` (1 σ, relative); it
stops being so at `LEAVE`. A parameter that is not excited is held (its row of the gain is zero), unless it is one of
several that the data show together only (R and K at one constant speed): those move, so that a change which they
explain together arrives where the covariance puts it, and their covariance grows in the direction that is not seen.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from servo_daemon.regression.sampling import WINDOW_S
from servo_daemon.samples import F64

#: 1 σ, relative, of what the last seconds alone would determine: excited from the first on, and until the second
#: (decision 14; the values are chosen; free within half and twice).
ENTER, LEAVE = 0.10, 0.20
#: The same for the systematic measure, which is a worst case (chosen; free within half and twice).
SYSTEMATIC_ENTER, SYSTEMATIC_LEAVE = 0.20, 0.40
#: A window that says nothing leaves this much, 1 σ: nothing is worse known than by a factor of about 1000 (ln 1000).
_NOTHING_STD = 7.0
#: The running sum over the window is taken anew after so many ticks (rounding does not add up for longer; chosen; half
#: and twice move no tracking figure).
_SUM_ANEW = 100
#: Share of a parameter in the directions that are not determined, above which it is one of them (free within a half and
#: twice: tests/recovery/constants.py).
_INSIDE = 0.98

#: Why a parameter is not visible, in words.
REASONS = {
    "R": "hardly any current, or only in proportion to the speed: R not visible",
    "L": "current hardly changes: L not visible",
    "K": "hardly any speed, or only in proportion to the current: K not visible",
    "J": "speed hardly changes: J not visible",
    "B": "hardly any speed, or only one: B not visible",
    "Tc": "no motion in both directions: Tc not visible",
}


class Excitation:
    """Flags for n parameters, fed a tick at a time.

    Args:
        n: number of parameters.

    Attributes:
        excited: flags, shape (n,).
        scales: shape (n,): what counts as one unit of each coordinate (1 for logarithms).
    """

    def __init__(self, n: int) -> None:
        self.scales: F64 = np.ones(n)
        self._window: deque[tuple[float, F64]] = deque()
        self._sum: F64 = np.zeros(n)
        self._sum_s = 0.0
        self._updates = 0
        self._systematic_std: F64 = np.zeros(n)
        self._alone: NDArray[np.bool_] = np.ones(n, dtype=bool)  # in no direction that several share
        self._mark(np.zeros(n, dtype=bool))

    def _mark(self, excited: NDArray[np.bool_]) -> None:
        """Which are excited, and what from now on is enough to be."""
        self.excited = excited
        self._limits = (
            np.where(excited, LEAVE, ENTER),
            np.where(excited, SYSTEMATIC_LEAVE, SYSTEMATIC_ENTER),
        )

    def reset(self) -> None:
        n = len(self.scales)
        self._window.clear()
        self._sum, self._sum_s = np.zeros(n), 0.0
        self._systematic_std, self._alone = np.zeros(n), np.ones(n, dtype=bool)
        self._mark(np.zeros(n, dtype=bool))

    def forget(self) -> None:
        """Forget the information so far; with the next tick it is counted anew, all at once."""
        self._window.clear()
        self._sum, self._sum_s = np.zeros(len(self.scales)), 0.0

    def determine(self, information: F64, covered: NDArray[np.bool_]) -> None:
        """Take the systematic measure.

        Args:
            information: of the coordinates, shape (n, n).
            covered: which parameters it can say anything of, shape (n,).
        """
        index = np.flatnonzero(covered)
        scaled = (information * (self.scales[:, None] * self.scales))[index[:, None], index]
        eigenvalues, vectors = np.linalg.eigh(scaled)
        eigenvalues = np.maximum(eigenvalues, 0.0) + _NOTHING_STD**-2  # rounding may leave a zero a little below
        squares = np.square(vectors)
        self._systematic_std = np.zeros(len(self.scales))
        self._systematic_std[index] = np.sqrt(np.add.reduce(squares / eigenvalues, axis=1))
        undetermined = eigenvalues < SYSTEMATIC_LEAVE**-2
        share = np.add.reduce(squares[:, undetermined], axis=1)
        self._alone = np.ones(len(self.scales), dtype=bool)
        self._alone[index] = (share > _INSIDE) | (share < 1.0 - _INSIDE)

    def update(self, information: F64, duration_s: float) -> None:
        """Take what the filter gained in a tick of `duration_s`, shape (n,)."""
        self._window.append((duration_s, information))
        self._sum_s += duration_s
        self._sum = self._sum + information
        while self._sum_s - self._window[0][0] >= WINDOW_S:
            old_s, old = self._window.popleft()
            self._sum_s -= old_s
            self._sum -= old
        self._updates += 1
        if self._updates % _SUM_ANEW == 0:  # rounding must not gather
            self._sum = np.sum([gained for _, gained in self._window], axis=0)
        most, systematic_most = self._limits
        excited = (self.std() < most) & (self._systematic_std < systematic_most)
        if np.count_nonzero(excited != self.excited):
            self._mark(excited)

    @property
    def systematic_std(self) -> F64:
        """1 σ of each coordinate over its scale that balances which are only nearly right leave open; 0 where they say
        nothing; shape (n,)."""
        return self._systematic_std

    def std(self) -> F64:
        """What the samples of the window alone would leave of each coordinate, 1 σ over its scale; shape (n,)."""
        return np.asarray(1.0 / (np.sqrt(np.maximum(self._sum, 1e-300)) * self.scales))

    def held(self, known: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Which parameters must not move, shape (n,).

        Args:
            known: parameters that there is something to hold of.
        """
        held: NDArray[np.bool_] = known & ~self.excited & self._alone
        return held


def reason(name: str) -> str:
    return REASONS.get(name, f"the motion does not show {name} now")
