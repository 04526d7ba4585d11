"""How many passes over the first samples a start gets: so many that values which begin five times off settle."""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from servo_daemon.kalman.gaussian import Gaussian
from servo_daemon.samples import F64
from servo_daemon.tracking.restart.batch_passes import Batch, BatchPasses
from servo_daemon.tracking.samples.filtering import SETTLED_SHARE, Fit

ALL = np.array([True])
#: A datasheet that is five times off, logarithm; the truth is 0.
FIVE_TIMES = float(np.log(5.0))


class Drive:
    """Stands for a filter of one parameter, its samples, masks and noise.

    Args:
        own: where passes along the filter's own states lead to, at once; None: to the truth, as along the instrumental
            trajectory, by and by.

    Attributes:
        left: of the way to the truth a pass leaves so much.
        of_current: variances of the two noises; None: they are known.
    """

    def __init__(self, own: float | None = None) -> None:
        self.coordinates, self.coordinate_std = np.array([FIVE_TIMES]), np.array([1e-3])
        self.published = self.free = ALL
        self.kept, self.left = 1000, 0.55
        self.of_current: tuple[float, ...] | None = None
        self._own, self._follows = own, False

    def likeliest(self, value: float) -> F64:
        """Logarithms of the variances: what wrong values leave is taken for one noise, and lacks in the other."""
        return np.array([-3.0 + value, -2.0 - value])

    def again(self, parameters: Gaussian) -> Fit:
        begins = parameters.mean
        at_once = self._own is not None and not self._follows
        self.coordinates = np.array([self._own]) if at_once else self.left * begins
        cost = 1e4 * float(np.abs(self.coordinates).sum()) if self._own is None else 0.0
        if self.of_current is not None:
            off = np.log(self.of_current) - self.likeliest(float(begins[0]))
            cost += 30.0 * (off[0] + off[1]) ** 2 + (off[0] - off[1]) ** 2
        return Fit(cost)

    def snapshot(self) -> F64:
        return self.coordinates

    def restore(self, state: F64) -> None:
        self.coordinates = state

    def is_plausible(self) -> bool:
        return True

    def use_instrumental_trajectory(self, follows: bool) -> None:
        self._follows = follows

    def set_active(self, *_: object) -> None: ...

    def free_along_own_states(self, *_: object) -> Any:
        return ALL

    def put_of_current(self, *variances: float) -> None:
        self.of_current = variances


def go_over(drive: Drive) -> bool | None:
    """Until it is done. Returns whether the last pass was along the instrumental trajectory."""
    start = Gaussian(("R",), np.array([FIVE_TIMES]), np.eye(1))
    one = cast(Any, drive)
    passes = BatchPasses(one, one, one, one)
    work = passes.filter_again(Batch(start, [0], ALL, np.zeros(1), 1e-3), white=True)
    while True:
        try:
            next(work)
        except StopIteration as done:
            return cast("bool | None", done.value)


def test_values_five_times_off_settle() -> None:
    """A pass takes only a ninth of the way. Nine passes, eight along the instrumental trajectory and, as the values
    have jumped, nine more: from there on a pass moves them by no more than what counts as settled."""
    drive = Drive()
    drive.left = 0.89
    assert go_over(drive) is True
    assert (1.0 - drive.left) * abs(drive.coordinates[0]) < SETTLED_SHARE


def test_values_three_times_off_settle_along_the_instrumental_trajectory() -> None:
    """Along its own states the filter is sure at once of what the colour of its noise makes of the value; from there on
    each pass along the instrumental trajectory leaves 0.55 of the way: the eighth is the last."""
    drive = Drive(own=1.1)
    assert go_over(drive) is True
    assert abs(drive.coordinates[0]) < SETTLED_SHARE


def test_noise_is_found_again_at_the_values_that_were_found_with_it() -> None:
    drive = Drive()
    drive.of_current = tuple(np.exp(drive.likeliest(FIVE_TIMES)))
    go_over(drive)
    assert np.abs(np.log(drive.of_current) - drive.likeliest(0.0)).max() < 0.5


def test_noises_that_are_off_by_a_factor_of_thirty_are_found() -> None:
    """In opposite directions, where their sum is seen far better than their difference: the 25th pass is the last."""
    drive = Drive()
    drive.coordinates = np.array([0.0])
    drive.of_current = tuple(np.exp(drive.likeliest(0.0) + np.array([7.0, -7.0])))
    go_over(drive)
    assert np.abs(np.log(drive.of_current) - drive.likeliest(0.0)).max() < 0.5
